// What was received of a scan, as it came: who has it can make the same of it again.

import type { Codecs } from './protocol/codec.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { Model } from './protocol/model.ts';
import { parseRefinement } from './protocol/refinement.ts';

/** More is not kept: a file of it would be too large to be sent about. */
const BYTES_MAX = 64e6;

export class Recording {
  private messages: Uint8Array[] = [];
  private size = 0;

  constructor(readonly info: ScanInfo) {}

  /** One more refinement was taken in. */
  add(message: Uint8Array): void {
    this.size += 4 + message.length;
    if (this.size <= BYTES_MAX) this.messages.push(message);
    else this.messages = [];
  }

  /** All refinements in order, each after its length as four bytes; null where there were too many. */
  toBytes(): Uint8Array<ArrayBuffer> | null {
    if (this.size > BYTES_MAX) return null;
    const bytes = new Uint8Array(this.size);
    let at = 0;
    for (const message of this.messages) {
      new DataView(bytes.buffer).setUint32(at, message.length, true);
      bytes.set(message, at + 4);
      at += 4 + message.length;
    }
    return bytes;
  }
}

/** The model that refinements make, each after its length as four bytes. Throws RemoteWireError. */
export async function modelOf(info: ScanInfo, recorded: Uint8Array, codecs: Codecs): Promise<Model> {
  const model = new Model(info, 0);
  const view = new DataView(recorded.buffer, recorded.byteOffset, recorded.byteLength);
  for (let at = 0; at < recorded.length; ) {
    const size = view.getUint32(at, true);
    await model.apply(parseRefinement(recorded.subarray(at + 4, at + 4 + size)), codecs);
    at += 4 + size;
  }
  return model;
}
