// From what travelled to the dense model: mirrors protocol/reconstruct.py.
// Range is interpolated exactly, so that every client gets the same grid; texture to within half a grey level.

import { RemoteWireError } from './errors.ts';
import { beyond, blockSide, blocksAcross, QUARTERS, strideOf } from './lattice.ts';
import type { Axis, ChannelShape, Lattice } from './lattice.ts';
import { hashBlock } from './holdings.ts';
import type { ChannelHoldings } from './holdings.ts';
import { ringStrides, widen } from './rings.ts';
import type { Samples } from './rings.ts';

/**
 * One axis of a selection: the run of covered blocks round the adopted ones, and the samples they need.
 * Positions are a row's own samples: all of them but on a sphere, and there, where cells lie between, one more than the
 * blocks hold. low, high: for each position the two transmitted samples beside it; part / whole: its place between them.
 */
export interface Window {
  block: number[];
  size: number[];
  start: number;
  sample: number[];
  low: Int32Array;
  high: Int32Array;
  part: Int32Array;
  whole: Int32Array;
}

/** What one refinement carries. The payload is an image: y.sample by x.sample. `adopted`: over the windows' blocks. */
export interface Selection {
  lattice: Lattice;
  y: Window;
  x: Window;
  adopted: Uint8Array;
}

/** A rectangle of a dense grid that does not cross the seam; `source`: its first column in the selection. */
export interface Span {
  x: number;
  y: number;
  width: number;
  height: number;
  source: number;
}

/** A selection, and the blocks that it is adopted in over its whole lattice. */
export interface Chosen {
  selection: Selection;
  adopted: Uint8Array;
}

export const selectionSamples = (s: Selection): number => s.y.sample.length * s.x.sample.length;

/** What a refinement at `rank` would carry to a client that holds `held`; null when nothing would be adopted. */
export function select(
  lattice: Lattice, held: ChannelHoldings, rank: number,
): Chosen | null {
  const adopted = held.adoptable(lattice, rank);
  const wide = lattice.x.block.length;
  let [top, bottom, left, right] = [Infinity, -1, Infinity, -1];
  adopted.forEach((yes, index) => {
    if (!yes) return;
    const [row, column] = [Math.floor(index / wide), index % wide];
    [top, bottom] = [Math.min(top, row), Math.max(bottom, row)];
    [left, right] = [Math.min(left, column), Math.max(right, column)];
  });
  if (bottom < 0) return null;
  const y = window(lattice.y, top, bottom + 1);
  const x = window(lattice.x, left, right + 1, beyond(lattice.shape));
  return { selection: { lattice, y, x, adopted: core(adopted, wide, top, bottom + 1, left, right + 1) }, adopted };
}

/** Of a selection planned over the first view alone, the blocks that make what we hold finer. */
export function onlyFiner(
  chosen: Chosen, held: ChannelHoldings, rank: number,
): Chosen {
  const { lattice, x, y } = chosen.selection;
  const now = held.adoptable(lattice, rank);
  const adopted = chosen.adopted.map((yes, index) => yes & now[index]!);
  const [top, left] = [lattice.y.start.indexOf(y.start), lattice.x.start.indexOf(x.start)];
  const finer = core(adopted, lattice.x.block.length, top, top + y.block.length, left, left + x.block.length);
  return { selection: { ...chosen.selection, adopted: finer }, adopted };
}

function core(
  adopted: Uint8Array, wide: number, top: number, bottom: number, left: number, right: number,
): Uint8Array {
  const part = new Uint8Array((bottom - top) * (right - left));
  for (let row = top; row < bottom; row++) {
    part.set(adopted.subarray(row * wide + left, row * wide + right), (row - top) * (right - left));
  }
  return part;
}

function window(axis: Axis, begin: number, end: number, further = 0): Window {
  const [beginAt, endAt] = [axis.first[begin]!, axis.last[end - 1]! + 1];
  const at = axis.at.slice(beginAt, endAt);
  const sample = [...new Set(axis.sample.slice(beginAt, endAt))].sort((a, b) => a - b);
  const place = new Map(sample.map((number, index) => [number, index]));
  const local = axis.sample.slice(beginAt, endAt).map((number) => place.get(number)!);
  const start = axis.start[begin]!;
  const cells = axis.stop[end - 1]! + further - start;
  const table = () => new Int32Array(cells);
  const [low, high, part, whole] = [table(), table(), table(), table().fill(1)];
  if (at.length > 1) {
    for (let cell = 0, k = 0; cell < cells; cell++) {
      const position = QUARTERS * (start + cell);
      while (k < at.length - 2 && at[k + 1]! <= position) k++;
      low[cell] = local[k]!;
      high[cell] = local[k + 1]!;
      part[cell] = position - at[k]!;
      whole[cell] = at[k + 1]! - at[k]!;
    }
  }
  const size = axis.stop.slice(begin, end).map((stop, index) => stop - axis.start[begin + index]!);
  return { block: axis.block.slice(begin, end), size, start, sample, low, high, part, whole };
}

/** Dense range of the windows' rectangle, by integer bilinear interpolation; every product stays below 2^53. */
export function rangePatch({ y, x }: Selection, samples: Uint16Array): Uint16Array {
  const [rows, columns, wide] = [y.low.length, x.low.length, x.sample.length];
  const patch = new Uint16Array(rows * columns);
  const across = new Float64Array(y.sample.length * columns);
  for (let row = 0; row < y.sample.length; row++) {
    for (let c = 0; c < columns; c++) {
      const low = samples[row * wide + x.low[c]!]!;
      const high = samples[row * wide + x.high[c]!]!;
      across[row * columns + c] = low * (x.whole[c]! - x.part[c]!) + high * x.part[c]!;
    }
  }
  for (let r = 0; r < rows; r++) {
    const low = y.low[r]! * columns;
    const high = y.high[r]! * columns;
    const part = y.part[r]!;
    const rest = y.whole[r]! - part;
    for (let c = 0; c < columns; c++) {
      const sum = across[low + c]! * rest + across[high + c]! * part;
      const whole = y.whole[r]! * x.whole[c]!;
      patch[r * columns + c] = ((2 * sum + whole) / (2 * whole)) | 0;
    }
  }
  return patch;
}

/** Dense texture of the windows' rectangle as RGBA, from RGBA samples; these themselves where each is a cell's. */
export function texturePatch({ y, x }: Selection, samples: Uint8Array): Uint8Array {
  const [rows, columns, wide] = [y.low.length, x.low.length, x.sample.length];
  if (isWhole(y) && isWhole(x)) return copyCells(samples, y, x);
  const patch = new Uint8Array(4 * rows * columns);
  const way = Float32Array.from(x.part, (part, c) => part / x.whole[c]!);
  const lines = new Map<number, Float32Array>();
  const line = (row: number): Float32Array => {
    let made = lines.get(row);
    if (!made) {
      lines.clear();
      lines.set(row, (made = stretch(samples, row * wide, x, way)));
    }
    return made;
  };
  let [above, below] = [-1, -1];
  let [aboveLine, belowLine]: Float32Array[] = [new Float32Array(), new Float32Array()];
  for (let r = 0; r < rows; r++) {
    if (y.low[r] !== above) {
      aboveLine = y.low[r] === below ? belowLine : line(y.low[r]!);
      above = y.low[r]!;
    }
    if (y.high[r] !== below) {
      belowLine = line(y.high[r]!);
      below = y.high[r]!;
    }
    const share = y.part[r]! / y.whole[r]!;
    for (let c = 0, at = 4 * r * columns; c < 4 * columns; c++, at++) {
      patch[at] = aboveLine[c]! + (belowLine[c]! - aboveLine[c]!) * share + 0.5;
    }
  }
  return patch;
}

function stretch(samples: Uint8Array, row: number, x: Window, way: Float32Array): Float32Array {
  const out = new Float32Array(4 * x.low.length);
  for (let c = 0; c < x.low.length; c++) {
    const low = 4 * (row + x.low[c]!);
    const high = 4 * (row + x.high[c]!);
    const share = way[c]!;
    for (let k = 0; k < 4; k++) out[4 * c + k] = samples[low + k]! + (samples[high + k]! - samples[low + k]!) * share;
  }
  return out;
}

const isWhole = (axis: Window): boolean => axis.part.every((part, index) => part === 0 || part === axis.whole[index]);

function copyCells(samples: Uint8Array, y: Window, x: Window): Uint8Array {
  const [rows, columns] = [y.low.length, x.low.length];
  const source = new Uint32Array(samples.buffer, samples.byteOffset, samples.length / 4);
  const patch = new Uint32Array(rows * columns);
  const nearest = (axis: Window, at: number) => (axis.part[at] === 0 ? axis.low[at]! : axis.high[at]!);
  const from = Int32Array.from({ length: columns }, (_, c) => nearest(x, c));
  const isRun = from.every((sample, c) => sample === from[0]! + c);
  const isAll = isRun && columns === x.sample.length && rows === y.sample.length && y.low.every((_, r) => nearest(y, r) === r);
  if (isAll) return samples;
  for (let r = 0; r < rows; r++) {
    const row = nearest(y, r) * x.sample.length;
    if (isRun) patch.set(source.subarray(row + from[0]!, row + from[0]! + columns), r * columns);
    else for (let c = 0; c < columns; c++) patch[r * columns + c] = source[row + from[c]!]!;
  }
  return new Uint8Array(patch.buffer);
}

/** Dense columns of the windows' rectangle. */
const denseColumns = ({ lattice: { shape }, x }: Selection): number => (x.low.length - beyond(shape)) * strideOf(shape);

/**
 * The windows' rectangle from a patch: cells between a row's own samples are interpolated. Where the strip's stride was
 * limited, a patch has more columns than some rows have samples: only these count there. parts: values of a sample.
 */
export function denseOf<T extends Samples>(patch: T, selection: Selection, parts: number): T {
  const { lattice: { shape }, x, y } = selection;
  if (!shape.sphere) return patch;
  const strides = ringStrides(shape.width, shape.height, blockSide(shape), 2);
  const [columns, line] = [denseColumns(selection), x.low.length * parts];
  const cells = new (patch.constructor as new (size: number) => T)(y.low.length * columns * parts);
  let [from, to] = [0, 0];
  y.block.forEach((block, j) => {
    const own = strides[block]!;
    for (let row = 0; row < y.size[j]!; row++, from += line, to += columns * parts) {
      if (own === 1) cells.set(patch.subarray(from, from + columns * parts), to);
      else widen(patch, from, own / strideOf(shape), cells, to, columns / own, own, parts);
    }
  });
  return cells;
}

/** Where the windows' rectangle lies in the dense grid, cut at the seam. */
export function spans(selection: Selection): Span[] {
  const { lattice: { shape }, y, x } = selection;
  const [{ width }, all, stride] = [shape, denseColumns(selection), strideOf(shape)];
  const parts: Span[] = [];
  for (let done = 0; done < all; ) {
    const column = (((x.start * stride + done) % width) + width) % width;
    const run = Math.min(all - done, width - column);
    parts.push({ x: column, y: y.start, width: run, height: y.low.length, source: done });
    done += run;
  }
  return parts;
}

type Cells = Uint16Array | Uint32Array;

/** Overwrite the adopted blocks of a dense array with the windows' rectangle; every other cell stays as it is. */
export function paste<T extends Cells>(dense: T, rectangle: T, selection: Selection): void {
  const { lattice: { shape }, x, y } = selection;
  const [{ width }, across] = [shape, denseColumns(selection)];
  for (const { row, column, height, wide } of adoptedRuns(selection)) {
    const start = (((x.start * strideOf(shape) + column) % width) + width) % width;
    for (let r = row; r < row + height; r++) {
      const from = r * across + column;
      dense.set(rectangle.subarray(from, from + wide) as never, (y.start + r) * width + start);
    }
  }
}

/** Adopted blocks beside each other as one, but not across the seam: a copy costs more to begin than to go on. */
function adoptedRuns(selection: Selection): Omit<AdoptedBlock, 'block'>[] {
  const { shape } = selection.lattice;
  const runs: Omit<AdoptedBlock, 'block'>[] = [];
  let next = -1;
  forEachAdopted(selection, ({ row, column, height, wide, block }) => {
    const last = runs.at(-1);
    const goesOn = last && last.row === row && last.column + last.wide === column && block === next;
    if (goesOn) last.wide += wide;
    else runs.push({ row, column, height, wide });
    next = (block + 1) % blocksAcross(shape) ? block + 1 : -1;
  });
  return runs;
}

/** An adopted block: its place in the windows' rectangle, its flat index in the grid. */
export interface AdoptedBlock {
  row: number;
  column: number;
  height: number;
  wide: number;
  block: number;
}

/** Every adopted block, row by row. No block crosses the seam: the last one is cut there. */
export function forEachAdopted(selection: Selection, visit: (block: AdoptedBlock) => void): void {
  const { y, x, adopted, lattice } = selection;
  const [columns, stride] = [blocksAcross(lattice.shape), strideOf(lattice.shape)];
  let [row, index] = [0, 0];
  y.block.forEach((by, j) => {
    let column = 0;
    x.block.forEach((bx, i) => {
      const [height, wide] = [y.size[j]!, x.size[i]! * stride];
      if (adopted[index++]) visit({ row, column, height, wide, block: by * columns + bx });
      column += wide;
    });
    row += y.size[j]!;
  });
}

/** Hashes of the adopted blocks of a dense range rectangle, with their flat indices. */
export function contentHashes(rectangle: Uint16Array, selection: Selection): [block: number, hash: number][] {
  const across = denseColumns(selection);
  const hashes: [number, number][] = [];
  forEachAdopted(selection, ({ row, column, height, wide, block }) => {
    hashes.push([block, hashBlock(rectangle, row * across + column, across, wide, height)]);
  });
  return hashes;
}

interface Between {
  low: Int32Array;
  high: Int32Array;
  part: Float64Array;
}

/** Dense range from the first view: bilinear between cell centres, voids left out; void where the nearest cell is. */
export function coarseToRange(coarse: Uint16Array, shape: ChannelShape): Uint16Array {
  const { width, height, coarseWidth } = shape;
  if (coarse.length !== coarseWidth * shape.coarseHeight) throw new RemoteWireError('first view of another shape');
  const x = betweenCentres(width, coarseWidth, true);
  const y = betweenCentres(height, shape.coarseHeight, false);
  const dense = new Uint16Array(width * height);
  const runs = runsBetween(x);
  // Of each coarse column, blended to one dense row: the weighted sum and the weight of what is measured.
  const [sum, weight] = [new Float64Array(coarseWidth), new Float64Array(coarseWidth)];
  for (let r = 0; r < height; r++) {
    const [top, bottom, down] = [y.low[r]! * coarseWidth, y.high[r]! * coarseWidth, y.part[r]!];
    const up = 2 * height - down;
    const near = down < height ? top : bottom;
    for (let k = 0; k < coarseWidth; k++) {
      const above = coarse[top + k]!;
      const below = coarse[bottom + k]!;
      sum[k] = up * above + down * below;
      weight[k] = (above && up) + (below && down);
    }
    for (const { begin, end, left, right } of runs) {
      const first = coarse[near + left]!;
      const last = coarse[near + right]!;
      if (!first && !last) continue;
      const sums = 2 * width * sum[left]!;
      const weights = 2 * width * weight[left]!;
      const rise = sum[right]! - sum[left]!;
      const more = weight[right]! - weight[left]!;
      // Where all is measured, a product instead of each quotient: half of 1 more keeps what is whole from falling below.
      const inverse = more ? 0 : 1 / (2 * weights);
      for (let c = begin; c < end; c++) {
        const east = x.part[c]!;
        if ((east < width ? first : last) === 0) continue;
        const whole = weights + east * more;
        const twice = 2 * (sums + east * rise) + whole;
        dense[r * width + c] = (inverse ? (twice + 0.5) * inverse : twice / (2 * whole)) | 0;
      }
    }
  }
  return dense;
}

/** Columns between the same two centres. */
function runsBetween({ low, high }: Between): { begin: number; end: number; left: number; right: number }[] {
  const runs: { begin: number; end: number; left: number; right: number }[] = [];
  for (let begin = 0, end = 0; begin < low.length; begin = end) {
    while (end < low.length && low[end] === low[begin] && high[end] === high[begin]) end++;
    runs.push({ begin, end, left: low[begin]!, right: high[begin]! });
  }
  return runs;
}

function betweenCentres(size: number, coarse: number, cyclic: boolean): Between {
  const place: Between = { low: new Int32Array(size), high: new Int32Array(size), part: new Float64Array(size) };
  const wrap = (cell: number) => (cyclic ? (cell + coarse) % coarse : Math.min(Math.max(cell, 0), coarse - 1));
  for (let index = 0; index < size; index++) {
    const position = (2 * index + 1) * coarse - size;
    const low = Math.floor(position / (2 * size));
    place.part[index] = position - low * 2 * size;
    place.low[index] = wrap(low);
    place.high[index] = wrap(low + 1);
  }
  return place;
}
