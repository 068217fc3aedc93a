// Texture round a pole as one image, on a map of the hemisphere: mirrors protocol/polar.py (PROTOCOL.md, "Spheres").

import { blockSide, blocksAcross, strideOf } from './lattice.ts';
import type { ChannelShape, Parameters } from './lattice.ts';
import type { Selection } from './reconstruct.ts';

const PLACE_SCALE = 1e6; // to which places on the map are rounded before they are cut: no machine's sine decides

/** A rectangle of a map: its first column and row, counted from the pole, and how many, odd numbers. */
export interface PolarImage {
  map: PolarMap;
  left: number;
  top: number;
  columns: number;
  rows: number;
}

/** Of one hemisphere: how far from the pole a row lies, and in which direction a column. */
interface PolarMap {
  radius: (row: number) => number;
  angle: (column: number) => number;
}

/** The map that a refinement's samples lie on. */
function mapOf(shape: ChannelShape, p: Parameters): PolarMap {
  const { width, height } = shape;
  const lower = 2 * p.blockY * blockSide(shape) >= height;
  const aRadian = Math.max(2 * height, width) / (Math.PI * p.halfSpacing);
  return {
    radius: (row) => 2 * Math.sin((Math.PI * ((lower ? height - 1 - row : row) + 0.5)) / (2 * height)) * aRadian,
    angle: (column) => (2 * Math.PI * (column + 0.5)) / width,
  };
}

/** The image that strips, at least one, travel in. */
export function polarImage(shape: ChannelShape, p: Parameters, selections: Selection[]): PolarImage {
  const [map, side, across] = [mapOf(shape, p), blockSide(shape), blocksAcross(shape)];
  const edges = Array.from({ length: across }, (_, block) => [block * side, Math.min((block + 1) * side, shape.width)].map(map.angle));
  const [x, y] = [[Infinity, -Infinity], [Infinity, -Infinity]];
  const widen = (range: number[], place: number) => {
    range[0] = Math.min(range[0]!, place);
    range[1] = Math.max(range[1]!, place);
  };
  for (const selection of selections) {
    selection.adopted.forEach((yes, index) => {
      if (!yes) return;
      const wide = selection.x.block.length;
      const row = selection.y.block[Math.floor(index / wide)]! * side;
      for (const radius of [row, Math.min(row + side, shape.height) - 1].map(map.radius)) {
        for (const angle of edges[selection.x.block[index % wide]!]!) {
          widen(x, radius * Math.cos(angle));
          widen(y, radius * Math.sin(angle));
        }
      }
    });
  }
  const [[left, columns], [top, rows]] = [run(x), run(y)];
  return { map, left, top, columns, rows };
}

/** The first of the samples between which places lie, and how many, an odd number. */
function run(places: number[]): [number, number] {
  const [first, last] = places.map((place) => Math.floor(Math.round((place - 0.5) * PLACE_SCALE) / PLACE_SCALE)) as [number, number];
  return [first, (last - first + 2) | 1];
}

/** What texturePatch is for a strip's own samples: the same from this image of the map, RGBA from RGBA. */
export function polarPatch(image: PolarImage, { lattice, x, y }: Selection, samples: Uint8Array): Uint8Array {
  const [{ map }, stride, rows, columns] = [image, strideOf(lattice.shape), y.low.length, x.low.length];
  const patch = new Uint8Array(4 * rows * columns);
  const angles = Array.from({ length: columns }, (_, c) => map.angle((x.start + c) * stride));
  const [cosine, sine] = [Float64Array.from(angles, Math.cos), Float64Array.from(angles, Math.sin)];
  const within = (place: number, size: number) => Math.min(Math.max(place, 0), size - 1);
  for (let r = 0, at = 0; r < rows; r++) {
    const radius = map.radius(y.start + r);
    for (let c = 0; c < columns; c++, at += 4) {
      const across = within(radius * cosine[c]! - image.left - 0.5, image.columns);
      const down = within(radius * sine[c]! - image.top - 0.5, image.rows);
      const [column, row] = [Math.min(across | 0, image.columns - 2), Math.min(down | 0, image.rows - 2)];
      const [right, below] = [across - column, down - row];
      const above = 4 * (row * image.columns + column);
      const under = above + 4 * image.columns;
      for (let k = 0; k < 3; k++) {
        const high = samples[above + k]! + (samples[above + 4 + k]! - samples[above + k]!) * right;
        const low = samples[under + k]! + (samples[under + 4 + k]! - samples[under + k]!) * right;
        patch[at + k] = high + (low - high) * below + 0.5;
      }
      patch[at + 3] = samples[above + 3]!;
    }
  }
  return patch;
}
