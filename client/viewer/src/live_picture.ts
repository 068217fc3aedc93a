// A running sweep as it comes in: columns of the coarse grids, put where they belong.

import { RANGE } from './protocol/lattice.ts';
import type { LiveColumns } from './protocol/live.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { RemoteWireError } from './protocol/errors.ts';

export class LivePicture {
  readonly steps: Uint16Array;
  /** RGBA, transparent where nothing has come yet. */
  readonly texels: Uint8Array;

  constructor(readonly sweep: number, private readonly grid: ScanInfo) {
    this.steps = new Uint16Array(grid.coarseWidth * grid.coarseHeight);
    this.texels = new Uint8Array(4 * grid.coarseTextureWidth * grid.coarseTextureHeight);
  }

  /** Put columns in their place. Throws RemoteWireError when there is no such place. */
  take({ channel, columns, rows, samples }: LiveColumns): void {
    const { coarseWidth, coarseHeight, coarseTextureWidth, coarseTextureHeight } = this.grid;
    const [width, height] = channel === RANGE ? [coarseWidth, coarseHeight] : [coarseTextureWidth, coarseTextureHeight];
    if (rows !== height || columns.some((column) => column >= width)) throw new RemoteWireError('live columns elsewhere');
    columns.forEach((column, index) => {
      for (let row = 0; row < rows; row++) {
        const [from, to] = [index * rows + row, row * width + column];
        if (channel === RANGE) this.steps[to] = samples[2 * from]! | (samples[2 * from + 1]! << 8);
        else this.texels.set([samples[3 * from]!, samples[3 * from + 1]!, samples[3 * from + 2]!, 255], 4 * to);
      }
    });
  }
}

/** The grid that the live picture is drawn as: the scan to be, as coarse as its columns come. */
export function thinned(grid: ScanInfo): ScanInfo {
  return {
    ...grid,
    width: grid.coarseWidth,
    height: grid.coarseHeight,
    pitchMm: (grid.pitchMm * grid.height) / grid.coarseHeight,
    textureWidth: grid.coarseTextureWidth,
    textureHeight: grid.coarseTextureHeight,
  };
}
