import { RemoteWireError } from './errors.ts';

/** Raw deflate, whole and of at most `most` bytes. Throws RemoteWireError for anything else. */
export async function inflate(payload: Uint8Array, most: number): Promise<Uint8Array> {
  const stream = new DecompressionStream('deflate-raw');
  const writer = stream.writable.getWriter();
  const written = writer.write(payload as Uint8Array<ArrayBuffer>).then(() => writer.close());
  written.catch(() => undefined); // the reader hears of it too
  const reader = stream.readable.getReader();
  const parts: Uint8Array[] = [];
  let size = 0;
  try {
    for (let next = await reader.read(); !next.done; next = await reader.read()) {
      parts.push(next.value);
      size += next.value.length;
      if (size > most) throw new RangeError(`more than ${most} bytes`);
    }
    await written;
  } catch (error) {
    reader.cancel().catch(() => undefined);
    throw new RemoteWireError(`payload does not inflate: ${(error as Error).message}`);
  }
  if (parts.length === 1) return parts[0]!;
  const whole = new Uint8Array(size);
  parts.reduce((at, part) => (whole.set(part, at), at + part.length), 0);
  return whole;
}
