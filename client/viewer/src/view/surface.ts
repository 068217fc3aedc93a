// One scan on the graphics card: range, normals, colour and levels as textures, drawn in tiles.

import {
  ClampToEdgeWrapping, DataTexture, Group, LinearFilter, LinearMipmapLinearFilter, NearestFilter, NoColorSpace,
  RedIntegerFormat, RepeatWrapping, RGBAFormat, UnsignedByteType, UnsignedShortType, Vector2, Vector3,
} from 'three';
import type { PerspectiveCamera, Texture, WebGLRenderer } from 'three';
import type { Snapshot } from '../link.ts';
import { RANGE, TEXTURE } from '../protocol/lattice.ts';
import type { Channel } from '../protocol/lattice.ts';
import type { ScanInfo } from '../protocol/messages.ts';
import type { Changed } from '../protocol/model.ts';
import { evened } from './coarse_colours.ts';
import { compile } from './compile.ts';
import { fan, fill, gridMesh, overlay, tileGrid } from './grid_mesh.ts';
import type { GridMesh, Uniforms } from './grid_mesh.ts';
import { Normals } from './normals.ts';
import { joined, partOf } from './repaint.ts';
import type { Part } from './repaint.ts';
import { isSphere } from './room.ts';
import type { Place } from './room.ts';
import { shrink, thin } from './shrink.ts';
import type { Samples } from './shrink.ts';
import { STRIDES, Tiles } from './tiles.ts';
import type { Detail } from './tiles.ts';

export const SHADINGS = ['lit', 'relief', 'flat'] as const;
export type Shading = (typeof SHADINGS)[number];
const RANGE_BLOCK = 8;
const TEXTURE_BLOCK = 16;

export class Surface {
  readonly object = new Group();
  readonly steps: Uint16Array;
  /** How many texels of the scan stand for one here, across and down, where the graphics card takes no larger texture. */
  readonly shrunk: readonly [across: number, down: number];
  /** Every how many-th sample is drawn, where it takes no larger texture; a power of two. */
  readonly thinned: number;
  private readonly tiles: Tiles;
  /** By stride, made when first drawn; and of a sphere, what closes it over its poles. */
  private readonly meshes: (GridMesh | undefined)[] = [];
  private readonly fans: (GridMesh | undefined)[] = [];
  private readonly range: DataTexture;
  private readonly levels: [range: DataTexture, texture: DataTexture];
  private readonly coarse: DataTexture;
  private dense: DataTexture;
  private readonly normals: Normals;
  isReady = false;
  private isOverlaid = false;
  private readonly uniforms: Uniforms;

  constructor(
    private readonly renderer: WebGLRenderer, readonly info: ScanInfo, snapshot: Omit<Snapshot, 'info'>,
    private readonly mipmaps: boolean, private readonly tileSide: number,
  ) {
    const { width, height } = info;
    const most = renderer.capabilities.maxTextureSize;
    this.thinned = 2 ** Math.ceil(Math.log2(Math.max(1, width / most, height / most)));
    this.shrunk = [Math.ceil(info.textureWidth / most), Math.ceil(info.textureHeight / most)];
    this.steps = snapshot.steps;
    this.range = integers(this.thin({ x: 0, y: 0, width, height, cells: this.steps }));
    this.levels = [
      integers({ cells: snapshot.levels[0], width: Math.ceil(width / RANGE_BLOCK), height: Math.ceil(height / RANGE_BLOCK) }),
      integers({ cells: snapshot.levels[1], width: Math.ceil(info.textureWidth / TEXTURE_BLOCK), height: Math.ceil(info.textureHeight / TEXTURE_BLOCK) }),
    ];
    const [coarseWidth, coarseHeight] = [info.coarseTextureWidth, info.coarseTextureHeight];
    const coarse = isSphere(info) ? evened(snapshot.coarseTexels, coarseWidth, coarseHeight) : snapshot.coarseTexels;
    this.coarse = colours(coarse, coarseWidth, coarseHeight);
    this.dense = colours(new Uint8Array(4), 1, 1);
    this.uniforms = {
      uRange: { value: this.range }, uShift: { value: Math.log2(this.thinned) }, uSize: { value: new Vector2(width, height) }, uStepMm: { value: info.stepMm },
      uPitchMm: { value: info.pitchMm }, uZMaxMm: { value: info.zMaxMm }, uTheta0: { value: info.theta0Rad },
      uPoles: { value: new Vector2() }, uTile: { value: tileSide }, uNormals: { value: null }, uCoarse: { value: this.coarse },
      uDense: { value: this.dense }, uLevel: { value: this.levels[0] }, uLevelScale: { value: new Vector2() },
      uKey: { value: new Vector3() }, uFill: { value: new Vector3() }, uMode: { value: 0 },
    };
    this.tiles = new Tiles(info, tileSide, this.thinned);
    this.closePoles();
    this.tiles.update(this.steps, snapshot.levels[0]);
    this.normals = new Normals(renderer, width, height, this.thinned, this.uniforms, isSphere(info), this.levels[0], spacingOf(snapshot.levels[0]));
  }

  /** Have all programs compiled; meanwhile nothing is drawn. */
  async compile(camera: PerspectiveCamera): Promise<void> {
    this.meshOf(STRIDES.length - 1); // one will do: all are drawn by the same program
    await Promise.all([compile(this.renderer, this.object, camera), this.normals.compile()]);
  }

  /** Have the program compiled that `makeReady` takes. */
  compileMore(): Promise<void> {
    return this.normals.compileFill();
  }

  /** Do what the first picture could do without, so that the first look need not wait for it. */
  makeReady(): void {
    this.isReady = true;
    this.normals.fill();
    // three.js asks the card about uploads once, and waits for the answer.
    this.upload(integers({ cells: this.steps.slice(0, 1), width: 1, height: 1 }), this.range, 0, 0);
  }

  /** Samples from one that is held to the next, at a place. */
  spacingAt({ u, v }: Place): number {
    const { data, width } = this.levels[0].image as { data: Uint8Array; width: number };
    const [column, row] = [Math.floor(u * this.info.width), Math.floor(v * this.info.height)];
    return 2 ** (data[Math.floor(row / RANGE_BLOCK) * width + Math.floor(column / RANGE_BLOCK)]! / 2);
  }

  /** Take rectangles that have changed, and the levels then held. */
  patch(channel: Channel, changed: Changed[], level: Uint8Array): void {
    const levels = this.levels[channel];
    (levels.image.data as Uint8Array).set(level);
    levels.needsUpdate = true;
    if (channel === RANGE) this.patchRange(changed, level);
    else this.patchTexels(changed);
  }

  /** Have the card draw the normals of what has changed. */
  drawNormals(): void {
    this.normals.drawDue();
    this.renderer.getContext().flush();
  }

  /** Show another picture of the same shape, as while a sweep runs. */
  replace(steps: Uint16Array, coarseTexels: Uint8Array): void {
    this.steps.set(steps);
    const { width, height } = this.info;
    (this.range.image.data as Uint16Array).set(this.thin({ x: 0, y: 0, width, height, cells: steps }).cells);
    (this.coarse.image.data as Uint8Array).set(coarseTexels);
    this.range.needsUpdate = this.coarse.needsUpdate = true;
    this.tiles.update(this.steps, this.levels[0].image.data as Uint8Array);
    this.normals.changeAll();
  }

  /** How to shade, and whose spacing to lay over it. */
  show(shading: Shading, shown: Channel | null): void {
    const levels = this.levels[shown ?? RANGE];
    this.uniforms['uMode']!.value = SHADINGS.indexOf(shading);
    this.uniforms['uLevel']!.value = levels;
    const { width, height, textureWidth, textureHeight } = this.info;
    const scale = shown === TEXTURE ? [textureWidth / TEXTURE_BLOCK, textureHeight / TEXTURE_BLOCK] : [width / RANGE_BLOCK, height / RANGE_BLOCK];
    (this.uniforms['uLevelScale']!.value as Vector2).set(scale[0]!, scale[1]!);
    if (this.isOverlaid === (shown !== null)) return;
    this.isOverlaid = shown !== null;
    for (const mesh of [...this.meshes, ...this.fans]) if (mesh) overlay(mesh, isSphere(this.info), this.isOverlaid);
  }

  /** Choose how finely tiles are drawn for a camera. Returns whether any is drawn otherwise than before. */
  choose(camera: PerspectiveCamera, sidePx: number, detail: Detail): boolean {
    return this.tiles.choose(camera, sidePx, detail);
  }

  /** Draw what a camera sees, perhaps one of a part of the picture, lit from it. Returns the triangles to be drawn. */
  prepare(camera: PerspectiveCamera): number {
    this.normals.drawDue();
    const batches = this.tiles.batches(camera);
    const triangles = batches.reduce((sum, { corners }, index) => sum + corners.length * (this.tileSide / STRIDES[index]!) ** 2, 0);
    batches.forEach(({ corners, edges, fans }, index) => {
      if (corners.length || this.meshes[index]) fill(this.meshOf(index).geometry, corners, edges);
      if (fans.length || this.fans[index]) fill(this.fanOf(index).geometry, fans, []);
    });
    (this.uniforms['uKey']!.value as Vector3).set(-0.45, 0.55, 0.8).normalize().transformDirection(camera.matrixWorld);
    (this.uniforms['uFill']!.value as Vector3).set(0.8, 0.05, 0.45).normalize().transformDirection(camera.matrixWorld);
    return triangles;
  }

  /** Where rectangles of a channel are seen in a picture, as far as they change it; 'all' where that is not known. */
  seenAt(channel: Channel, changed: Changed[], camera: PerspectiveCamera, width: number, height: number): Part | 'all' | null {
    if (isSphere(this.info) || !this.normals.isFull) return 'all';
    let part: Part | null = null;
    for (const rectangle of changed) {
      const cells = channel === RANGE ? grown(rectangle, this.normals.reach) : this.cellsOf(rectangle);
      const [finest, coarsest] = this.tiles.strides(grown(cells, 2 * STRIDES.at(-1)!));
      const seen = partOf(this.info, this.steps, grown(cells, 2 * coarsest), finest, camera, width, height);
      if (seen === 'all') return seen;
      part = joined(part, seen);
    }
    return part;
  }

  /** The range cells under texels. */
  private cellsOf({ x, y, width, height }: Changed): Omit<Changed, 'cells'> {
    const [across, down] = [this.info.width / this.info.textureWidth, this.info.height / this.info.textureHeight];
    const [left, top] = [Math.floor(x * across) - 1, Math.floor(y * down) - 1];
    return { x: left, y: top, width: Math.ceil((x + width) * across) + 1 - left, height: Math.ceil((y + height) * down) + 1 - top };
  }

  dispose(): void {
    for (const texture of [this.range, ...this.levels, this.coarse, this.dense]) texture.dispose();
    this.normals.dispose();
    for (const mesh of [...this.meshes, ...this.fans]) {
      mesh?.geometry.dispose();
      mesh?.material.dispose();
    }
  }

  private meshOf(index: number): GridMesh {
    const stride = STRIDES[index]!;
    return (this.meshes[index] ??= this.added(gridMesh(tileGrid(this.tileSide / stride), stride, this.tiles.count, this.uniforms, isSphere(this.info))));
  }

  private fanOf(index: number): GridMesh {
    const stride = STRIDES[index]!;
    return (this.fans[index] ??= this.added(gridMesh(fan(this.tileSide / stride), stride, 2 * this.tiles.across, this.uniforms, true, true)));
  }

  private added(mesh: GridMesh): GridMesh {
    if (this.isOverlaid) overlay(mesh, isSphere(this.info), true);
    this.object.add(mesh);
    return mesh;
  }

  private patchRange(changed: Changed[], level: Uint8Array): void {
    for (const { x, y, width, height, cells } of changed) {
      for (let row = 0; row < height; row++) {
        this.steps.set((cells as Uint16Array).subarray(row * width, (row + 1) * width), (y + row) * this.info.width + x);
      }
      const drawn = this.thin({ x, y, width, height, cells: cells as Uint16Array });
      if (drawn.cells.length) this.upload(integers(drawn), this.range, drawn.x, drawn.y);
      this.normals.change({ x, y, width, height });
      this.tiles.update(this.steps, level, { x, y, width, height });
    }
    this.closePoles();
  }

  /** The samples of a rectangle that are drawn, and where they lie in the texture. */
  private thin(samples: Samples): Samples {
    return this.thinned === 1 ? samples : thin(samples, this.thinned);
  }

  private patchTexels(changed: Changed[]): void {
    if (this.dense.image.width === 1) this.makeDense();
    changed.forEach(({ x, y, width, height, cells }, index) => {
      const last = index === changed.length - 1;
      this.dense.generateMipmaps = this.mipmaps && last;
      const smaller = shrink({ x, y, width, height, cells: cells as Uint8Array }, this.shrunk);
      this.upload(colours(smaller.cells, smaller.width, smaller.height), this.dense, smaller.x, smaller.y);
    });
  }

  /** The refined colour's texture, transparent; it takes memory only once something is refined. */
  private makeDense(): void {
    this.dense.dispose();
    const [width, height] = [Math.ceil(this.info.textureWidth / this.shrunk[0]), Math.ceil(this.info.textureHeight / this.shrunk[1])];
    this.dense = colours(null, width, height);
    this.dense.source.dataReady = false; // nothing to send: the card clears it
    this.dense.minFilter = this.mipmaps ? LinearMipmapLinearFilter : LinearFilter;
    this.dense.anisotropy = this.mipmaps ? Math.min(4, this.renderer.capabilities.getMaxAnisotropy()) : 1;
    this.dense.generateMipmaps = this.mipmaps;
    this.uniforms['uDense']!.value = this.dense;
  }

  private upload(source: DataTexture, target: Texture, x: number, y: number): void {
    this.renderer.copyTextureToTexture(source, target, null, new Vector2(x, y));
    source.dispose();
  }

  /** The poles of a sphere stand as far out as the row next to them does in the mean. */
  private closePoles(): void {
    if (!isSphere(this.info)) return;
    const { width, height } = this.info;
    const poles = [0, height - 1].map((row) => {
      const measured = this.steps.subarray(row * width, (row + 1) * width).filter((step) => step > 0);
      return measured.reduce((sum, step) => sum + step, 0) / Math.max(measured.length, 1);
    });
    (this.uniforms['uPoles']!.value as Vector2).set(poles[0]!, poles[1]!);
  }
}

function integers({ cells, width, height }: { cells: Uint8Array | Uint16Array; width: number; height: number }): DataTexture {
  const isByte = cells instanceof Uint8Array;
  const texture = new DataTexture(cells as Uint16Array<ArrayBuffer>, width, height, RedIntegerFormat, isByte ? UnsignedByteType : UnsignedShortType);
  texture.internalFormat = isByte ? 'R8UI' : 'R16UI';
  texture.minFilter = texture.magFilter = NearestFilter;
  texture.unpackAlignment = cells.BYTES_PER_ELEMENT;
  texture.colorSpace = NoColorSpace;
  texture.needsUpdate = true;
  return texture;
}

function colours(data: Uint8Array | null, width: number, height: number): DataTexture {
  const texture = new DataTexture(data as Uint8Array<ArrayBuffer> | null, width, height, RGBAFormat, UnsignedByteType);
  texture.minFilter = texture.magFilter = LinearFilter;
  texture.wrapS = RepeatWrapping;
  texture.wrapT = ClampToEdgeWrapping;
  texture.colorSpace = NoColorSpace;
  texture.needsUpdate = true;
  return texture;
}

/** A rectangle with so many cells more on all sides. */
function grown({ x, y, width, height }: Omit<Changed, 'cells'>, by: number): Omit<Changed, 'cells'> {
  return { x: x - by, y: y - by, width: width + 2 * by, height: height + 2 * by };
}

/** Samples from one that is held to the next, where they are densest, and where least dense. level: twice the logarithm of that. */
function spacingOf(level: Uint8Array): [least: number, most: number] {
  const least = level.reduce((least, one) => Math.min(least, one), 255);
  const most = level.reduce((most, one) => Math.max(most, one), 0);
  return [2 ** Math.floor(least / 2), 2 ** (most / 2)];
}
