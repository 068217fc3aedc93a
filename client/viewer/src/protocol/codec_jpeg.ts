// Baseline JPEG 4:4:4 whose constant headers do not travel: mirrors protocol/codec_jpeg.py (PROTOCOL.md, "Payloads").

import { RemoteWireError } from './errors.ts';

const QUALITY_MIN = 12;
/** Q of the JPEG that stands for each quality from QUALITY_MIN on. */
const Q = [
  11, 12, 12, 13, 13, 14, 14, 15, 17, 18, 19, 21, 22, 23, 25, 27, 30, 33, 35, 37, 40,
  42, 48, 52, 57, 58, 65, 67, 71, 74, 76, 79, 81, 83, 85, 87, 89, 91, 92, 93, 94, 95,
];
const LUMA = hex(
  '100b0c0e0c0a100e0d0e1211101318281a181616183123251d283a333d3c3933383740485c4e404457453738506d5157' +
    '5f626768673e4d71797064785c656763',
);
const CHROMA = hex(
  '1112121815182f1a1a2f6342384263636363636363636363636363636363636363636363636363636363636363636363' +
    '63636363636363636363636363636363',
);
const HUFFMAN = hex(
  '0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000017d010203000411' +
    '05122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738393a43' +
    '4445464748494a535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5' +
    'a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa' +
    '0100030101010101010101010000000000000102030405060708090a0b1100020102040403040705040400010277000102031104' +
    '052131061241510761711322328108144291a1b1c109233352f0156272d10a162434e125f11718191a262728292a35363738393a' +
    '434445464748494a535455565758595a636465666768696a737475767778797a82838485868788898a92939495969798999aa2a3' +
    'a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa',
);
const SCAN_HEADER = segment(0xda, [3, 1, 0, 2, 0x11, 3, 0x11, 0, 0x3f, 0]);

/** Q of the JPEG that stands for a quality. Throws RemoteWireError off the scale. */
export function jpegQ(quality: number): number {
  const q = Q[quality - QUALITY_MIN];
  if (q === undefined) throw new RemoteWireError(`JPEG quality ${quality} is off the scale`);
  return q;
}

/** The whole JPEG file of a payload. Throws RemoteWireError where it is cut short or holds foreign markers. */
export function restoreJpeg(payload: Uint8Array, height: number, width: number, q: number): Uint8Array {
  const ownTables = payload[0] === 0xff && payload[1] === 0xc4;
  const tablesEnd = ownTables ? 2 + payload[2]! * 256 + payload[3]! : 0;
  const data = payload.subarray(tablesEnd);
  for (let at = data.indexOf(0xff); at >= 0; at = data.indexOf(0xff, at + 1)) {
    const end = at === data.length - 2;
    if (data[at + 1] !== (end ? 0xd9 : 0)) throw new RemoteWireError('JPEG payload holds markers other than its end');
  }
  if (data.at(-2) !== 0xff) throw new RemoteWireError('JPEG payload is cut short: no end marker');
  const tables = ownTables ? payload.subarray(0, tablesEnd) : segment(0xc4, HUFFMAN);
  return joined(frameHeader(height, width, q), tables, SCAN_HEADER, data);
}

/** SOI APP0 DQT DQT SOF0, byte for byte as libjpeg writes them. */
export function frameHeader(height: number, width: number, q: number): number[] {
  return [
    0xff, 0xd8,
    ...segment(0xe0, [0x4a, 0x46, 0x49, 0x46, 0, 1, 1, 0, 0, 1, 0, 1, 0, 0]),
    ...segment(0xdb, [0, ...scaled(LUMA, q)]),
    ...segment(0xdb, [1, ...scaled(CHROMA, q)]),
    ...segment(0xc0, [8, height >> 8, height & 255, width >> 8, width & 255, 3, 1, 0x11, 0, 2, 0x11, 1, 3, 0x11, 1]),
  ];
}

function scaled(base: number[], q: number): number[] {
  const scale = q < 50 ? Math.floor(5000 / q) : 200 - 2 * q;
  return base.map((step) => Math.min(Math.max(Math.floor((step * scale + 50) / 100), 1), 255));
}

function segment(marker: number, body: number[]): number[] {
  const length = body.length + 2;
  return [0xff, marker, length >> 8, length & 255, ...body];
}

function joined(...parts: ArrayLike<number>[]): Uint8Array {
  const whole = new Uint8Array(parts.reduce((size, part) => size + part.length, 0));
  parts.reduce((at, part) => (whole.set(part, at), at + part.length), 0);
  return whole;
}

function hex(text: string): number[] {
  return text.match(/../g)!.map((pair) => parseInt(pair, 16));
}
