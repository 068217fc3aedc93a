// Where the camera stands when nobody has moved it.

import type { ScanInfo } from '../protocol/messages.ts';
import { isSphere } from './room.ts';

export const FIELD_OF_VIEW_DEG = 28;
const MARGIN = 1.08;

export interface Bounds {
  radiusMm: number;
  bottomMm: number;
  topMm: number;
}

/** Of so many rows and columns some are enough to see how large a scan is. */
const LINES = 256;

/** How far from the axis, how low and how high something was measured. */
export function boundsOf(info: ScanInfo, steps: Uint16Array): Bounds {
  const { width, height, stepMm, pitchMm, zMaxMm } = info;
  const bounds = { radiusMm: 0, bottomMm: Infinity, topMm: -Infinity };
  const polar = isSphere(info) ? Math.PI / height : 0;
  const [across, down] = [width, height].map((size) => Math.max(1, Math.floor(size / LINES))) as [number, number];
  for (let row = 0; row < height; row += down) {
    let most = 0;
    for (let at = row * width; at < (row + 1) * width; at += across) if (steps[at]! > most) most = steps[at]!;
    if (!most) continue;
    const reach = most * stepMm;
    const [upper, lower] = [row, row + 1].map((edge) => zMaxMm + (polar ? reach * Math.cos(polar * edge) : -edge * pitchMm));
    bounds.radiusMm = Math.max(bounds.radiusMm, polar ? reach * Math.sin(polar * (row + 0.5)) : reach);
    bounds.topMm = Math.max(bounds.topMm, upper!);
    bounds.bottomMm = Math.min(bounds.bottomMm, lower!);
  }
  return bounds.radiusMm ? bounds : { radiusMm: 1, bottomMm: zMaxMm - height * pitchMm, topMm: zMaxMm };
}

/** Distance from which everything is in the picture. aspect: its width / its height. */
export function fittingDistance({ radiusMm, bottomMm, topMm }: Bounds, aspect: number): number {
  const half = Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
  return MARGIN * (radiusMm + Math.max((topMm - bottomMm) / 2 / half, radiusMm / half / aspect));
}
