// What a refinement carries of a sphere: its rows of blocks in strips that are as dense along as across. A cylinder is
// a single one. Mirrors protocol/strips.py (PROTOCOL.md, "Spheres").

import { HTJ2K } from './codec.ts';
import { RemoteWireError } from './errors.ts';
import type { ChannelHoldings } from './holdings.ts';
import {
  STRIDE_SETS, axisX, axisY, blockSide, blocksAcross, buildLattice, checkParameters, isPolar, latticeOf, runsToMask,
} from './lattice.ts';
import type { Axis, ChannelShape, Lattice, Parameters } from './lattice.ts';
import { polarImage } from './polar.ts';
import type { PolarImage } from './polar.ts';
import { select, selectionSamples } from './reconstruct.ts';
import type { Chosen, Selection } from './reconstruct.ts';
import { ringStrides } from './rings.ts';

const LENGTH_BYTES = 4;

/** The lattices of a refinement, top down; no block is covered by two. Throws RemoteWireError when there are none. */
export function buildStrips(shape: ChannelShape, p: Parameters): Lattice[] {
  if (!shape.sphere) return [buildLattice(shape, p)];
  checkParameters(shape, p);
  const y = axisY(shape, p);
  const [owns, strides] = [2, p.halfSpacing].map((half) => ringStrides(shape.width, shape.height, blockSide(shape), half));
  const allowed = STRIDE_SETS[isPolar(p) ? 0 : (p.strides ?? 0)]!;
  const strideOf = (block: number) => allowed.filter((stride) => stride <= strides![block]!).at(-1)!;
  const strips: Lattice[] = [];
  for (let begin = 0, end = 0; begin < y.block.length; begin = end) {
    const stride = strideOf(y.block[begin]!);
    while (end < y.block.length && strideOf(y.block[end]!) === stride) end++;
    const ownStride = Math.max(...y.block.slice(begin, end).map((block) => owns![block]!));
    const strip = buildStrip({ ...shape, stride, ownStride }, p, rowsOf(y, begin, end));
    if (strip) strips.push(strip);
  }
  return strips;
}

/** What a refinement at `rank` would carry to a client that holds `held`; nothing when nothing would be adopted. */
export function selectStrips(lattices: Lattice[], held: ChannelHoldings, rank: number): Chosen[] {
  return lattices.flatMap((lattice) => select(lattice, held, rank) ?? []);
}

/** The image that all strips travel in, of texture round a pole; null where each has its own. */
export function imageOfPole(shape: ChannelShape, p: Parameters, strips: Chosen[]): PolarImage | null {
  return isPolar(p) && strips.length ? polarImage(shape, p, strips.map(({ selection }) => selection)) : null;
}

/** Values in a payload. */
export function samplesOf(strips: Chosen[], pole: PolarImage | null = null): number {
  return pole ? pole.rows * pole.columns : strips.reduce((sum, { selection }) => sum + selectionSamples(selection), 0);
}

/** Rows of the image in which a selection's texels travel: on a sphere as HTJ2K an odd number, the last repeated. */
export function imageRows({ lattice, y }: Selection, codec: number): number {
  const rows = y.sample.length;
  return lattice.shape.sphere && codec === HTJ2K ? rows | 1 : rows;
}

/** A payload, or a mask, as the strips' own. Throws RemoteWireError. */
export function splitParts(data: Uint8Array, count: number): Uint8Array[] {
  if (count === 1 || data.length === 0) return Array.from({ length: count }, () => data);
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  let at = 0;
  const parts = Array.from({ length: count }, () => {
    if (at + LENGTH_BYTES > data.length) throw new RemoteWireError('what a strip carries is missing');
    const from = at + LENGTH_BYTES;
    at = from + view.getUint32(at, true);
    if (at > data.length) throw new RemoteWireError('what a strip carries is cut short');
    return data.subarray(from, at);
  });
  if (at !== data.length) throw new RemoteWireError(`${data.length - at} bytes after what the last strip carries`);
  return parts;
}

function buildStrip(shape: ChannelShape, p: Parameters, y: Axis): Lattice | null {
  const plateau = plateauColumns(shape, p, y.block);
  return plateau && latticeOf(shape, p, axisX(shape, { ...p, ...plateau }), y);
}

/** The shortest run of block columns with all that is listed in these block rows; null where nothing is. */
function plateauColumns(shape: ChannelShape, p: Parameters, rows: number[]): Pick<Parameters, 'blockX' | 'blocksWide'> | null {
  if (p.listed === null) return { blockX: p.blockX, blocksWide: p.blocksWide };
  const mask = runsToMask(p.listed, p.blocksWide * p.blocksHigh);
  const inside = rows.map((row) => row - p.blockY).filter((row) => row >= 0 && row < p.blocksHigh);
  const columns: number[] = [];
  for (let column = 0; column < p.blocksWide; column++) {
    if (inside.some((row) => mask[row * p.blocksWide + column])) columns.push(column);
  }
  if (!columns.length) return null;
  const allRound = blocksAcross(shape);
  const gaps = columns.map((column, index) => (columns[index + 1] ?? columns[0]! + allRound) - column);
  const widest = gaps.indexOf(Math.max(...gaps));
  const blocksWide = allRound - gaps[widest]! + 1;
  const first = (p.blockX + columns[(widest + 1) % columns.length]!) % allRound;
  return { blockX: blocksWide === allRound ? 0 : first, blocksWide };
}

/** An axis with some of its blocks. */
function rowsOf(y: Axis, begin: number, end: number): Axis {
  const part = (values: number[]) => values.slice(begin, end);
  return {
    ...y, block: part(y.block), start: part(y.start), stop: part(y.stop), gap: part(y.gap), first: part(y.first), last: part(y.last),
  };
}
