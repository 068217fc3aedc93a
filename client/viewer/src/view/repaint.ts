// Which part of the picture changes when samples do, where drawing all of it takes long.

import { Matrix4, Vector3 } from 'three';
import type { PerspectiveCamera } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';
import { pointAt } from './room.ts';

const BLOCK = 16;
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
 * and its farthest. null where nothing was measured; 'all' where one is beside or behind the camera.
 */
export function partOf(
  info: ScanInfo, steps: Uint16Array, cells: Cells, camera: PerspectiveCamera, width: number, height: number,
): Part | 'all' | null {
  const { elements: e } = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  const part = { left: Infinity, top: Infinity, right: -Infinity, bottom: -Infinity };
  const see = ({ x, y, z }: Vector3): boolean => {
    const w = e[3] * x + e[7] * y + e[11] * z + e[15];
    if (w <= camera.near) return false;
    const across = ((e[0] * x + e[4] * y + e[8] * z + e[12]) / w + 1) * (width / 2);
    const down = (1 - (e[1] * x + e[5] * y + e[9] * z + e[13]) / w) * (height / 2);
    [part.left, part.right] = [Math.min(part.left, across), Math.max(part.right, across)];
    [part.top, part.bottom] = [Math.min(part.top, down), Math.max(part.bottom, down)];
    return true;
  };
  const [first, last] = [Math.max(0, cells.y), Math.min(info.height, cells.y + cells.height)];
  const columns = Math.min(cells.width, info.width);
  for (let row = first; row < last; row += BLOCK) {
    const rows = Math.min(BLOCK, last - row);
    for (let column = 0; column < columns; column += BLOCK) {
      const [x, wide] = [cells.x + column, Math.min(BLOCK, columns - column)];
      const [least, most] = extremes(info, steps, x, row, wide, rows);
      for (const radius of most ? [least, most] : []) {
        for (const [dx, dy] of [[0, 0], [wide, 0], [0, rows], [wide, rows]] as const) {
          const place = { u: (x + dx) / info.width, v: (row + dy) / info.height };
          if (!see(pointAt(info, place, radius * info.stepMm))) return 'all';
        }
      }
    }
  }
  if (part.right < part.left) return null;
  return { left: part.left - MARGIN_PX, top: part.top - MARGIN_PX, right: part.right + MARGIN_PX, bottom: part.bottom + MARGIN_PX };
}

/** Least and largest sample of a block, [0, 0] where all are void. */
function extremes({ width }: ScanInfo, steps: Uint16Array, x: number, y: number, columns: number, rows: number): [number, number] {
  let [least, most] = [Infinity, 0];
  for (let row = y; row < y + rows; row++) {
    for (let column = x; column < x + columns; column++) {
      const step = steps[row * width + ((column % width) + width) % width]!;
      if (step && step < least) least = step;
      if (step > most) most = step;
    }
  }
  return most ? [least, most] : [0, 0];
}
