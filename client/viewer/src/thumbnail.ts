// A small picture of a scan from its first view: points thrown on a square, the nearest one wins.

import type { ScanInfo } from './protocol/messages.ts';

export const THUMBNAIL_SIDE = 96;
const MARGIN = 0.92;

/** RGBA of a view from the angle `facing`; transparent where the scan is not. */
export function drawThumbnail(
  info: ScanInfo, steps: Uint16Array, texels: Uint8Array, facing: number,
): Uint8ClampedArray<ArrayBuffer> {
  const { coarseWidth: w, coarseHeight: h, coarseTextureWidth: tw, coarseTextureHeight: th } = info;
  const side = THUMBNAIL_SIDE;
  const sphere = info.geometry === 'sphere';
  const reach = steps.reduce((most, step) => Math.max(most, step), 1) * info.stepMm;
  const heightMm = sphere ? 2 * reach : info.height * info.pitchMm;
  const scale = (side * MARGIN) / Math.max(heightMm, 2 * reach);
  const pixels = new Uint8ClampedArray(4 * side * side);
  const depth = new Float32Array(side * side).fill(-Infinity);
  for (let row = 0; row < th; row++) {
    const r = Math.floor((row * h) / th);
    const share = (row + 0.5) / th;
    const [flat, up] = sphere ? [Math.sin(Math.PI * share), Math.cos(Math.PI * share)] : [1, 0];
    for (let column = 0; column < tw; column++) {
      const c = Math.floor((column * w) / tw);
      const radius = steps[r * w + c]! * info.stepMm;
      const angle = info.theta0Rad + (2 * Math.PI * (column + 0.5)) / tw - facing;
      const near = radius * flat * Math.cos(angle);
      if (radius === 0 || near < 0) continue;
      const x = Math.round(side / 2 + radius * flat * Math.sin(angle) * scale);
      const y = Math.round(side / 2 - (sphere ? radius * up : (0.5 - share) * heightMm) * scale);
      const shade = 0.45 + 0.6 * slopeLight(steps, r, c, w, angle);
      const [from, at] = [4 * (row * tw + column), y * side + x];
      for (const pixel of [at, at + 1, at + side, at + side + 1]) {
        if (near <= depth[pixel]!) continue;
        depth[pixel] = near;
        for (let k = 0; k < 3; k++) pixels[4 * pixel + k] = texels[from + k]! * shade;
        pixels[4 * pixel + 3] = 255;
      }
    }
  }
  return pixels;
}

/** How much a cell faces us: its slope round the axis, from its neighbours. */
function slopeLight(steps: Uint16Array, row: number, column: number, width: number, angle: number): number {
  const here = steps[row * width + column]!;
  const left = steps[row * width + ((column + width - 1) % width)] || here;
  const right = steps[row * width + ((column + 1) % width)] || here;
  const slope = ((right - left) / here) * (width / (4 * Math.PI));
  return Math.max(0, Math.cos(angle - Math.atan(slope)));
}
