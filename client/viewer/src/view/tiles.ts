// Level of detail: the grid in square tiles, each drawn with every 1st, 2nd, 4th ... sample.

import type { PerspectiveCamera } from 'three';
import { Frustum, Matrix4, Sphere, Vector3 } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';
import { isSphere, pointAt, stepsAt } from './room.ts';

export const STRIDES = [1, 2, 4, 8, 16, 32] as const;
const BLOCK = 8;
/** Sine of the angle beyond which a tile counts as turned away. */
const AWAY = 0.35;

/**
 * How fine to draw: side of a tile [samples], side of a drawn cell on the screen, how much larger it is on what is turned
 * away and shows only through holes, and most triangles of a frame.
 */
export interface Detail {
  tileSide: number;
  cellPx: number;
  awayFactor: number;
  trianglesMax: number;
}

interface Tile {
  column: number;
  row: number;
  centre: Vector3;
  reachMm: number;
  /** Out of the surface, in the mean. */
  outward: Vector3;
  /** Finest stride that shows more than the samples held. */
  finest: number;
}

/** Rows and columns of the grid. */
interface Cells {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** Instances of one stride: tile corners, and strides of the four neighbours. */
export interface Batch {
  corners: number[];
  edges: number[];
  /** Of a sphere, what closes it over the poles: first column, and 0 above or 1 below. */
  fans: number[];
}

export class Tiles {
  private readonly tiles: Tile[] = [];
  readonly across: number;
  private readonly down: number;
  private readonly stride: Int32Array;
  private readonly frustum = new Frustum();
  private readonly ball = new Sphere();

  /** side: of a tile [samples]; a multiple of 64. thinned: no finer stride is drawn. */
  constructor(private readonly info: ScanInfo, private readonly side: number, private readonly thinned = 1) {
    this.across = Math.ceil(info.width / this.side);
    this.down = Math.ceil(info.height / this.side);
    this.stride = new Int32Array(this.across * this.down);
    for (let row = 0; row < this.down; row++) {
      for (let column = 0; column < this.across; column++) {
        this.tiles.push({ column: column * this.side, row: row * this.side, centre: new Vector3(), reachMm: 0, outward: new Vector3(), finest: 1 });
      }
    }
  }

  get count(): number {
    return this.tiles.length;
  }

  /** Look again where tiles lie and what they hold: all, or those that touch a rectangle. level: of 8 x 8 blocks. */
  update(steps: Uint16Array, level: Uint8Array, changed: Cells = { x: 0, y: 0, width: this.info.width, height: this.info.height }): void {
    const { width, height, stepMm, pitchMm } = this.info;
    const sphere = isSphere(this.info);
    for (const tile of this.tiles) {
      const [columns, rows] = [Math.min(this.side, width - tile.column), Math.min(this.side, height - tile.row)];
      const isBeside = tile.column >= changed.x + changed.width || tile.column + columns <= changed.x;
      if (isBeside || tile.row >= changed.y + changed.height || tile.row + rows <= changed.y) continue;
      let [least, most] = [0xffff, 0];
      for (let y = 0; y < rows; y += 4) {
        for (let x = 0; x < columns; x += 4) {
          const value = steps[(tile.row + y) * width + tile.column + x]!;
          if (value > most) most = value;
          if (value > 0 && value < least) least = value;
        }
      }
      const radius = (most ? (least + most) / 2 : 0) * stepMm;
      const [u, v] = [(tile.column + columns / 2) / width, (tile.row + rows / 2) / height];
      tile.centre.copy(pointAt(this.info, { u, v }, radius));
      const rowMm = sphere ? (radius * Math.PI) / height : pitchMm;
      const half = [(radius * Math.PI * columns) / width, (rows * rowMm) / 2, most ? ((most - least) * stepMm) / 2 : 0];
      tile.reachMm = most ? 1.3 * Math.hypot(...half) : 0;
      tile.outward.copy(this.outward(steps, tile, columns, rows, radius));
      tile.finest = this.finest(tile, columns, rows, level);
    }
  }

  /** From the middles of its sides; one that is void is as far out as the tile is in the mean. */
  private outward(steps: Uint16Array, { column, row }: Tile, columns: number, rows: number, radiusMm: number): Vector3 {
    const { width, height, stepMm } = this.info;
    const at = (x: number, y: number): Vector3 => {
      const own = stepsAt(this.info, steps, column + Math.floor(x * (columns - 1)), row + Math.floor(y * (rows - 1)));
      return pointAt(this.info, { u: (column + x * columns) / width, v: (row + y * rows) / height }, own * stepMm || radiusMm);
    };
    return at(0.5, 1).sub(at(0.5, 0)).cross(at(1, 0.5).sub(at(0, 0.5))).normalize();
  }

  /** Choose a stride for each tile. sidePx: height of the picture. Returns whether any is another than before. */
  choose(camera: PerspectiveCamera, sidePx: number, detail: Detail): boolean {
    this.look(camera);
    const focalPx = sidePx / (2 * Math.tan((camera.fov * Math.PI) / 360));
    const before = this.stride.slice();
    for (let cellPx = detail.cellPx; ; cellPx *= 1.5) {
      const triangles = this.pick(camera, focalPx, cellPx, detail.awayFactor);
      if (triangles <= detail.trianglesMax || cellPx > 64 * detail.cellPx) break;
    }
    return this.stride.some((stride, index) => stride !== before[index]);
  }

  /** Batches by stride index of the tiles chosen that a camera sees, perhaps one of a part of the picture. */
  batches(camera: PerspectiveCamera): Batch[] {
    this.look(camera);
    const batches: Batch[] = STRIDES.map(() => ({ corners: [], edges: [], fans: [] }));
    this.tiles.forEach((tile, index) => {
      if (this.stride[index] && this.sees(tile)) this.add(batches, tile, index);
    });
    return batches;
  }

  /** The finest and the coarsest stride of tiles drawn that these cells touch; [1, 1] where none is. */
  strides({ x, y, width, height }: Cells): [number, number] {
    const drawn: number[] = [];
    for (let row = Math.max(0, Math.floor(y / this.side)); row < Math.min(this.down, Math.ceil((y + height) / this.side)); row++) {
      for (let column = Math.floor(x / this.side); column < Math.ceil((x + width) / this.side); column++) {
        const stride = this.stride[row * this.across + ((column % this.across) + this.across) % this.across]!;
        if (stride) drawn.push(stride);
      }
    }
    return drawn.length ? [Math.min(...drawn), Math.max(...drawn)] : [1, 1];
  }

  private look(camera: PerspectiveCamera): void {
    this.frustum.setFromProjectionMatrix(new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse));
  }

  private sees({ centre, reachMm }: Tile): boolean {
    return reachMm > 0 && this.frustum.intersectsSphere(this.ball.set(centre, reachMm));
  }

  private pick(camera: PerspectiveCamera, focalPx: number, cellPx: number, awayFactor: number): number {
    let triangles = 0;
    const sight = new Vector3();
    this.tiles.forEach((tile, index) => {
      const seen = this.sees(tile);
      const distance = Math.max(camera.position.distanceTo(tile.centre) - tile.reachMm, camera.near);
      const samplePx = (this.info.pitchMm * focalPx) / distance;
      const isAway = sight.subVectors(tile.centre, camera.position).normalize().dot(tile.outward) > AWAY;
      const wanted = Math.max((cellPx / samplePx) * (isAway ? awayFactor : 1), tile.finest);
      const stride = Math.min(2 ** Math.max(0, Math.floor(Math.log2(wanted))), STRIDES.at(-1)!);
      this.stride[index] = seen ? stride : 0;
      triangles += seen ? 2 * (this.side / stride) ** 2 : 0;
    });
    return triangles;
  }

  private add(batches: Batch[], tile: Tile, index: number): void {
    const stride = this.stride[index]!;
    const [x, y] = [index % this.across, Math.floor(index / this.across)];
    const beside = (dx: number, dy: number): number => {
      const row = y + dy;
      if (row < 0 || row >= this.down) return stride;
      return Math.max(stride, this.stride[row * this.across + ((x + dx + this.across) % this.across)]!);
    };
    const batch = batches[Math.log2(stride)]!;
    batch.corners.push(tile.column, tile.row);
    batch.edges.push(beside(-1, 0), beside(1, 0), beside(0, -1), beside(0, 1));
    if (!isSphere(this.info)) return;
    if (y === 0) batch.fans.push(tile.column, 0);
    if (y === this.down - 1) batch.fans.push(tile.column, 1);
  }

  private finest(tile: Tile, columns: number, rows: number, level: Uint8Array): number {
    const across = Math.ceil(this.info.width / BLOCK);
    let least = Infinity;
    for (let y = tile.row / BLOCK; y < (tile.row + rows) / BLOCK; y++) {
      for (let x = tile.column / BLOCK; x < (tile.column + columns) / BLOCK; x++) if (level[y * across + x]! < least) least = level[y * across + x]!;
    }
    return Math.max(this.thinned, 2 ** Math.floor(least / 2 - 1));
  }
}
