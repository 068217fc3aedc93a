// Payloads to samples: the one entrance to the codecs, as protocol/codec.py.

import { RemoteWireError } from './errors.ts';
import { jpegQ, restoreJpeg } from './codec_jpeg.ts';
import { decodeLift } from './codec_lift.ts';
import type { Shape } from './codec_lift.ts';
import { decodeMask } from './codec_mask.ts';
import { decodeColours } from './codec_colours.ts';
import { LOSSLESS } from './codec_htj2k.ts';
import type { Htj2kDecoder } from './codec_htj2k.ts';

export const RAW = 0;
const JPEG = 1;
export const HTJ2K = 2;
export const LIFT = 3;
const SIDE_MAX = 16384;
const SAMPLES_MAX = 1 << 25;
const STEPS_MAX = 65535;

/** Decodes a whole JPEG file to RGBA bytes. */
export type JpegDecoder = (file: Uint8Array, width: number, height: number) => Promise<Uint8Array>;

/** What this machine decodes with; WASM comes when first asked for. */
export class Codecs {
  constructor(private readonly htj2k: () => Promise<Htj2kDecoder>, private readonly jpeg: JpegDecoder) {}

  /** Steps 1..65535, row by row, of each image in a payload; of several it is LIFT. Throws RemoteWireError. */
  async ranges(payload: Uint8Array, codec: number, shapes: readonly Shape[], quantum: number): Promise<Uint16Array[]> {
    const samples = shapes.map(({ height, width }) => checkShape(height, width)).reduce((sum, one) => sum + one);
    checkLength(payload, samples, 2);
    if (codec === LIFT) return decodeLift(payload, shapes, quantum);
    if (shapes.length > 1) throw new RemoteWireError('range of several images travels as LIFT alone');
    const { height, width } = shapes[0]!;
    return [await this.values(payload, codec, height, width, quantum)];
  }

  /** Steps 1..65535, row by row. Throws RemoteWireError. */
  async range(
    payload: Uint8Array, codec: number, height: number, width: number, quantum: number,
  ): Promise<Uint16Array> {
    return (await this.ranges(payload, codec, [{ height, width }], quantum))[0]!;
  }

  private async values(
    payload: Uint8Array, codec: number, height: number, width: number, quantum: number,
  ): Promise<Uint16Array> {
    if (codec === RAW && payload.length !== 2 * height * width) throw new RemoteWireError('raw range of another size');
    if (codec !== RAW && codec !== HTJ2K) throw new RemoteWireError(`no range codec ${codec}`);
    const shape = { height, width, components: 1 } as const;
    const bytes = codec === RAW ? payload : (await this.htj2k()).decode(payload, shape, LOSSLESS);
    const values = new Uint16Array(height * width);
    for (let index = 0; index < values.length; index++) {
      const value = bytes[2 * index]! | (bytes[2 * index + 1]! << 8);
      values[index] = Math.min(Math.max(value * quantum, 1), STEPS_MAX);
    }
    return values;
  }

  /** RGBA bytes, row by row, opaque. Throws RemoteWireError. */
  async texture(
    payload: Uint8Array, codec: number, height: number, width: number, quality: number,
  ): Promise<Uint8Array> {
    checkSize(payload, height, width, 3);
    if (codec === JPEG) return this.jpeg(restoreJpeg(payload, height, width, jpegQ(quality)), width, height);
    if (codec !== HTJ2K) throw new RemoteWireError(`no texture codec ${codec}`);
    const htj2k = await this.htj2k();
    if (quality !== LOSSLESS) return decodeColours(payload, height, width, quality, htj2k);
    return toRgba(htj2k.decode(payload, { height, width, components: 3 }, quality));
  }

  /** A byte a cell, 1 where void. Throws RemoteWireError. */
  async mask(payload: Uint8Array, height: number, width: number): Promise<Uint8Array> {
    checkSize(payload, height, width, 2);
    return decodeMask(payload, height, width);
  }
}

function checkSize(payload: Uint8Array, height: number, width: number, sampleBytes: number): void {
  checkLength(payload, checkShape(height, width), sampleBytes);
}

/** How many samples a shape has. */
function checkShape(height: number, width: number): number {
  const fits = height >= 1 && width >= 1 && Math.max(height, width) <= SIDE_MAX && height * width <= SAMPLES_MAX;
  if (!fits) throw new RemoteWireError(`payload of ${height} x ${width} samples`);
  return height * width;
}

function checkLength(payload: Uint8Array, samples: number, sampleBytes: number): void {
  if (samples > SAMPLES_MAX || payload.length > 4096 + 2 * sampleBytes * samples) {
    throw new RemoteWireError('payload is too long');
  }
}

function toRgba(rgb: Uint8Array): Uint8Array {
  const rgba = new Uint8Array((rgb.length / 3) * 4);
  for (let from = 0, to = 0; from < rgb.length; from += 3, to += 4) {
    rgba[to] = rgb[from]!;
    rgba[to + 1] = rgb[from + 1]!;
    rgba[to + 2] = rgb[from + 2]!;
    rgba[to + 3] = 255;
  }
  return rgba;
}
