// The vectors that Python reads too: tests/golden at the top of the repository.

import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { RANGE, TEXTURE } from '../src/protocol/lattice.ts';
import type { ChannelShape } from '../src/protocol/lattice.ts';

const FOLDER = process.env['GOLDEN'] ?? '../../tests/golden';

export const bytes = (name: string): Uint8Array => new Uint8Array(readFileSync(join(FOLDER, name)));
export const json = (name: string): any => JSON.parse(readFileSync(join(FOLDER, name), 'utf8'));
export const words = (name: string): Uint16Array => new Uint16Array(bytes(name).buffer);
export const fromHex = (text: string): Uint8Array => new Uint8Array(Buffer.from(text, 'hex'));

export function sha256(...parts: ArrayLike<number>[]): string {
  const hash = createHash('sha256');
  for (const part of parts) hash.update(Uint8Array.from(part));
  return hash.digest('hex');
}

export function shapeOf(shape: any): ChannelShape {
  return { ...shape, channel: shape.channel === 'range' ? RANGE : TEXTURE };
}

/** RGB bytes as opaque RGBA. */
export function rgba(rgb: Uint8Array): Uint8Array {
  return Uint8Array.from({ length: (rgb.length / 3) * 4 }, (_, at) => (at % 4 === 3 ? 255 : rgb[(at >> 2) * 3 + (at % 4)]!));
}

/** Largest difference of RGBA cells from RGB ones. */
export function worst(cells: Uint8Array, rgb: Uint8Array): number {
  let most = 0;
  rgb.forEach((value, at) => (most = Math.max(most, Math.abs(value - cells[Math.floor(at / 3) * 4 + (at % 3)]!))));
  return most;
}
