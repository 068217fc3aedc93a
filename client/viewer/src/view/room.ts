// How a scan lies in the room: y is up, round the axis as a cylinder or round a point on it as a sphere.

import { Vector3 } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';

/** A place on the scan as clicks and pins name it, both in [0, 1). */
export interface Place {
  u: number;
  v: number;
}

export type Geometry = NonNullable<ScanInfo['geometry']>;

export const geometryOf = ({ geometry }: ScanInfo): Geometry => geometry ?? 'cylinder';
export const isSphere = ({ geometry }: ScanInfo): boolean => geometry === 'sphere';

/** The point that is radiusMm from the axis, or from the centre, at a place. */
export function pointAt(info: ScanInfo, { u, v }: Place, radiusMm: number): Vector3 {
  const angle = info.theta0Rad + 2 * Math.PI * u;
  const polar = Math.PI * v;
  const flat = isSphere(info) ? radiusMm * Math.sin(polar) : radiusMm;
  const up = isSphere(info) ? radiusMm * Math.cos(polar) : -v * info.height * info.pitchMm;
  return new Vector3(flat * Math.cos(angle), info.zMaxMm + up, -flat * Math.sin(angle));
}

/** Inverse of pointAt: where a point is seen, u in [0, 1), and how far out. v may lie beyond a cylinder's ends. */
export function placeOf(info: ScanInfo, { x, y, z }: Vector3): Place & { radiusMm: number } {
  const turn = (Math.atan2(-z, x) - info.theta0Rad) / (2 * Math.PI);
  const [flat, up] = [Math.hypot(x, z), y - info.zMaxMm];
  const u = (turn - Math.floor(turn)) % 1;
  if (isSphere(info)) return { u, v: Math.atan2(flat, up) / Math.PI, radiusMm: Math.hypot(flat, up) };
  return { u, v: -up / (info.height * info.pitchMm), radiusMm: flat };
}

/** The sample at a column and a row of any number: round and round; past a pole down the other side, or the last one. */
export function stepsAt(info: ScanInfo, steps: Uint16Array, column: number, row: number): number {
  const { width, height } = info;
  const over = isSphere(info) && (row < 0 || row >= height);
  const at = over ? (row < 0 ? -1 - row : 2 * height - 1 - row) : Math.min(Math.max(row, 0), height - 1);
  const turned = (over ? column + (width >> 1) : column) % width;
  return steps[at * width + ((turned + width) % width)]!;
}
