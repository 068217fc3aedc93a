// All that is held of a scan, told to the page at once.

import type { FromWorker, Snapshot } from './link.ts';
import { CHANNELS, TEXTURE } from './protocol/lattice.ts';
import type { Changed, Model } from './protocol/model.ts';

export type Tell = (message: FromWorker, transfer?: Transferable[]) => void;

/** Cells that the page's own thread takes at once: more would keep it too long. */
const PART_CELLS = 1 << 19;

/** Tell a model whose first view is in. fresh: the page asked for this scan, and has not seen it yet. */
export function tellAll(model: Model, fresh: boolean, tell: Tell): void {
  const [range, texture] = CHANNELS.map((channel) => model.holdings.channels[channel].level.slice());
  const snapshot = { info: model.info, steps: model.steps.slice(), coarseTexels: model.coarseTexels.slice(), levels: [range!, texture!] } as Snapshot;
  const buffers = [snapshot.steps.buffer as ArrayBuffer, snapshot.coarseTexels.buffer as ArrayBuffer];
  tell({ kind: 'opened', snapshot, fresh }, buffers);
  if (model.hasTexels) tellTexels(model, tell);
}

function tellTexels(model: Model, tell: Tell): void {
  const { textureWidth: width, textureHeight: height } = model.info;
  const level = model.holdings.channels[TEXTURE].level.slice();
  const most = Math.max(1, Math.floor(PART_CELLS / width));
  for (let y = 0; y < height; y += most) {
    const rows = Math.min(most, height - y);
    const cells = new Uint8Array(model.texels.slice(y * width, (y + rows) * width).buffer);
    tell({ kind: 'patch', channel: TEXTURE, changed: [{ x: 0, y, width, height: rows, cells }], level }, [cells.buffer]);
  }
  tell({ kind: 'patched' });
}

/** What has changed, in parts that the page's own thread takes one after the other. */
export function inParts(changed: Changed[]): Changed[][] {
  const parts: Changed[][] = [[]];
  let room = PART_CELLS;
  for (const one of changed.flatMap(cut)) {
    const size = one.width * one.height;
    if (size > room && parts.at(-1)!.length) {
      parts.push([]);
      room = PART_CELLS;
    }
    parts.at(-1)!.push(one);
    room -= size;
  }
  return parts;
}

/** A rectangle as strips, none of them too large. */
function cut(one: Changed): Changed[] {
  const { x, y, width, height, cells } = one;
  const most = Math.max(1, Math.floor(PART_CELLS / width));
  if (height <= most) return [one];
  const values = cells.length / (width * height);
  return Array.from({ length: Math.ceil(height / most) }, (_, at) => {
    const rows = Math.min(most, height - at * most);
    const from = at * most * width * values;
    return { x, y: y + at * most, width, height: rows, cells: cells.slice(from, from + rows * width * values) };
  });
}
