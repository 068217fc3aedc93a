const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value;
});

/** CRC-32 as zlib has it, going on from `crc`. */
export function crc32(data: Uint8Array, crc = 0): number {
  let value = ~crc;
  for (let index = 0; index < data.length; index++) value = TABLE[(value ^ data[index]!) & 0xff]! ^ (value >>> 8);
  return ~value >>> 0;
}
