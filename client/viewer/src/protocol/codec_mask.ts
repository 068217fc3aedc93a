// Which samples of a window were not measured: mirrors the decoding half of protocol/codec_mask.py.

import { RemoteWireError } from './errors.ts';
import { inflate } from './inflate.ts';

/** A byte a cell, 1 where void; row by row. Throws RemoteWireError. */
export async function decodeMask(payload: Uint8Array, height: number, width: number): Promise<Uint8Array> {
  const mask = new Uint8Array(height * width);
  if (payload.length === 0) return mask;
  const bits = Math.ceil(mask.length / 8);
  const data = await inflate(payload, 1 + bits);
  if (data.length === 0) throw new RemoteWireError('mask is empty');
  if (data[0] !== 0) return fillBetweenEdges(mask, parseVarints(data, 3), height, width);
  if (data.length !== 1 + bits) throw new RemoteWireError('mask has fewer bits than samples');
  for (let index = 0; index < mask.length; index++) mask[index] = (data[1 + (index >> 3)]! >> (7 - (index & 7))) & 1;
  return mask;
}

function fillBetweenEdges(mask: Uint8Array, numbers: number[], height: number, width: number): Uint8Array {
  const bands = readBands(numbers, height, width);
  let first = 2 * bands.length;
  let move = bands.reduce((at, [, edges]) => at + edges, first);
  const length = bands.reduce((at, [rows, edges]) => at + (rows - 1) * edges, move);
  if (numbers.length !== length) throw new RemoteWireError('mask has another number of edges than it announces');
  let top = 0;
  for (const [rows, edges] of bands) {
    const paths: number[][] = [];
    for (let edge = 0, column = 0; edge < edges; edge++) {
      column += numbers[first++]!;
      const path = [column];
      for (let row = 1; row < rows; row++) path.push(path.at(-1)! + signed(numbers[move++]!));
      paths.push(path);
    }
    for (let row = 0; row < rows; row++) fillRow(mask, (top + row) * width, width, paths.map((path) => path[row]!));
    top += rows;
  }
  return mask;
}

/** [rows, edges] of each band; they add up to the height, and no row has more edges than columns. */
function readBands(numbers: number[], height: number, width: number): [number, number][] {
  const bands: [number, number][] = [];
  let left = height;
  for (let at = 0; left > 0; at += 2) {
    const [rows, edges] = [numbers[at] ?? 0, numbers[at + 1] ?? Infinity];
    if (rows < 1 || rows > left || edges > width) throw new RemoteWireError('mask has a band out of bounds');
    bands.push([rows, edges]);
    left -= rows;
  }
  return bands;
}

function fillRow(mask: Uint8Array, start: number, width: number, edges: number[]): void {
  edges.forEach((edge, index) => {
    if (edge < 0 || edge >= width || edge <= (edges[index - 1] ?? -1)) {
      throw new RemoteWireError('mask has edges outside it or out of order');
    }
    if (index % 2 === 0) mask.fill(1, start + edge, start + (edges[index + 1] ?? width));
  });
}

const signed = (number: number): number => (number & 1 ? -((number + 1) >> 1) : number >> 1);

/** Numbers of seven bits a byte, low first, each of at most `most` bytes. Throws RemoteWireError. */
function parseVarints(data: Uint8Array, most: number): number[] {
  const values: number[] = [];
  let [value, bytes] = [0, 0];
  for (const byte of data) {
    value += (byte & 0x7f) * 2 ** (7 * bytes++);
    if (bytes > most) throw new RemoteWireError('a number out of bounds');
    if (byte < 0x80) {
      values.push(value);
      [value, bytes] = [0, 0];
    }
  }
  if (bytes) throw new RemoteWireError('numbers are cut short');
  return values;
}
