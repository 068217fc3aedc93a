// Where the camera stands when nobody has moved it, and how a scan's cylinder lies in the room: y is up.

import { Vector3 } from 'three';
import type { ScanInfo } from '../protocol/messages.ts';

export const FIELD_OF_VIEW_DEG = 28;
const MARGIN = 1.08;

export interface Bounds {
  radiusMm: number;
  bottomMm: number;
  topMm: number;
}

/** Largest radius and heights of what was measured. */
export function boundsOf(info: ScanInfo, steps: Uint16Array): Bounds {
  const { width, height, stepMm, pitchMm, zMaxMm } = info;
  let [most, top, bottom] = [0, height, -1];
  for (let row = 0; row < height; row++) {
    let measured = false;
    for (let at = row * width; at < (row + 1) * width; at++) {
      if (steps[at]! > most) most = steps[at]!;
      measured ||= steps[at] !== 0;
    }
    if (measured) [top, bottom] = [Math.min(top, row), row];
  }
  if (bottom < 0) return { radiusMm: 1, bottomMm: zMaxMm - height * pitchMm, topMm: zMaxMm };
  return { radiusMm: most * stepMm, bottomMm: zMaxMm - (bottom + 1) * pitchMm, topMm: zMaxMm - top * pitchMm };
}

/** Distance from which everything is in the picture. aspect: its width / its height. */
export function fittingDistance({ radiusMm, bottomMm, topMm }: Bounds, aspect: number): number {
  const half = Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
  return MARGIN * (radiusMm + Math.max((topMm - bottomMm) / 2 / half, radiusMm / half / aspect));
}

/** A point of the surface. radius [mm], angle [rad, counter-clockwise from above], height [mm]. */
export function pointAt(radiusMm: number, angleRad: number, heightMm: number): Vector3 {
  return new Vector3(radiusMm * Math.cos(angleRad), heightMm, -radiusMm * Math.sin(angleRad));
}
