// One refinement on the wire: mirrors protocol/refinement.py (PROTOCOL.md, "Refinement").

import { crc32 } from './crc32.ts';
import { RemoteWireError } from './errors.ts';
import { RANGE, TEXTURE } from './lattice.ts';
import type { Channel, Parameters } from './lattice.ts';

const MAGIC = 0x5246;
const VERSION = 1;
const HEADER_BYTES = 36;
const CRC_BYTES = 4;
const PARAMETERS_BYTES = 17;
const PARAMETERS_MAX = 4096;
const MASK_MAX = 8 << 20;
const PAYLOAD_MAX = 256 << 20;
const HALF = 15;
const HALVES_MAX = 8;

export const COARSE = 0;
export const FOVEA = 1;

export interface Refinement {
  generator: number;
  channel: Channel;
  epoch: number;
  seq: number;
  look: number;
  codec: number;
  quality: number;
  samples: number;
  selfContained: boolean;
  parameters: Parameters | null;
  mask: Uint8Array;
  payload: Uint8Array;
}

/** Read a whole, intact refinement. Throws RemoteWireError. */
export function parseRefinement(data: Uint8Array): Refinement {
  if (data.length < HEADER_BYTES + CRC_BYTES) throw new RemoteWireError('refinement is cut short');
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const [u8, u16, u32] = [
    (at: number) => view.getUint8(at), (at: number) => view.getUint16(at, true), (at: number) => view.getUint32(at, true),
  ];
  const [generator, channel] = [u8(3), u8(4)];
  if (u16(0) !== MAGIC || u8(2) !== VERSION) throw new RemoteWireError(`not a refinement of version ${VERSION}`);
  if (generator > FOVEA || channel > TEXTURE) throw new RemoteWireError('refinement of unknown kind');
  const [parametersSize, maskSize, payloadSize] = [u16(24), u32(28), u32(32)];
  if (parametersSize > PARAMETERS_MAX || maskSize > MASK_MAX || payloadSize > PAYLOAD_MAX) {
    throw new RemoteWireError('refinement announces more than is allowed');
  }
  const maskAt = HEADER_BYTES + parametersSize;
  const payloadAt = maskAt + maskSize;
  const end = payloadAt + payloadSize;
  if (data.length !== end + CRC_BYTES) throw new RemoteWireError(`refinement of ${data.length} bytes announces ${end + 4}`);
  if (u32(end) !== crc32(data.subarray(0, end))) throw new RemoteWireError('refinement fails its checksum');
  const parameters = parametersSize ? parseParameters(data.subarray(HEADER_BYTES, maskAt)) : null;
  if ((parameters === null) !== (generator === COARSE)) {
    throw new RemoteWireError('a first view carries no lattice; everything else does');
  }
  return {
    generator, channel: channel === RANGE ? RANGE : TEXTURE, epoch: u16(8), seq: u32(12), look: u32(16), codec: u8(5),
    quality: u16(10), samples: u32(20), selfContained: (u8(6) & 1) === 1, parameters,
    mask: data.subarray(maskAt, payloadAt), payload: data.subarray(payloadAt, end),
  };
}

const allowed = (strides: number): { strides?: number } => (strides ? { strides } : {});

/** Lattice parameters as they travel. Throws RemoteWireError when the bytes are not whole. */
export function parseParameters(data: Uint8Array): Parameters {
  if (data.length < PARAMETERS_BYTES) throw new RemoteWireError('lattice parameters are cut short');
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const u16 = (at: number) => view.getUint16(at, true);
  return {
    halfSpacing: view.getUint8(0) & 31, ...allowed(view.getUint8(0) >> 5), blockX: u16(1), blockY: u16(3), blocksWide: u16(5), blocksHigh: u16(7),
    rhoX: view.getUint32(9, true), rhoY: view.getUint32(13, true),
    listed: data.length > PARAMETERS_BYTES ? parseRuns(data.subarray(PARAMETERS_BYTES)) : null,
  };
}

/** Run lengths of listed blocks, from half bytes (PROTOCOL.md, "Refinement"). Throws RemoteWireError. */
function parseRuns(data: Uint8Array): number[] {
  const halves = Array.from(data).flatMap((byte) => [byte & 15, byte >> 4]);
  const runs = [0, 0];
  for (let at = 0; at < halves.length;) {
    let step = halves[at++]!;
    if (step === HALF && at === halves.length) break;
    for (let more = step === HALF, scale = 1; more; scale *= 8) {
      if (at === halves.length || scale === 8 ** HALVES_MAX) throw new RemoteWireError('run lengths are cut short or out of bounds');
      step += (halves[at]! & 7) * scale;
      more = halves[at++]! > 7;
    }
    const run = runs.at(-2)! + (step % 2 ? -(step + 1) / 2 : step / 2);
    if (run < 0) throw new RemoteWireError('run length below nought');
    runs.push(run);
  }
  return runs.slice(2);
}
