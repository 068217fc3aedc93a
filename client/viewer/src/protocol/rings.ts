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

export type Samples = Uint16Array | Uint8Array;

/**
 * A row's own samples, `step` apart from `own[from]` on, and the cells between them, into `cells` from `to` on: n + 1
 * samples to n stride cells, the last one only looked at. Between a and b, k of t columns on:
 * (2 (a (t - k) + b k) + t) // (2 t). parts: values of a sample; range, which has one, is void where either end is.
 */
export function widen(own: Samples, from: number, step: number, cells: Samples, to: number, columns: number, stride: number, parts: number): void {
  const shift = Math.log2(stride) + 1; // divides by 2 t, a power of two
  for (let column = 0; column < columns; column++, from += step * parts, to += stride * parts) {
    for (let part = 0; part < parts; part++) {
      const a = own[from + part]!;
      const rising = 2 * (own[from + part + step * parts]! - a);
      let sum = (2 * a + 1) * stride;
      for (let k = 0, at = to + part; k < stride; k++, at += parts, sum += rising) cells[at] = sum >> shift;
    }
    if (parts === 1 && (own[from] === 0 || own[from + step] === 0)) cells.fill(0, to + 1, to + stride);
  }
}
