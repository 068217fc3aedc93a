// Columns of a running sweep, thinned: mirrors protocol/live.py (PROTOCOL.md, "Live view").

import { RemoteWireError } from './errors.ts';
import { RANGE, TEXTURE } from './lattice.ts';
import type { Channel } from './lattice.ts';

const MAGIC = 0x4c46;
const VERSION = 1;
const HEADER_BYTES = 12;
const SAMPLE_BYTES: Record<Channel, number> = { [RANGE]: 2, [TEXTURE]: 3 };

/** Whole columns of the thinned grid; `samples` column after column, little-endian. */
export interface LiveColumns {
  channel: Channel;
  sweep: number;
  columns: number[];
  rows: number;
  samples: Uint8Array;
}

export const isLive = (data: Uint8Array): boolean => data[0] === (MAGIC & 0xff) && data[1] === MAGIC >> 8;

/** Read live columns. Throws RemoteWireError when the bytes are not one whole message. */
export function parseLive(data: Uint8Array): LiveColumns {
  if (data.length < HEADER_BYTES) throw new RemoteWireError('live columns cut short');
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const [channel, count, rows] = [view.getUint8(3), view.getUint16(8, true), view.getUint16(10, true)];
  if (view.getUint8(2) !== VERSION || (channel !== RANGE && channel !== TEXTURE)) {
    throw new RemoteWireError('no live columns of this version');
  }
  const body = HEADER_BYTES + 2 * count;
  if (!count || !rows || data.length !== body + count * rows * SAMPLE_BYTES[channel]) {
    throw new RemoteWireError('live columns of another size than they announce');
  }
  const columns = Array.from({ length: count }, (_, index) => view.getUint16(HEADER_BYTES + 2 * index, true));
  return { channel, sweep: view.getUint32(4, true), columns, rows, samples: data.subarray(body) };
}
