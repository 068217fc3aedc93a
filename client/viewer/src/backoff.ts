const FIRST_MS = 500;
const LAST_MS = 8000;

/** How long to wait before the n-th attempt to connect again: 0.5 to 8 s, and a little chance. */
export function backoffMs(attempt: number, chance: number): number {
  return Math.min(FIRST_MS * 2 ** attempt, LAST_MS) * (0.75 + 0.5 * chance);
}
