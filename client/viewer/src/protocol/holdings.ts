// What both ends agree the client has: a level and a rank for every block, and a running digest.
// Mirrors protocol/holdings.py (PROTOCOL.md, "Holdings and adoption", "Digest").

import { crc32 } from './crc32.ts';
import { RemoteWireError } from './errors.ts';
import { blocksAcross, blocksDown, CHANNELS, coarseLevel, RANGE, TEXTURE } from './lattice.ts';
import type { Channel, ChannelShape, Lattice } from './lattice.ts';

export type Run = [count: number, level: number, rank: number];

const RANK_MARGIN = { [RANGE]: 1, [TEXTURE]: 3 };
const RANK_MAX = { [RANGE]: 65534, [TEXTURE]: 256 };
const SIDE = 8;
const IS_LITTLE = new Uint8Array(Uint16Array.of(1).buffer)[0] === 1;

/** Rank of a refinement's values: range by its quantum 1..65534, texture by its quality 0..255. */
export function rankOf(channel: Channel, quality: number): number {
  const fits = channel === RANGE ? quality >= 1 && quality <= 65534 : quality <= 255;
  if (!fits) throw new RemoteWireError(`quality ${quality} is off the scale`);
  return channel === RANGE ? 65535 - quality : quality + 1;
}

/** Holdings of one channel, block by block in row order. */
export class ChannelHoldings {
  readonly level: Uint8Array;
  readonly rank: Uint16Array;

  constructor(readonly shape: ChannelShape) {
    this.level = new Uint8Array(blocksAcross(shape) * blocksDown(shape)).fill(coarseLevel(shape));
    this.rank = new Uint16Array(this.level.length);
  }

  /** Which covered blocks a refinement would be adopted in, over the lattice's covered blocks. */
  adoptable(lattice: Lattice, rank: number): Uint8Array {
    const [columns, margin] = [blocksAcross(this.shape), RANK_MARGIN[this.shape.channel]];
    const coarse = coarseLevel(this.shape);
    const adopted = new Uint8Array(lattice.level.length);
    let index = 0;
    for (const row of lattice.y.block) {
      for (const column of lattice.x.block) {
        const level = lattice.level[index]!;
        const heldLevel = this.level[row * columns + column]!;
        const heldRank = this.rank[row * columns + column]!;
        const finer = level < heldLevel && rank >= heldRank;
        const better = level === heldLevel && rank >= heldRank + margin;
        adopted[index] = lattice.listed[index]! && level < coarse && (finer || better) ? 1 : 0;
        index++;
      }
    }
    return adopted;
  }

  /** Record that the adopted blocks now hold the lattice's level at `rank`. */
  adopt(lattice: Lattice, adopted: Uint8Array, rank: number): void {
    const columns = blocksAcross(this.shape);
    const wide = lattice.x.block.length;
    adopted.forEach((yes, index) => {
      if (!yes) return;
      const block = lattice.y.block[Math.floor(index / wide)]! * columns + lattice.x.block[index % wide]!;
      this.level[block] = lattice.level[index]!;
      this.rank[block] = rank;
    });
  }

  /** Run lengths in row order. */
  toRuns(): Run[] {
    const runs: Run[] = [];
    this.level.forEach((level, index) => {
      const [last, rank] = [runs.at(-1), this.rank[index]!];
      if (last && last[1] === level && last[2] === rank) last[0]++;
      else runs.push([1, level, rank]);
    });
    return runs;
  }

  /** Inverse of toRuns. Throws RemoteWireError unless every run is in bounds and all add up to the blocks. */
  static fromRuns(shape: ChannelShape, runs: number[][]): ChannelHoldings {
    const held = new ChannelHoldings(shape);
    const coarse = coarseLevel(shape);
    let at = 0;
    for (const [count = 0, level = -1, rank = -1] of runs) {
      const fits = count >= 1 && level >= 0 && level <= coarse && rank >= 0 && rank <= RANK_MAX[shape.channel];
      if (!fits || count > held.level.length - at) throw new RemoteWireError('holdings runs out of bounds');
      held.level.fill(level, at, at + count);
      held.rank.fill(rank, at, at + count);
      at += count;
    }
    if (at !== held.level.length) throw new RemoteWireError(`holdings runs must cover ${held.level.length} blocks`);
    return held;
  }
}

/** Holdings of both channels, and the digest that proves two ends agree. */
export class Holdings {
  readonly channels: Record<Channel, ChannelHoldings>;
  content = 0;

  constructor(shapes: Record<Channel, ChannelShape>) {
    this.channels = { [RANGE]: new ChannelHoldings(shapes[RANGE]), [TEXTURE]: new ChannelHoldings(shapes[TEXTURE]) };
  }

  /** Count the decoded range of an adopted block into the digest. */
  addContent(block: number, hash: number): void {
    this.content = (this.content + mix32((hash + Math.imul(0x9e3779b1, block + 1)) >>> 0)) >>> 0;
  }

  /** 16 hex digits: CRC-32 of all levels and ranks, then the sum of content. */
  digest(): string {
    let crc = 0;
    for (const channel of CHANNELS) {
      const { level, rank } = this.channels[channel];
      crc = crc32(littleEndian(rank), crc32(level, crc));
    }
    return [crc, this.content].map((word) => word.toString(16).padStart(8, '0')).join('');
  }
}

/** Spread a 32-bit value: the finaliser of MurmurHash3. */
export function mix32(value: number): number {
  let h = value;
  h = Math.imul(h ^ (h >>> 16), 0x85ebca6b);
  h = Math.imul(h ^ (h >>> 13), 0xc2b2ae35);
  return (h ^ (h >>> 16)) >>> 0;
}

const WEIGHTS = Int32Array.from({ length: SIDE * SIDE }, (_, index) => mix32(index + 1) | 1);

/** Hash of a rectangle of at most 8 x 8 decoded range cells; what is missing counts as 0. */
export function hashBlock(cells: Uint16Array, start: number, stride: number, width: number, height: number): number {
  let hash = 0;
  for (let y = 0; y < height; y++) {
    const row = start + y * stride;
    for (let x = 0; x < width; x++) hash = (hash + Math.imul(cells[row + x]!, WEIGHTS[SIDE * y + x]!)) | 0;
  }
  return hash >>> 0;
}

/** The bytes of 16-bit values as they travel, on any machine. */
export function littleEndian(values: Uint16Array): Uint8Array {
  if (IS_LITTLE) return new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
  const bytes = new Uint8Array(2 * values.length);
  values.forEach((value, index) => {
    bytes[2 * index] = value;
    bytes[2 * index + 1] = value >> 8;
  });
  return bytes;
}
