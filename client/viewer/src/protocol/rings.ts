// How many samples a spherical scan has on each ring: mirrors protocol/rings.py (PROTOCOL.md, "Spheres").

const SLACK = 1e-9;

/** The stride t of each row of blocks, `side` rows high: the largest of 1, 2, 4 .. side with t sin v <= sqrt(2). */
export function ringStrides(width: number, height: number, side: number, halfSpacing: number): Int32Array {
  const stride = new Int32Array(Math.ceil(height / side)).fill(1);
  const sine = (row: number) => Math.sin((Math.PI * (row + 0.5)) / height);
  const fits = (t: number) => t <= side && width % t === 0 && ((2 * width) / t) % halfSpacing === 0;
  for (let t = 2; fits(t); t *= 2) {
    for (let block = 0; block < stride.length; block++) {
      let largest = 0;
      for (let row = block * side; row < Math.min((block + 1) * side, height); row++) largest = Math.max(largest, sine(row));
      if (t * largest <= Math.SQRT2 * (1 + SLACK)) stride[block] = t;
    }
  }
  return stride;
}

/**
 * Own samples and the cells between them: rows of n + 1 samples to n stride cells, the last one only looked at.
 * Between a and b, k of t columns on: (2 (a (t - k) + b k) + t) // (2 t). parts: values of a sample; range, which has
 * one, is void where either end is.
 */
export function widened<T extends Uint16Array | Uint8Array>(own: T, across: number, stride: number, parts: number): T {
  if (stride === 1) return own;
  const rows = own.length / across / parts;
  const cells = new (own.constructor as new (size: number) => T)(rows * (across - 1) * stride * parts);
  let to = 0;
  for (let row = 0; row < rows; row++) {
    for (let from = row * across * parts; from < ((row + 1) * across - 1) * parts; from += parts) {
      for (let k = 0; k < stride; k++) {
        for (let part = from; part < from + parts; part++, to++) {
          const [a, b] = [own[part]!, own[part + parts]!];
          const isVoid = parts === 1 && k > 0 && (a === 0 || b === 0);
          cells[to] = isVoid ? 0 : Math.floor((2 * (a * (stride - k) + b * k) + stride) / (2 * stride));
        }
      }
    }
  }
  return cells;
}
