// Range, coded near-losslessly by integer lifting: mirrors the decoding half of protocol/codec_lift.py.

import { RemoteWireError } from './errors.ts';
import { inflate } from './inflate.ts';

/** Rows and columns of an image. */
export interface Shape {
  height: number;
  width: number;
}

const STEPS_MAX = 65535;
const ESCAPE = 3;
const BYTE = 255;
const WORD_MAX = 4 * STEPS_MAX;

/** (height x width) steps, within 1..65535, of each image in a payload. Throws RemoteWireError. */
export async function decodeLift(payload: Uint8Array, shapes: readonly Shape[], quantum: number): Promise<Uint16Array[]> {
  const count = shapes.reduce((sum, { height, width }) => sum + height * width, 0);
  const misses = unpack(await inflate(payload, 6 * count + 8), count);
  let at = 0;
  return shapes.map(({ height, width }) => {
    const values = synthesise(misses.subarray(at, at += height * width), height, width, quantum);
    const steps = new Uint16Array(values.length);
    for (let index = 0; index < steps.length; index++) steps[index] = Math.min(Math.max(values[index]!, 1), STEPS_MAX);
    return steps;
  });
}

/** The misses as they travel: two bits each, 3 for "see the escapes"; a byte each, 255 for "see the words". */
function unpack(data: Uint8Array, count: number): Int32Array {
  const packed = Math.ceil(count / 4);
  const misses = new Int32Array(count);
  const escaped: number[] = [];
  if (data.length < packed) throw new RemoteWireError('range payload is cut short');
  for (let index = 0; index < count; index++) {
    misses[index] = (data[index >> 2]! >> (2 * (index & 3))) & 3;
    if (misses[index] === ESCAPE) escaped.push(index);
  }
  let word = packed + escaped.length;
  if (data.length < word) throw new RemoteWireError('range payload is cut short');
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  escaped.forEach((place, index) => {
    const byte = data[packed + index]!;
    misses[place]! += byte;
    if (byte < BYTE) return;
    if (word + 4 > data.length) throw new RemoteWireError('range payload is cut short');
    const wide = view.getUint32(word, true);
    if (wide > WORD_MAX) throw new RemoteWireError('range payload holds a value out of bounds');
    misses[place]! += wide;
    word += 4;
  });
  if (word !== data.length) throw new RemoteWireError('range payload is too long');
  for (let index = 0; index < count; index++) misses[index] = (misses[index]! >> 1) ^ -(misses[index]! & 1);
  return misses;
}

interface Step {
  height: number;
  width: number;
  stride: number;
}

/** Coarse to fine: each level lies in every `stride`-th row and column of the whole image. */
function synthesise(misses: Int32Array, height: number, width: number, quantum: number): Int32Array {
  const image = new Int32Array(height * width);
  const steps: Step[] = [{ height, width, stride: 1 }];
  for (let last = steps[0]!; Math.max(last.height, last.width) > 2; last = steps.at(-1)!) {
    steps.push({ height: Math.ceil(last.height / 2), width: Math.ceil(last.width / 2), stride: 2 * last.stride });
  }
  let taken = 0;
  const coarsest = steps.pop()!;
  for (let y = 0; y < coarsest.height; y++) {
    for (let x = 0; x < coarsest.width; x++) image[coarsest.stride * (y * width + x)] = misses[taken++]! * quantum;
  }
  for (const step of steps.reverse()) {
    const { stride } = step;
    const even = { lines: Math.ceil(step.height / 2), line: 2 * stride * width, length: step.width, next: stride };
    taken = fill(image, misses, taken, quantum, even, false);
    const odd = { lines: step.width, line: stride, length: step.height, next: stride * width };
    taken = fill(image, misses, taken, quantum, odd, true);
  }
  return image;
}

interface Lines {
  lines: number;
  line: number;
  length: number;
  next: number;
}

/** Fill every second sample of each line from its neighbours and its miss; misses lie line by line, or across. */
function fill(
  image: Int32Array, misses: Int32Array, taken: number, quantum: number, along: Lines, across: boolean,
): number {
  const between = along.length >> 1;
  for (let line = 0; line < along.lines; line++) {
    for (let k = 0; k < between; k++) {
      const at = line * along.line + (2 * k + 1) * along.next;
      const left = image[at - along.next]!;
      const predicted = 2 * k + 2 < along.length ? (left + image[at + along.next]! + 1) >> 1 : left;
      const miss = misses[taken + (across ? k * along.lines + line : line * between + k)]!;
      image[at] = predicted + miss * quantum;
    }
  }
  return taken + along.lines * between;
}
