// High-throughput JPEG 2000 whose headers do not travel: mirrors protocol/codec_htj2k.py (PROTOCOL.md, "Payloads").

import createOpenJph from '@cornerstonejs/codec-openjph';
import type { Decoder } from '@cornerstonejs/codec-openjph';
import { RemoteWireError } from './errors.ts';

export const LOSSLESS = 255;
const LOSSY_MAX = 95;
const LEVELS_MAX = 7;
const TILE_HEADER_BYTES = 14;
/** Of a lossy image's values: one of the 256 levels that a quality's step is counted in. */
export const LEVEL = 32;
const NORM_LOW = [1.0, 1.4021, 2.0304, 2.9012, 4.1153, 5.8245, 8.2388, 11.652].map(Math.fround);
const NORM_HIGH = [1.4425, 1.9669, 2.8839, 4.1475, 5.8946, 8.3472, 11.809].map(Math.fround);
const GROWTH = [[1, 1, 1], ...Array.from({ length: 4 }, () => [2, 2, 2]), [2, 2, 3], [2, 2, 3]];

export interface ImageShape {
  height: number;
  width: number;
  /** 3 for colours, 1 for range; of 16 bits, but lossless colours of 8. */
  components: 1 | 3;
}

/** Decodes through OpenJPH, compiled once. */
export class Htj2kDecoder {
  private constructor(private readonly decoder: Decoder) {}

  /** wasm: its bytes, or the address to compile it from while it comes. */
  static async load(wasm: ArrayBuffer | string): Promise<Htj2kDecoder> {
    const source = typeof wasm === 'string' ? { locateFile: () => wasm } : { wasmBinary: wasm };
    const module = await createOpenJph({ ...source, print: () => undefined, printErr: () => undefined });
    return new Htj2kDecoder(new module.HTJ2KDecoder());
  }

  /** Samples row by row, interleaved; a view that the next call overwrites. Throws RemoteWireError. */
  decode(payload: Uint8Array, shape: ImageShape, quality: number): Uint8Array {
    const stream = restoreHtj2k(payload, shape, quality);
    try {
      this.decoder.getEncodedBuffer(stream.length).set(stream);
      this.decoder.decode();
    } catch {
      throw new RemoteWireError('HTJ2K does not decode');
    }
    const { width, height, componentCount, bitsPerSample } = this.decoder.getFrameInfo();
    const decoded = this.decoder.getDecodedBuffer();
    const bytes = sampleBits(shape, quality) / 8;
    const fits =
      width === shape.width && height === shape.height && componentCount === shape.components &&
      bitsPerSample === 8 * bytes && decoded.length === width * height * componentCount * bytes;
    if (!fits) throw new RemoteWireError(`HTJ2K decoded to ${width} x ${height} x ${componentCount}`);
    return decoded;
  }
}

/** The whole code stream of a payload, headers rebuilt from shape and quality. */
export function restoreHtj2k(payload: Uint8Array, shape: ImageShape, quality: number): Uint8Array {
  if (payload.at(-2) !== 0xff || payload.at(-1) !== 0xd9) {
    throw new RemoteWireError('HTJ2K payload is cut short: no end marker');
  }
  const head = mainHeader(shape, quality);
  const tile = new Bytes().u16(0xff90).u16(10).u16(0).u32(payload.length - 2 + TILE_HEADER_BYTES).u8(0).u8(1).u16(0xff93);
  const stream = new Uint8Array(head.length + tile.bytes.length + payload.length);
  stream.set(head);
  stream.set(tile.bytes, head.length);
  stream.set(payload, head.length + tile.bytes.length);
  return stream;
}

/** SOC SIZ CAP COD QCD, byte for byte as OpenJPH writes them. */
export function mainHeader(shape: ImageShape, quality: number): number[] {
  if (quality > LOSSY_MAX && quality !== LOSSLESS) throw new RemoteWireError(`HTJ2K quality ${quality} is off the scale`);
  const lossless = quality === LOSSLESS;
  const levels = decompositionLevels(shape);
  const { body, bits } = lossless ? reversible(levels, shape) : irreversible(levels, quality);
  const { width, height, components } = shape;
  const size = new Bytes().u16(0x4000).u32(width).u32(height).u32(0).u32(0).u32(width).u32(height).u32(0).u32(0);
  size.u16(components);
  for (let k = 0; k < components; k++) size.u8(sampleBits(shape, quality) - 1).u8(1).u8(1);
  const coding = new Bytes().u8(0).u8(2).u16(1).u8(components === 3 ? 1 : 0).u8(levels);
  coding.u8(4).u8(4).u8(0x40).u8(lossless ? 1 : 0);
  const capability = new Bytes().u32(0x00020000).u16(magnitudeBound(bits) | (lossless ? 0 : 0x20));
  return new Bytes().u16(0xff4f).segment(0xff51, size).segment(0xff50, capability).segment(0xff52, coding)
    .segment(0xff5c, body).bytes;
}

const sampleBits = ({ components }: ImageShape, quality: number): number =>
  components === 3 && quality === LOSSLESS ? 8 : 16;

function decompositionLevels({ height, width }: ImageShape): number {
  const bitLength = 32 - Math.clz32(Math.min(height, width) - 1);
  return Math.min(Math.max(bitLength - 1, 1), LEVELS_MAX);
}

interface Quantisation {
  body: Bytes;
  bits: number;
}

function reversible(levels: number, shape: ImageShape): Quantisation {
  const depth = shape.components === 3 ? 9 : 16;
  const bits = [depth + 1];
  for (let level = levels; level > 0; level--) bits.push(...GROWTH[level - 1]!.map((grown) => depth + grown));
  const body = new Bytes().u8(0x20);
  for (const band of bits) body.u8(band << 3);
  return { body, bits: Math.max(...bits) };
}

/** In float32 as OpenJPH: some steps lie so near a tie that float64 would round them to another mantissa. */
function irreversible(levels: number, quality: number): Quantisation {
  const bands = [{ norm: Math.fround(NORM_LOW[levels]! * NORM_LOW[levels]!), level: levels }];
  for (let level = levels; level > 0; level--) {
    const [low, high] = [NORM_LOW[level]!, NORM_HIGH[level - 1]!];
    for (const norm of [low * high, low * high, high * high]) bands.push({ norm: Math.fround(norm), level });
  }
  const step = Math.fround((2 ** (-quality / 8) * LEVEL * 256) / 65536);
  const body = new Bytes().u8(0x22);
  let bits = 0;
  for (const { norm, level } of bands) {
    const [exponent, mantissa] = exponentAndMantissa(Math.fround(step / norm));
    body.u16((exponent << 11) | mantissa);
    bits = Math.max(bits, exponent + 1 - level);
  }
  return { body, bits };
}

/** [e, m] with step = 2^-e (1 + m / 2048). */
function exponentAndMantissa(step: number): [number, number] {
  let exponent = 0;
  while (step * 2 ** exponent < 1) exponent++;
  while (step * 2 ** exponent >= 2) exponent--;
  return [exponent, Math.min(Math.floor((step * 2 ** exponent - 1) * 2048 + 0.5), 2047)];
}

const magnitudeBound = (bits: number): number => (bits <= 8 ? 0 : bits < 28 ? bits - 8 : 13 + (bits >> 2));

/** Big-endian bytes, appended. */
class Bytes {
  readonly bytes: number[] = [];

  u8(value: number): this {
    this.bytes.push(value & 0xff);
    return this;
  }

  u16(value: number): this {
    return this.u8(value >> 8).u8(value);
  }

  u32(value: number): this {
    return this.u16(value >>> 16).u16(value);
  }

  segment(marker: number, body: Bytes): this {
    this.u16(marker).u16(2 + body.bytes.length);
    this.bytes.push(...body.bytes);
    return this;
  }
}
