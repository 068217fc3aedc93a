// What lies under which point of the picture, and where on it what is: places, ways, and whether something hides them.

import { Raycaster, Vector2, Vector3 } from 'three';
import type { PerspectiveCamera } from 'three';
import { shortestPath } from './path.ts';
import type { Path } from './path.ts';
import { locate, pick } from './pick.ts';
import type { Place } from './room.ts';
import type { Surface } from './surface.ts';

export class Sight {
  /** shown: the surface in the picture. */
  constructor(
    private readonly canvas: HTMLCanvasElement, private readonly camera: PerspectiveCamera, private readonly shown: () => Surface | null,
  ) {}

  /** The place under a point of the page, or null. */
  pick(clientX: number, clientY: number): Place | null {
    const { left, top } = this.canvas.getBoundingClientRect();
    return this.pickOnPicture(clientX - left, clientY - top);
  }

  /** The place under a point of the picture [CSS px], or null. */
  pickOnPicture(x: number, y: number): Place | null {
    if (!this.surface) return null;
    const { clientWidth, clientHeight } = this.canvas;
    const at = new Vector2((x / clientWidth) * 2 - 1, 1 - (y / clientHeight) * 2);
    this.camera.updateMatrixWorld();
    const caster = new Raycaster();
    caster.setFromCamera(at, this.camera);
    return pick(this.surface.info, this.surface.steps, caster.ray);
  }

  /** The place in the middle of the picture, or null. */
  pickMiddle(): Place | null {
    return this.pickOnPicture(this.canvas.clientWidth / 2, this.canvas.clientHeight / 2);
  }

  /** Where a place is in the room [mm]; null where nothing was measured. */
  locate(place: Place): Vector3 | null {
    return this.surface ? locate(this.surface.info, this.surface.steps, place) : null;
  }

  /** The shortest way over the surface from one place to another; null where one of them was not measured. */
  path(from: Place, to: Place): Path | null {
    return this.surface ? shortestPath(this.surface.info, this.surface.steps, from, to) : null;
  }

  /** Samples from one that is held to the next, there. */
  spacingAt(place: Place): number {
    return this.surface?.spacingAt(place) ?? 1;
  }

  /** Where a point of the room is on the picture [CSS px], and whether a surface that faces so is turned away there. */
  sketch(point: Vector3, normal: Vector3): { x: number; y: number; away: boolean } {
    return { ...this.onPicture(point), away: normal.dot(this.camera.position.clone().sub(point)) < 0 };
  }

  /** Where a place is on the picture [CSS px], and whether the surface hides it. */
  project(place: Place): { x: number; y: number; hidden: boolean } | null {
    const point = this.locate(place);
    if (!point || !this.surface) return null;
    const { x, y, outside } = this.onPicture(point);
    return { x, y, hidden: outside || this.hides(point) };
  }

  private onPicture(point: Vector3): { x: number; y: number; outside: boolean } {
    const ndc = point.clone().project(this.camera);
    const { clientWidth, clientHeight } = this.canvas;
    const outside = Math.abs(ndc.x) > 1 || Math.abs(ndc.y) > 1 || ndc.z > 1;
    return { x: ((ndc.x + 1) / 2) * clientWidth, y: ((1 - ndc.y) / 2) * clientHeight, outside };
  }

  private hides(point: Vector3): boolean {
    const caster = new Raycaster();
    const toPoint = point.clone().sub(this.camera.position);
    const distance = toPoint.length();
    caster.set(this.camera.position, toPoint.normalize());
    const first = pick(this.surface!.info, this.surface!.steps, caster.ray);
    const met = first && this.locate(first);
    return met !== null && met.distanceTo(this.camera.position) < distance * 0.985;
  }

  private get surface(): Surface | null {
    return this.shown();
  }
}
