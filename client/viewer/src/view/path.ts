// The shortest way over the surface between two places, as a tape would lie on it.

import { Vector3 } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';
import { locate } from './pick.ts';
import { isSphere, placeOf, pointAt } from './room.ts';
import type { Place } from './room.ts';

/** Pieces are as long, at most; much shorter ones would measure the noise of the samples. */
const PIECE_MM = 1;
const PIECES_MIN = 8;
const PIECES_MAX = 512;
/** Rounds of shortening: what is coarsely right needs few when it is made finer. */
const ROUNDS_FIRST = 40;
const ROUNDS = 5;
const STILL = 1e-4;

export interface Path {
  /** Points of the room that it leads over, both ends with it [mm]. */
  points: Vector3[];
  /** Which way is out at each of them. */
  normals: Vector3[];
  lengthMm: number;
  /** How much of that leads over what was not measured. */
  gapsMm: number;
}

/** The way that a straight look from one place to the other leads to by shortening; null where an end was not measured. */
export function shortestPath(info: ScanInfo, steps: Uint16Array, from: Place, to: Place): Path | null {
  if (!locate(info, steps, from) || !locate(info, steps, to)) return null;
  let way = [from, to];
  while (way.length <= PIECES_MIN) way = halved(info, way);
  shorten(info, steps, way, ROUNDS_FIRST);
  for (;;) {
    const path = pathOver(info, steps, way);
    const pieces = way.length - 1;
    if (path.lengthMm / pieces <= Math.max(PIECE_MM, info.pitchMm) || pieces >= PIECES_MAX) {
      return { ...path, normals: path.points.map((point) => normalAt(info, steps, point, PIECE_MM)) };
    }
    way = halved(info, way);
    shorten(info, steps, way, ROUNDS);
  }
}

/** What a way has measured is walked, from one such place straight to the next. */
function pathOver(info: ScanInfo, steps: Uint16Array, way: Place[]): Omit<Path, 'normals'> {
  const path = { points: [] as Vector3[], lengthMm: 0, gapsMm: 0 };
  let isGap = false;
  for (const place of way) {
    const point = locate(info, steps, place);
    if (point) {
      const stepMm = path.points.at(-1)?.distanceTo(point) ?? 0;
      path.points.push(point);
      path.lengthMm += stepMm;
      if (isGap) path.gapsMm += stepMm;
    }
    isGap = !point;
  }
  return path;
}

/** A way with twice as many pieces. */
function halved(info: ScanInfo, way: Place[]): Place[] {
  return way.flatMap((place, at) => (at ? [between(info, way[at - 1]!, place), place] : [place]));
}

/** The place half way between two, the short way round, on a cylinder or a ball. */
function between(info: ScanInfo, a: Place, b: Place): Place {
  if (!isSphere(info)) {
    const turn = ((b.u - a.u + 1.5) % 1) - 0.5;
    return { u: (a.u + turn / 2 + 1) % 1, v: (a.v + b.v) / 2 };
  }
  const centre = new Vector3(0, info.zMaxMm, 0);
  const middle = pointAt(info, a, 1).add(pointAt(info, b, 1)).sub(centre);
  const isOpposite = middle.distanceTo(centre) < 1e-9; // then any way round is as short
  return isOpposite ? { u: a.u, v: (a.v + 0.5) % 1 } : onGrid(placeOf(info, middle));
}

/** Shorten a way between its ends, in place, until nothing moves any more. */
function shorten(info: ScanInfo, steps: Uint16Array, way: Place[], rounds: number): void {
  for (let round = 0; round < rounds; round++) {
    let moved = 0;
    for (let at = 1; at < way.length - 1; at++) moved = Math.max(moved, move(info, steps, way, at));
    if (moved < STILL) return;
  }
}

/** Move one place towards the middle of its neighbours, along the surface. Returns by how much of a piece. */
function move(info: ScanInfo, steps: Uint16Array, way: Place[], at: number): number {
  const [before, here, after] = [way[at - 1]!, way[at]!, way[at + 1]!].map((place) => locate(info, steps, place));
  if (!before || !here || !after) return 0;
  const towards = before.clone().add(after).multiplyScalar(0.5).sub(here);
  const normal = normalAt(info, steps, here, before.distanceTo(after) / 2);
  towards.addScaledVector(normal, -towards.dot(normal));
  const next = onGrid(placeOf(info, here.clone().add(towards)));
  if (!locate(info, steps, next)) return 0;
  way[at] = next;
  return towards.length() / Math.max(before.distanceTo(after), 1e-9);
}

const onGrid = ({ u, v }: Place): Place => ({ u, v: Math.min(Math.max(v, 0), 1 - 1e-9) });

/** Which way is out, over a reach [mm]; where nothing was measured beside it, straight out. */
function normalAt(info: ScanInfo, steps: Uint16Array, here: Vector3, reachMm: number): Vector3 {
  const out = here.clone().setY(isSphere(info) ? here.y - info.zMaxMm : 0).normalize();
  const round = new Vector3(out.z, 0, -out.x).normalize();
  const slopes = [round, new Vector3().crossVectors(out, round)].map((along) => {
    const sides = [-1, 1].map((side) => {
      const beside = placeOf(info, here.clone().addScaledVector(along, side * reachMm));
      return beside.v >= 0 && beside.v < 1 ? locate(info, steps, beside) : null;
    });
    const [one, other] = [sides[0] ?? here, sides[1] ?? here];
    return one === other ? along : other.clone().sub(one);
  });
  const normal = slopes[0]!.cross(slopes[1]!).normalize();
  if (normal.lengthSq() === 0) return out;
  return normal.dot(out) < 0 ? normal.negate() : normal;
}
