// Which samples a refinement carries, in integers only: mirrors protocol/lattice.py (PROTOCOL.md, "Lattice").
// Positions `at` are in quarter samples, `border` in half samples; every product stays below 2^53.

import { RemoteWireError } from './errors.ts';

export const RANGE = 0;
export const TEXTURE = 1;
export type Channel = typeof RANGE | typeof TEXTURE;
export const CHANNELS: readonly Channel[] = [RANGE, TEXTURE];

export const QUARTERS = 4;
/** How many columns apart the samples of a strip may stand, by the number on the wire: STRIDE_SETS of protocol/lattice.py. */
export const STRIDE_SETS = [[1, 2, 4, 8, 16], [1], [1, 2], [1, 2, 4], [1, 2, 4, 8], [1, 2, 8], [1, 4, 16]];
/** Their number where all strips travel as one image of a pole (polar.ts). */
export const POLAR = 7;
const POLAR_HALF_SPACING_MIN = 4;
const RHO_ONE = 1 << 16;
const RHO_MAX = 1 << 20;
const HALF_SPACINGS: Record<Channel, readonly number[]> = { [RANGE]: [2, 4, 8, 16], [TEXTURE]: [2, 3, 4, 6, 8, 12, 16] };

/** One channel of a scan, as far as lattices and holdings are concerned. */
export interface ChannelShape {
  channel: Channel;
  width: number;
  height: number;
  coarseWidth: number;
  coarseHeight: number;
  /** Rows are polar angles; near the poles they hold fewer samples of their own (rings.ts). */
  sphere?: boolean;
  /** Of a strip of such rows: how many columns apart these samples stand; 1 if it is not said. */
  stride?: number;
  /** And how many its rows' own do, at most; more where the stride was limited; 1 if it is not said. */
  ownStride?: number;
}

/** What travels of a lattice. */
export interface Parameters {
  halfSpacing: number;
  blockX: number;
  blockY: number;
  blocksWide: number;
  blocksHigh: number;
  rhoX: number;
  rhoY: number;
  listed: number[] | null;
  /** On a sphere which of STRIDE_SETS its strips may have; 0, all of them, if it is not said. */
  strides?: number;
}

/** One axis of a lattice: positions, the samples that stand there, and the blocks it covers. */
export interface Axis {
  at: number[];
  sample: number[];
  count: number;
  border: number[];
  block: number[];
  start: number[];
  stop: number[];
  gap: number[];
  first: number[];
  last: number[];
}

/** `level` and `listed` over the covered blocks, row by row. */
export interface Lattice {
  shape: ChannelShape;
  x: Axis;
  y: Axis;
  level: Uint8Array;
  listed: Uint8Array;
}

export const blockSide = (shape: ChannelShape): number => (shape.channel === RANGE ? 8 : 16);
export const blocksAcross = (shape: ChannelShape): number => Math.ceil(shape.width / blockSide(shape));
/** How many columns apart the samples stand that a row holds itself, and how many of them it has. */
export const strideOf = (shape: ChannelShape): number => shape.stride ?? 1;
export const ownWidth = (shape: ChannelShape): number => shape.width / strideOf(shape);
/** How many own samples right of a block its cells hang on: the next one, where there are cells between. */
export const beyond = (shape: ChannelShape): number => ((shape.ownStride ?? 1) > 1 ? 1 : 0);
export const blocksDown = (shape: ChannelShape): number => Math.ceil(shape.height / blockSide(shape));

/** Level of a block that holds nothing but the first view. */
export function coarseLevel(shape: ChannelShape): number {
  return Math.max(leastLevel(shape.width, shape.coarseWidth), leastLevel(shape.height, shape.coarseHeight));
}

function leastLevel(dense: number, coarse: number): number {
  let level = 0;
  while (dense * dense > coarse * coarse * 2 ** level) level++;
  return level;
}

/** Smallest L with g^2 <= 2^L, for a gap in quarter samples. */
export function levelOfGap(gap: number): number {
  let level = 0;
  while (gap * gap > QUARTERS * QUARTERS * 2 ** level) level++;
  return level;
}

/** Steps of a skirt, outward, in whole samples. */
export function skirtSteps(halfSpacing: number, rho: number, coarseSpacing: number, reach: number): number[] {
  const steps: number[] = [];
  let fixed = halfSpacing * 32768;
  while (reach > 0 && rho !== 0) {
    fixed = Math.floor((fixed * rho + 32768) / 65536);
    const step = Math.floor((fixed + 32768) / 65536);
    if (step > coarseSpacing) break;
    steps.push(step);
    reach -= step;
  }
  return steps;
}

/** Compute a lattice from what travelled. Throws RemoteWireError when the parameters describe none. */
export function buildLattice(shape: ChannelShape, p: Parameters): Lattice {
  checkParameters(shape, p);
  return latticeOf(shape, p, axisX(shape, p), axisY(shape, p));
}

/** The lattice over two axes. */
export function latticeOf(shape: ChannelShape, p: Parameters, x: Axis, y: Axis): Lattice {
  const [levelX, levelY] = [x.gap.map(levelOfGap), y.gap.map(levelOfGap)];
  const level = new Uint8Array(levelX.length * levelY.length);
  levelY.forEach((ly, row) => levelX.forEach((lx, column) => (level[row * levelX.length + column] = Math.max(lx, ly))));
  return { shape, x, y, level, listed: listedBlocks(shape, p, x, y) };
}

/** Whether strips travel as one image of a pole. */
export const isPolar = (p: Parameters): boolean => p.strides === POLAR;

function fitsPolar(shape: ChannelShape, p: Parameters): boolean {
  const [top, bottom] = [2 * p.blockY * blockSide(shape), 2 * (p.blockY + p.blocksHigh) * blockSide(shape)];
  const isPlain = p.rhoX === 0 && p.rhoY === 0 && p.halfSpacing >= POLAR_HALF_SPACING_MIN;
  return !!shape.sphere && shape.channel === TEXTURE && isPlain && (bottom <= shape.height || top >= shape.height);
}

/** Throws RemoteWireError unless the parameters describe a lattice. */
export function checkParameters(shape: ChannelShape, p: Parameters): void {
  const [rows, columns] = [blocksDown(shape), blocksAcross(shape)];
  const rhoFits = (rho: number) => rho === 0 || (rho >= RHO_ONE && rho <= RHO_MAX);
  const divides = (2 * shape.width) % p.halfSpacing === 0;
  const fits =
    HALF_SPACINGS[shape.channel].includes(p.halfSpacing) &&
    p.blockX >= 0 && p.blockX < columns && p.blocksWide >= 1 && p.blocksWide <= columns &&
    p.blockY >= 0 && p.blocksHigh >= 1 && p.blockY + p.blocksHigh <= rows &&
    rhoFits(p.rhoX) && rhoFits(p.rhoY) &&
    (isPolar(p) ? fitsPolar(shape, p) : (p.strides ?? 0) < (shape.sphere ? STRIDE_SETS.length : 1)) &&
    (shape.channel === TEXTURE || divides) &&
    (p.blocksWide < columns || (p.blockX === 0 && divides));
  if (!fits) throw new RemoteWireError(`no lattice: ${JSON.stringify(p)}`);
}

/** The x axis, in samples of a row's own. */
export function axisX(shape: ChannelShape, p: Parameters): Axis {
  const [width, block, columns] = [ownWidth(shape), blockSide(shape) / strideOf(shape), blocksAcross(shape)];
  if (p.blocksWide === columns) return ring(shape, p.halfSpacing);
  const end = p.blockX + p.blocksWide;
  const stop = end <= columns ? Math.min(end * block, width) : width + Math.min((end - columns) * block, width);
  const steps = halfSteps(shape, p.halfSpacing, p.rhoX, width, shape.coarseWidth);
  const border = growBoth(plateau(2 * p.blockX * block, 2 * stop, p.halfSpacing), steps, 2 * (width - 1));
  const at = positions(shape, border);
  return cover(at, counting(at.length), border, turns(shape, [-1, 0, 1], false), beyond(shape));
}

export function axisY(shape: ChannelShape, p: Parameters): Axis {
  const { height } = shape;
  const block = blockSide(shape);
  const stop = Math.min((p.blockY + p.blocksHigh) * block, height);
  const edge = shape.channel === TEXTURE ? 2 * height : 2 * (height - 1);
  const core = plateau(2 * p.blockY * block, 2 * stop, p.halfSpacing).map((mark) => Math.min(mark, edge));
  if (core.length > 1 && core.at(-1) === edge && core.at(-2) === edge) core.pop();
  const steps = halfSteps(shape, p.halfSpacing, p.rhoY, height, shape.coarseHeight);
  const [top, bottom] = [core[0]!, core.at(-1)!];
  const below = bottom < edge ? untilEdge(steps, bottom, edge) : [];
  const above = top > 0 ? untilEdge(steps, -top, 0).map((mark) => 0 - mark) : [];
  const border = [...above.reverse(), ...core, ...below];
  const [at, sample] = repeatEdges(positions(shape, border), shape, border);
  return cover(at, sample, border, turns(shape, [0], true));
}

function plateau(start: number, stop: number, halfSpacing: number): number[] {
  return counting(Math.ceil((stop - start) / halfSpacing) + 1).map((k) => start + halfSpacing * k);
}

function halfSteps(shape: ChannelShape, halfSpacing: number, rho: number, size: number, coarse: number): number[] {
  const steps = skirtSteps(halfSpacing, rho, Math.max(1, Math.floor(size / coarse)), size).map((step) => 2 * step);
  return shape.channel === TEXTURE && (halfSpacing > 2 || beyond(shape)) ? [halfSpacing, ...steps] : steps;
}

function growBoth(core: number[], steps: number[], span: number): number[] {
  const right = [core.at(-1)!];
  const left = [core[0]!];
  let [openRight, openLeft] = [true, true];
  for (const step of steps) {
    openRight &&= right.at(-1)! + step - left.at(-1)! <= span;
    if (openRight) right.push(right.at(-1)! + step);
    openLeft &&= right.at(-1)! - (left.at(-1)! - step) <= span;
    if (openLeft) left.push(left.at(-1)! - step);
  }
  return [...left.slice(1).reverse(), ...core, ...right.slice(1)];
}

function untilEdge(steps: number[], from: number, edge: number): number[] {
  const marks: number[] = [];
  let mark = from;
  for (const step of steps) {
    mark += step;
    if (mark >= edge) return [...marks, edge];
    marks.push(mark);
  }
  return marks;
}

function positions(shape: ChannelShape, border: number[]): number[] {
  if (shape.channel === RANGE) return border.map((mark) => 2 * mark);
  return counting(border.length - 1).map((k) => border[k]! + border[k + 1]! - 2);
}

function ring(shape: ChannelShape, halfSpacing: number): Axis {
  let border = counting((2 * ownWidth(shape)) / halfSpacing + 1).map((k) => k * halfSpacing);
  let at = positions(shape, border);
  if (shape.channel === RANGE) [at, border] = [at.slice(0, -1), border.slice(0, -1)];
  const [count, turn] = [at.length, QUARTERS * ownWidth(shape)];
  const sample = [count - 1, ...counting(count), 0];
  return cover([at.at(-1)! - turn, ...at, at[0]! + turn], sample, border, turns(shape, [0], false), beyond(shape));
}

function repeatEdges(at: number[], shape: ChannelShape, border: number[]): [number[], number[]] {
  let sample = counting(at.length);
  if (shape.channel === RANGE) return [at, sample];
  const cell = (k: number) => 2 * (border[k + 1]! - border[k]!);
  if (border[0] === 0) [at, sample] = [[at[0]! - cell(0), ...at], [0, ...sample]];
  if (border.at(-1) === 2 * shape.height) {
    [at, sample] = [[...at, at.at(-1)! + cell(border.length - 2)], [...sample, sample.at(-1)!]];
  }
  return [at, sample];
}

interface Blocks {
  block: number[];
  start: number[];
  stop: number[];
}

function turns(shape: ChannelShape, offsets: number[], vertical: boolean): Blocks {
  const size = vertical ? shape.height : ownWidth(shape);
  const side = blockSide(shape) / (vertical ? 1 : strideOf(shape));
  const all: Blocks = { block: [], start: [], stop: [] };
  for (const offset of offsets) {
    for (let index = 0; index < Math.ceil(size / side); index++) {
      all.block.push(index);
      all.start.push(index * side + offset * size);
      all.stop.push(Math.min((index + 1) * side, size) + offset * size);
    }
  }
  return all;
}

/**
 * Keep the blocks whose bilinear stencil lies inside the hull, with the widest interval each one touches.
 * further: how many positions past the block the stencil reaches.
 */
function cover(at: number[], sample: number[], border: number[], blocks: Blocks, further = 0): Axis {
  const count = sample.reduce((most, one) => Math.max(most, one), 0) + 1;
  const axis: Axis = { at, sample, count, border, block: [], start: [], stop: [], gap: [], first: [], last: [] };
  const alone = (k: number) =>
    border.length === count ? QUARTERS : 2 * (border[sample[k]! + 1]! - border[sample[k]!]!);
  let [first, last] = [-1, 0];
  blocks.block.forEach((block, index) => {
    const [start, stop] = [blocks.start[index]!, blocks.stop[index]!];
    while (first + 1 < at.length && at[first + 1]! <= QUARTERS * start) first++;
    while (last < at.length && at[last]! < QUARTERS * (stop - 1 + further)) last++;
    if (first < 0 || last >= at.length) return;
    let gap = last > first ? 0 : alone(first);
    for (let k = first; k < last; k++) gap = Math.max(gap, at[k + 1]! - at[k]!);
    axis.block.push(block);
    axis.start.push(start);
    axis.stop.push(stop);
    axis.gap.push(Math.max(gap, QUARTERS));
    axis.first.push(first);
    axis.last.push(last);
  });
  return axis;
}

function listedBlocks(shape: ChannelShape, p: Parameters, x: Axis, y: Axis): Uint8Array {
  const listed = new Uint8Array(x.block.length * y.block.length);
  if (p.listed === null) return listed.fill(1);
  const mask = runsToMask(p.listed, p.blocksWide * p.blocksHigh);
  const columns = blocksAcross(shape);
  y.block.forEach((by, j) => {
    const row = by - p.blockY;
    x.block.forEach((bx, i) => {
      const column = (bx - p.blockX + columns) % columns;
      const inside = row >= 0 && row < p.blocksHigh && column < p.blocksWide;
      listed[j * x.block.length + i] = inside ? mask[row * p.blocksWide + column]! : 0;
    });
  });
  return listed;
}

/** Run lengths, unlisted first, as a byte each. */
export function runsToMask(runs: number[], size: number): Uint8Array {
  const mask = new Uint8Array(size);
  let at = 0;
  runs.forEach((run, index) => {
    if (run > size - at) throw new RemoteWireError(`runs must add up to ${size} blocks`);
    mask.fill(index % 2, at, at + run);
    at += run;
  });
  if (at !== size) throw new RemoteWireError(`runs must add up to ${size} blocks`);
  return mask;
}

const counting = (count: number): number[] => Array.from({ length: count }, (_, index) => index);
