// Lossy texture as HTJ2K of turned colours: mirrors protocol/codec_colours.py (PROTOCOL.md, "Payloads").

import { LEVEL, restoreHtj2k } from './codec_htj2k.ts';
import type { Htj2kDecoder, ImageShape } from './codec_htj2k.ts';
import { RemoteWireError } from './errors.ts';

const SIXTEENTHS = 16;
const PREFIX_BYTES = 5;
const MIDDLE = 1 << 15;
const GREY = 128;
const OPAQUE = 0xff000000;
/** Of red, green and blue, what Y Cb Cr are (ISO/IEC 15444-1 G.3). */
const TO_YCC = [
  [0.299, 0.587, 0.114],
  [-0.299 / 1.772, -0.587 / 1.772, 0.886 / 1.772],
  [0.701 / 1.402, -0.587 / 1.402, -0.114 / 1.402],
];

/** RGBA bytes, row by row, opaque. Throws RemoteWireError. */
export function decodeColours(
  payload: Uint8Array, height: number, width: number, quality: number, htj2k: Htj2kDecoder,
): Uint8Array {
  const { exact, turn, packets } = readPrefix(payload, quality);
  const bytes = htj2k.decode(packets, { height, width, components: 3 }, exact);
  const values = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
  const matrix = colours(turn);
  const rgba = new Uint32Array(height * width); // one store for a texel, which is twice as fast as four
  const [[ra, rb, rc, r0], [ga, gb, gc, g0], [ba, bb, bc, b0]] = matrix;
  for (let from = 0, to = 0; from < values.length; from += 3, to++) {
    const x = values[from]!;
    const y = values[from + 1]!;
    const z = values[from + 2]!;
    const red = clamped(ra * x + rb * y + rc * z + r0);
    const green = clamped(ga * x + gb * y + gc * z + g0);
    rgba[to] = OPAQUE | (clamped(ba * x + bb * y + bc * z + b0) << 16) | (green << 8) | red;
  }
  return new Uint8Array(rgba.buffer);
}

/** The nearest byte. */
const clamped = (value: number): number => (value > 0 ? (value < 255 ? (value + 0.5) | 0 : 255) : 0);

/** The whole code stream of a payload, headers rebuilt. */
export function restoreColours(payload: Uint8Array, shape: ImageShape, quality: number): Uint8Array {
  const { exact, packets } = readPrefix(payload, quality);
  return restoreHtj2k(packets, shape, exact);
}

function readPrefix(payload: Uint8Array, quality: number) {
  const [first, ...turn] = new Int8Array(payload.slice(0, PREFIX_BYTES).buffer);
  if (turn.length < PREFIX_BYTES - 1) throw new RemoteWireError('texture payload is cut short');
  if (first! < 0 || first! >= SIXTEENTHS || turn.every((one) => one === 0)) {
    throw new RemoteWireError('texture payload with more than sixteenths, or turned by nothing');
  }
  return { exact: quality + first! / SIXTEENTHS, turn, packets: payload.subarray(PREFIX_BYTES) };
}

type Row = [number, number, number, number];

/** What makes red, green and blue of an image's values: the turn undone, and the codec's own transform before it. */
function colours(turn: number[]): [Row, Row, Row] {
  const length = Math.hypot(...turn);
  const [w, x, y, z] = turn.map((one) => one / length) as [number, number, number, number];
  const undone = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
  const scale = Math.sqrt(3) / LEVEL;
  return undone.map((row) => {
    const [a, b, c] = [0, 1, 2].map((k) => scale * row.reduce((sum, one, j) => sum + one * TO_YCC[j]![k]!, 0)) as [number, number, number];
    return [a, b, c, GREY - MIDDLE * (a + b + c)];
  }) as [Row, Row, Row];
}
