// What lies under the pointer, and where places of the scan are in the room: on the same samples that are drawn.

import { Ray, Vector3 } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';
import { isSphere, placeOf, pointAt, stepsAt } from './room.ts';
import type { Place } from './room.ts';

const BISECTIONS = 24;

/** The place where a ray first meets the surface, or null. */
export function pick(info: ScanInfo, steps: Uint16Array, ray: Ray): Place | null {
  const reach = span(info, steps, ray);
  if (!reach) return null;
  const [from, to] = reach;
  const stride = Math.max(info.pitchMm / 2, (to - from) / 4000);
  let before = height(info, steps, ray.at(from, new Vector3()));
  for (let t = from + stride; t <= to; t += stride) {
    const now = height(info, steps, ray.at(t, new Vector3()));
    if (before !== null && now !== null && before > 0 !== now > 0) return refine(info, steps, ray, t - stride, t, before > 0);
    before = now;
  }
  return null;
}

/** Where a place is in the room; null where nothing was measured. */
export function locate(info: ScanInfo, steps: Uint16Array, place: Place): Vector3 | null {
  const radius = radiusAt(info, steps, place);
  return radius === null ? null : pointAt(info, place, radius);
}

function refine(info: ScanInfo, steps: Uint16Array, ray: Ray, from: number, to: number, positive: boolean): Place {
  for (let round = 0; round < BISECTIONS; round++) {
    const middle = (from + to) / 2;
    const now = height(info, steps, ray.at(middle, new Vector3()));
    if (now !== null && now > 0 === positive) from = middle;
    else to = middle;
  }
  const { u, v } = placeOf(info, ray.at(to, new Vector3()));
  return { u, v: Math.min(Math.max(v, 0), 1 - 1e-9) };
}

/** How far a point stands off the surface, outward; null where nothing was measured. */
function height(info: ScanInfo, steps: Uint16Array, point: Vector3): number | null {
  const place = placeOf(info, point);
  if (place.v < 0 || (place.v >= 1 && !isSphere(info))) return null;
  const radius = radiusAt(info, steps, place);
  return radius === null ? null : place.radiusMm - radius;
}

/** Bilinear over the measured ones of four samples; null where the nearest one is void. */
function radiusAt(info: ScanInfo, steps: Uint16Array, { u, v }: Place): number | null {
  const [x, y] = [u * info.width - 0.5, v * info.height - 0.5];
  const [column, row] = [Math.floor(x), Math.floor(y)];
  const [right, down] = [x - column, y - row];
  if (stepsAt(info, steps, Math.round(x), Math.round(y)) === 0) return null;
  let [sum, weight] = [0, 0];
  for (const [dx, dy, share] of [
    [0, 0, (1 - right) * (1 - down)], [1, 0, right * (1 - down)], [0, 1, (1 - right) * down], [1, 1, right * down],
  ] as const) {
    const value = stepsAt(info, steps, column + dx, row + dy);
    if (value) [sum, weight] = [sum + share * value, weight + share];
  }
  return weight > 0 ? (sum / weight) * info.stepMm : null;
}

/** The part of a ray inside the scan's cylinder or sphere. */
function span(info: ScanInfo, steps: Uint16Array, ray: Ray): [number, number] | null {
  const radius = mostSteps(steps) * info.stepMm;
  const all = isSphere(info) ? 1 : 0;
  const [o, d] = [ray.origin.clone(), ray.direction.clone()];
  o.y = all * (o.y - info.zMaxMm);
  d.y *= all;
  const [a, b, c] = [d.dot(d), o.dot(d), o.dot(o) - radius * radius];
  const root = b * b - a * c;
  if (root < 0 || a === 0) return null;
  const near = Math.max(0, (-b - Math.sqrt(root)) / a);
  const far = (-b + Math.sqrt(root)) / a;
  return far > near ? [near, far] : null;
}

const known = new WeakMap<Uint16Array, number>();

/** Largest sample; refinements move it by so little that the first look will do, with some room. */
function mostSteps(steps: Uint16Array): number {
  let most = known.get(steps);
  if (most === undefined) {
    most = 0;
    for (const step of steps) if (step > most) most = step;
    most *= 1.2;
    known.set(steps, most);
  }
  return most;
}
