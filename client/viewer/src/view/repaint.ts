// Which part of the picture changes when samples do, where drawing all of it takes long.

import { Matrix4 } from 'three';
import type { PerspectiveCamera } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';

/** Blocks are so high, and a 90th of a turn wide: an arc of that stands out from its ends by 0.06% of its radius. */
const BLOCK_ROWS = 64;
const BLOCKS_ROUND = 90;
const MARGIN_PX = 2;

/** A part of the picture, from its left and top. [CSS px] */
export interface Part {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

/** Rows and columns of the grid; columns go round and round. */
interface Cells {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** Both parts and what lies between them; null is no part. */
export function joined(one: Part | null, other: Part | null): Part | null {
  if (!one || !other) return one ?? other;
  const [left, top] = [Math.min(one.left, other.left), Math.min(one.top, other.top)];
  return { left, top, right: Math.max(one.right, other.right), bottom: Math.max(one.bottom, other.bottom) };
}

/** Whole pixels inside a picture of this size; null where none are. */
export function within({ left, top, right, bottom }: Part, width: number, height: number): Part | null {
  const part = {
    left: Math.max(0, Math.floor(left)), top: Math.max(0, Math.floor(top)),
    right: Math.min(width, Math.ceil(right)), bottom: Math.min(height, Math.ceil(bottom)),
  };
  return part.right > part.left && part.bottom > part.top ? part : null;
}

/**
 * Where cells of a cylinder are seen in a picture of this size: round blocks of them, each between its nearest sample
 * and its farthest, of the samples that are drawn: every `stride`-th, and those of the last row. null where nothing was
 * measured; 'all' where something is beside or behind the camera.
 */
export function partOf(
  info: ScanInfo, steps: Uint16Array, cells: Cells, stride: number, camera: PerspectiveCamera, width: number, height: number,
): Part | 'all' | null {
  const { elements: e } = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  const [first, last] = [Math.max(0, below(cells.y, stride)), Math.min(info.height, cells.y + cells.height)];
  const end = cells.x + Math.min(cells.width, info.width);
  const [wide, high] = [info.width / BLOCKS_ROUND, BLOCK_ROWS].map((cells) => Math.max(stride, below(cells, stride)));
  for (let column = below(cells.x, stride); column < end; column += wide!) {
    const columns = Math.min(wide!, end - column);
    const angles = [column, column + columns].map((at) => info.theta0Rad + (2 * Math.PI * at) / info.width);
    const [cos, sin] = [angles.map(Math.cos), angles.map(Math.sin)];
    for (let row = first; row < last; row += high!) {
      const rows = Math.min(high!, last - row);
      const extremes = leastAndMost(info, steps, { x: column, y: row, width: columns, height: rows }, stride);
      for (let corner = extremes ? 0 : 8; corner < 8; corner++) {
        const radius = extremes![(corner >> 1) & 1]! * info.stepMm;
        const x = radius * cos[corner & 1]!;
        const y = info.zMaxMm - (row + (corner >> 2) * rows) * info.pitchMm;
        const z = -radius * sin[corner & 1]!;
        const w = e[3] * x + e[7] * y + e[11] * z + e[15];
        if (w <= camera.near) return 'all';
        const across = ((e[0] * x + e[4] * y + e[8] * z + e[12]) / w + 1) * (width / 2);
        const down = (1 - (e[1] * x + e[5] * y + e[9] * z + e[13]) / w) * (height / 2);
        left = Math.min(left, across);
        right = Math.max(right, across);
        top = Math.min(top, down);
        bottom = Math.max(bottom, down);
      }
    }
  }
  if (right < left) return null;
  return { left: left - MARGIN_PX, top: top - MARGIN_PX, right: right + MARGIN_PX, bottom: bottom + MARGIN_PX };
}

/** Least and largest drawn sample of a block; null where all are void. */
function leastAndMost({ width, height }: ScanInfo, steps: Uint16Array, cells: Cells, stride: number): [number, number] | null {
  let [least, most] = [0xffff, 0];
  const first = ((cells.x % width) + width) % width;
  const isLast = cells.y + cells.height === height;
  for (let row = cells.y; row < cells.y + cells.height + (isLast ? stride : 0); row += stride) {
    const from = Math.min(row, height - 1) * width;
    for (let across = 0; across < cells.width; across += stride) {
      const step = steps[from + ((first + across) % width)]!;
      if (step > most) most = step;
      if (step > 0 && step < least) least = step;
    }
  }
  return most ? [least, most] : null;
}

const below = (cell: number, stride: number): number => Math.floor(cell / stride) * stride;
