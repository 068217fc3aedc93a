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
  const [rows, columns] = [Math.max(th, 2 * side), Math.max(tw, 4 * side)]; // fewer leave gaps where they lie apart
  for (let row = 0; row < rows; row++) {
    const share = (row + 0.5) / rows;
    const [above, below, part] = between(share * h - 0.5, h);
    const texelRow = tw * Math.floor(share * th);
    const [flat, up] = sphere ? [Math.sin(Math.PI * share), Math.cos(Math.PI * share)] : [1, 0];
    for (let column = 0; column < columns; column++) {
      const c = Math.floor((column * w) / columns);
      const [one, other] = [steps[above * w + c]!, steps[below * w + c]!];
      const radius = (one && other ? one + (other - one) * part : part < 0.5 ? one : other) * info.stepMm;
      const angle = info.theta0Rad + (2 * Math.PI * (column + 0.5)) / columns - facing;
      const near = radius * flat * Math.cos(angle);
      if (radius === 0 || near < 0) continue;
      const x = Math.round(side / 2 + radius * flat * Math.sin(angle) * scale);
      const y = Math.round(side / 2 - (sphere ? radius * up : (0.5 - share) * heightMm) * scale);
      const shade = 0.45 + 0.6 * slopeLight(steps, part < 0.5 ? above : below, c, w, angle);
      const [from, at] = [4 * (texelRow + Math.floor((column * tw) / columns)), y * side + x];
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

/** The two rows that a place lies between, and how far from the first to the second it is. */
function between(place: number, rows: number): [number, number, number] {
  const at = Math.min(Math.max(place, 0), rows - 1);
  const first = Math.floor(at);
  return [first, Math.min(first + 1, rows - 1), at - first];
}

/** How much a cell faces us: its slope round the axis, from its neighbours. */
function slopeLight(steps: Uint16Array, row: number, column: number, width: number, angle: number): number {
  const here = steps[row * width + column]!;
  const left = steps[row * width + ((column + width - 1) % width)] || here;
  const right = steps[row * width + ((column + 1) % width)] || here;
  const slope = ((right - left) / here) * (width / (4 * Math.PI));
  return Math.max(0, Math.cos(angle - Math.atan(slope)));
}
