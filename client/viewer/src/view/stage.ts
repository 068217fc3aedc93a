// The picture: renderer, camera and controls, one surface; drawn only when something has changed.

import { PerspectiveCamera, Scene, Vector3 } from 'three';
import type { WebGLRenderer } from 'three';
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import type { Snapshot } from '../link.ts';
import { RANGE } from '../protocol/lattice.ts';
import type { Channel } from '../protocol/lattice.ts';
import type { Changed } from '../protocol/model.ts';
import { FACING_RAD } from '../facing.ts';
import { cardIsDone } from './compile.ts';
import { boundsOf, FIELD_OF_VIEW_DEG, fittingDistance } from './framing.ts';
import { drawsInSoftware } from './renderer.ts';
import { geometryOf, isSphere } from './room.ts';
import type { Geometry, Place } from './room.ts';
import { within as inside, joined } from './repaint.ts';
import type { Part } from './repaint.ts';
import { Sight } from './sight.ts';
import { Surface } from './surface.ts';
import type { Shading } from './surface.ts';
import type { Detail } from './tiles.ts';

const HARDWARE: Detail = { tileSide: 64, cellPx: 2, awayFactor: 1, trianglesMax: 3e6 };
/** Fewer, larger tiles: a processor spends more on each one than on its triangles. */
const SOFTWARE: Detail = { tileSide: 128, cellPx: 14, awayFactor: 2, trianglesMax: 1.5e5 };
/** Drawn larger than shown, so that edges are smooth. */
const SMOOTH_RATIO = 1.5;
const SLOW_FRAME_MS = 40;
const QUICK_FRAME_MS = 22;
const PACE_MAX = 6;
const LEISURE_MS = 300;
const TURN_STEP_RAD = Math.PI / 24;
const ZOOM_STEP = 1.2;
const ELEVATION_MAX_RAD = 1.5;

/** Where the camera stands: angles [rad], distance and target [mm]. */
export interface CameraPlace {
  azimuth: number;
  elevation: number;
  distance: number;
  target: [number, number, number];
}

/** What has programs of its own. */
type Kind = `${Geometry}${'' | ', overlaid'}`;

export interface StageEvents {
  /** A picture was drawn: marks on it must move along. */
  drawn(): void;
  /** The camera has moved, or starts or ends to. */
  moved(): void;
  /** The camera has come to rest. */
  settled(): void;
  /** Graphics memory was lost, and is there again: everything must be shown anew. */
  restored(): void;
  lost(): void;
}

export class Stage {
  private readonly software: boolean;
  private readonly detail: Detail;
  private readonly canvas: HTMLCanvasElement;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 1, 1000);
  private readonly controls: OrbitControls;
  /** What lies under which point of the picture. */
  readonly sight: Sight;
  private surface: Surface | null = null;
  /**
   * The smallest surface of each kind, once its programs are compiled; while it is kept, so are they. Until then nothing
   * of that kind can be drawn without waiting for them.
   */
  private readonly smallest = new Map<Kind, Surface>();
  private readonly warming = new Set<Kind>();
  private shading: Shading = 'lit';
  private overlay: Channel | null = null;
  /** Of the picture, in CSS px: asking the canvas would have the browser lay the page out each time. */
  private width = 1;
  private height = 1;
  private asked = false;
  /** What is to be drawn anew. */
  private due: Part | 'all' | null = 'all';
  /** Whether the camera is being moved by hand, not only held. */
  moving = false;
  private isHeld = false;
  /** Nobody has moved the camera since it was put where it sees everything. */
  private isFramed = false;
  private pace = 1;
  /** The last picture was drawn more coarsely than could be, to keep up. */
  private isHasty = false;
  private lastMs = 0;
  private leisure: ReturnType<typeof setTimeout> | undefined;
  private settling: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly renderer: WebGLRenderer, private readonly events: StageEvents, calm: boolean) {
    const canvas = (this.canvas = renderer.domElement);
    this.software = drawsInSoftware(renderer);
    this.detail = this.software ? SOFTWARE : HARDWARE;
    this.controls = new OrbitControls(this.camera, canvas);
    this.sight = new Sight(canvas, this.camera, () => this.surface);
    Object.assign(this.controls, { enableDamping: !calm, dampingFactor: 0.12, zoomToCursor: true, rotateSpeed: 0.7 });
    this.controls.addEventListener('change', () => {
      this.draw();
      if (this.isHeld && !this.moving) this.move(true);
      else this.events.moved();
    });
    this.controls.addEventListener('start', () => (this.isHeld = true));
    this.controls.addEventListener('end', () => {
      this.isHeld = false;
      if (this.moving) this.move(false);
    });
    canvas.addEventListener('webglcontextlost', (event) => {
      event.preventDefault();
      this.clear(); // now, while deleting what is gone does nothing
      for (const each of this.smallest.values()) each.dispose();
      this.smallest.clear();
      this.warming.clear();
      this.events.lost();
    });
    canvas.addEventListener('webglcontextrestored', () => {
      void this.warm();
      this.events.restored();
    });
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement!);
    void this.warm();
  }

  /** Show a scan. framed: with the camera where it sees everything; else it stays. */
  show(snapshot: Snapshot, framed: boolean): void {
    const old = this.surface;
    this.surface = this.surfaceOf(snapshot);
    this.surface.show(this.shading, this.overlay);
    this.scene.add(this.surface.object);
    if (old) {
      this.scene.remove(old.object);
      old.dispose();
    }
    void this.warm();
    if (framed) this.frame();
    this.draw();
  }

  /** Take rectangles that have changed; they are seen with the next picture. */
  patch(channel: Channel, changed: Changed[], level: Uint8Array): void {
    const before = this.partOf(channel, changed);
    this.surface?.patch(channel, changed, level);
    if (channel === RANGE && this.isWarm) this.surface?.drawNormals(); // texture is still to come: the card can begin
    const after = channel === RANGE ? this.partOf(channel, changed) : before; // colour moves nothing
    this.change(before === 'all' || after === 'all' ? 'all' : joined(before, after));
  }

  /** The part of the picture that shows these samples; where a graphics card draws, all is as soon drawn. */
  private partOf(channel: Channel, changed: Changed[]): Part | 'all' | null {
    if (!this.surface || !this.software) return 'all';
    return this.surface.seenAt(channel, changed, this.camera, this.width, this.height);
  }

  /** Show a newer picture of a running sweep. */
  replace(steps: Uint16Array, coarseTexels: Uint8Array): void {
    this.surface?.replace(steps, coarseTexels);
    this.draw();
  }

  /** Show nothing. */
  clear(): void {
    if (!this.surface) return;
    this.scene.remove(this.surface.object);
    this.surface.dispose();
    this.surface = null;
    this.draw();
  }

  setLook(shading: Shading, overlay: Channel | null): void {
    [this.shading, this.overlay] = [shading, overlay];
    this.surface?.show(shading, overlay);
    void this.warm();
    this.draw();
  }

  /** How many texels, and samples along a side, stand for one, because the graphics card takes no larger texture; 1 is all. */
  get shrunk(): { colour: number; shape: number } {
    return { colour: Math.max(...(this.surface?.shrunk ?? [1])), shape: this.surface?.thinned ?? 1 };
  }

  /** Put the camera where it sees the whole scan from the front. */
  frame(): void {
    if (!this.surface) return;
    const bounds = boundsOf(this.surface.info, this.surface.steps);
    const middle = (bounds.bottomMm + bounds.topMm) / 2;
    this.place({
      azimuth: FACING_RAD, elevation: 0.1, distance: fittingDistance(bounds, this.camera.aspect), target: [0, middle, 0],
    });
    this.isFramed = true;
  }

  /** Put the camera where a sweep to come will fit, of which only the geometry is known. */
  frameEmpty(radiusMm: number): void {
    if (!this.surface) return;
    const { zMaxMm, height, pitchMm } = this.surface.info;
    const bounds = { radiusMm, topMm: zMaxMm, bottomMm: zMaxMm - height * pitchMm };
    const target: [number, number, number] = [0, (bounds.topMm + bounds.bottomMm) / 2, 0];
    this.place({ azimuth: FACING_RAD, elevation: 0.1, distance: fittingDistance(bounds, this.camera.aspect), target });
  }

  place({ azimuth, elevation, distance, target }: CameraPlace): void {
    const flat = Math.cos(elevation) * distance;
    this.isFramed = false;
    this.controls.target.set(...target);
    this.camera.position.set(flat * Math.cos(azimuth), Math.sin(elevation) * distance, -flat * Math.sin(azimuth));
    this.camera.position.add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  /** Stand where another camera leads, as coarse as it takes to keep up while that moves. */
  follow(camera: CameraPlace, moving: boolean): void {
    this.place(camera);
    if (this.moving !== moving) this.move(moving);
  }

  get placed(): CameraPlace {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const distance = offset.length();
    return {
      azimuth: Math.atan2(-offset.z, offset.x), elevation: Math.asin(offset.y / distance), distance,
      target: this.controls.target.toArray(),
    };
  }

  /** Turn the camera to the side where a place is; on a sphere above or below it, too. */
  face({ u, v }: Place): void {
    if (!this.surface) return;
    const { info } = this.surface;
    const elevation = isSphere(info) ? within(Math.PI * (0.5 - v)) : this.placed.elevation;
    this.place({ ...this.placed, azimuth: info.theta0Rad + 2 * Math.PI * u, elevation });
  }

  /** Turn the camera by steps round the scan and up. */
  turn(across: number, up: number): void {
    const now = this.placed;
    this.place({ ...now, azimuth: now.azimuth + across * TURN_STEP_RAD, elevation: within(now.elevation + up * TURN_STEP_RAD) });
    this.settle();
  }

  /** Come nearer by steps, or go away. */
  zoom(steps: number): void {
    const now = this.placed;
    this.place({ ...now, distance: now.distance / ZOOM_STEP ** steps });
    this.settle();
  }

  /** Move the picture by steps of a tenth of its height. */
  pan(right: number, up: number): void {
    const now = this.placed;
    const stepMm = (now.distance * Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360)) / 5;
    const across = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0).multiplyScalar(right * stepMm);
    const along = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 1).multiplyScalar(up * stepMm);
    const target = new Vector3(...now.target).add(across).add(along).toArray();
    this.place({ ...now, target });
    this.settle();
  }

  /** Once all that was drawn is in the picture. */
  done(): Promise<void> {
    return cardIsDone(this.renderer.getContext() as WebGL2RenderingContext);
  }

  /** Do what the first picture could do without, so that the first look need not wait for it. */
  private async useLeisure(): Promise<void> {
    await this.done();
    const { surface } = this;
    if (!surface || surface.isReady) return;
    await this.smallest.get(this.kind)?.compileMore();
    if (surface !== this.surface || surface.isReady) return;
    surface.makeReady();
    this.draw();
  }

  /** Draw the smallest surface of the kind shown, so that programs are there, and the card knows them, before a scan is. */
  private async warm(): Promise<void> {
    const { kind } = this;
    if (this.warming.has(kind)) return;
    this.warming.add(kind);
    const smallest = this.surfaceOf(nothing(this.geometry));
    smallest.show(this.shading, this.overlay);
    await smallest.compile(this.camera);
    if (!this.warming.has(kind)) return; // the card was lost meanwhile
    this.smallest.set(kind, smallest);
    if (!this.surface) {
      smallest.choose(this.camera, 1, this.detail);
      smallest.prepare(this.camera);
      this.renderer.render(smallest.object, this.camera);
    }
    this.draw();
  }

  private get isWarm(): boolean {
    return this.smallest.has(this.kind);
  }

  private get kind(): Kind {
    return `${this.geometry}${this.overlay === null ? '' : ', overlaid'}`;
  }

  private get geometry(): Geometry {
    return this.surface ? geometryOf(this.surface.info) : 'cylinder';
  }

  private surfaceOf({ info, ...state }: Snapshot): Surface {
    return new Surface(this.renderer, info, state, !this.software, this.detail.tileSide);
  }

  /** Ask for a picture, or to have a part of it drawn anew; any number of calls make one. */
  draw(part: Part | 'all' | null = 'all'): void {
    this.change(part);
    if (this.asked || !this.isWarm) return;
    this.asked = true;
    requestAnimationFrame((nowMs) => this.paint(nowMs));
  }

  private change(part: Part | 'all' | null): void {
    this.due = part === 'all' || this.due === 'all' ? 'all' : joined(this.due, part);
  }

  /** Draw what is due without waiting for the browser's next frame. */
  paintNow(): void {
    if (document.hidden) this.draw(null); // nobody sees it yet
    else this.paint(performance.now());
  }

  private paint(nowMs: number): void {
    this.asked = false;
    if (!this.isWarm) return;
    if (this.controls.enableDamping) this.controls.update();
    if (!this.due) return;
    this.keepPace(nowMs);
    const wasHasty = this.isHasty;
    this.isHasty = this.moving && this.pace > 1;
    const detail = this.isHasty ? { ...this.detail, cellPx: this.detail.cellPx * this.pace } : this.detail;
    const distance = this.camera.position.distanceTo(this.controls.target);
    this.camera.near = Math.max(distance / 400, 0.05);
    this.camera.far = distance + 2e3;
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
    const ratio = this.renderer.getPixelRatio();
    const isOther = this.surface?.choose(this.camera, this.height * ratio, detail) ?? true;
    const triangles = this.drawPart(isOther || this.isHasty || wasHasty ? 'all' : this.due);
    this.due = null;
    clearTimeout(this.leisure);
    this.leisure = setTimeout(() => void this.useLeisure(), LEISURE_MS);
    const { dataset } = this.canvas;
    dataset['drawn'] = String(Number(dataset['drawn'] ?? 0) + 1);
    dataset['triangles'] = String(triangles);
    dataset['ready'] = String(this.surface?.isReady ?? false);
    this.events.drawn();
  }

  /** Draw, or draw a part anew. Returns how many triangles. */
  private drawPart(due: Part | 'all'): number {
    const { width, height } = this;
    const part = due === 'all' ? null : inside(due, width, height);
    if (due !== 'all' && !part) return 0;
    const camera = part ? this.camera.clone() : this.camera;
    if (part) {
      const [wide, high] = [part.right - part.left, part.bottom - part.top];
      camera.setViewOffset(width, height, part.left, part.top, wide, high);
      this.renderer.setScissor(part.left, height - part.bottom, wide, high);
    }
    this.renderer.setScissorTest(part !== null);
    const triangles = this.surface?.prepare(camera) ?? 0;
    this.renderer.render(this.scene, this.camera);
    this.renderer.setScissorTest(false);
    return triangles;
  }

  /** While the camera moves, draw as coarsely as it takes to keep up with it. */
  private keepPace(nowMs: number): void {
    const frameMs = nowMs - this.lastMs;
    this.lastMs = nowMs;
    if (!this.moving || frameMs > 500) return;
    if (frameMs > SLOW_FRAME_MS) this.pace = Math.min(PACE_MAX, this.pace * 1.25);
    else if (frameMs < QUICK_FRAME_MS) this.pace = Math.max(1, this.pace / 1.05);
  }

  private move(moving: boolean): void {
    this.moving = moving;
    if (moving) this.isFramed = false;
    else this.settle();
    this.events.moved();
  }

  private settle(): void {
    clearTimeout(this.settling);
    this.settling = setTimeout(() => {
      if (this.isHasty) this.draw();
      this.events.settled();
    }, 250);
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas.parentElement!;
    [this.width, this.height] = [Math.max(1, clientWidth), Math.max(1, clientHeight)];
    this.renderer.setPixelRatio(this.software ? 1 : Math.min(Math.max(window.devicePixelRatio, SMOOTH_RATIO), 2));
    this.renderer.setSize(this.width, this.height, false);
    this.camera.aspect = this.width / this.height;
    if (this.isFramed) this.frame();
    this.draw();
  }
}

/** An elevation that leaves no doubt which way is up. */
const within = (elevation: number): number => Math.min(Math.max(elevation, -ELEVATION_MAX_RAD), ELEVATION_MAX_RAD);

/** The smallest scan, as coarse as a first view. */
function nothing(geometry: Geometry): Snapshot {
  const info = {
    id: '', geometry, width: 8, height: 8, textureWidth: 16, textureHeight: 16, coarseWidth: 1, coarseHeight: 1, coarseTextureWidth: 1,
    coarseTextureHeight: 1, stepMm: 1, pitchMm: 1, zMaxMm: 4, theta0Rad: 0,
  };
  return { info, steps: new Uint16Array(64).fill(1), coarseTexels: new Uint8Array(4), levels: [new Uint8Array(1).fill(6), new Uint8Array(1).fill(6)] };
}
