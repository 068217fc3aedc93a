// Colour at a whole fraction of its resolution, and shape by some of its samples, where a graphics card takes no larger texture.

export interface Texels {
  x: number;
  y: number;
  width: number;
  height: number;
  /** RGBA, row by row; alpha is 0 or 255. */
  cells: Uint8Array;
}

/** A rectangle of texels where so many stand for one, across and down: each the mean of those that are not transparent. */
export function shrink(texels: Texels, [across, down]: readonly [number, number]): Texels {
  if (across === 1 && down === 1) return texels;
  const { x, y, width, height, cells } = texels;
  const [left, top] = [Math.floor(x / across), Math.floor(y / down)];
  const [columns, rows] = [Math.floor((x + width - 1) / across) - left + 1, Math.floor((y + height - 1) / down) - top + 1];
  const sums = new Uint32Array(4 * columns * rows);
  for (let row = 0, from = 0; row < height; row++) {
    const line = columns * (Math.floor((y + row) / down) - top);
    for (let column = 0; column < width; column++, from += 4) {
      if (cells[from + 3]! === 0) continue;
      const to = 4 * (line + Math.floor((x + column) / across) - left);
      sums[to]! += cells[from]!;
      sums[to + 1]! += cells[from + 1]!;
      sums[to + 2]! += cells[from + 2]!;
      sums[to + 3]!++;
    }
  }
  const small = new Uint8Array(sums.length);
  for (let at = 0; at < sums.length; at += 4) {
    const count = sums[at + 3]!;
    if (count === 0) continue;
    for (let part = 0; part < 3; part++) small[at + part] = Math.round(sums[at + part]! / count);
    small[at + 3] = 255;
  }
  return { x: left, y: top, width: columns, height: rows, cells: small };
}

export interface Samples {
  x: number;
  y: number;
  width: number;
  height: number;
  cells: Uint16Array;
}

/** Of a rectangle the samples whose row and column are multiples of `every`, counted in these; perhaps none. */
export function thin({ x, y, width, height, cells }: Samples, every: number): Samples {
  const [left, top] = [Math.ceil(x / every), Math.ceil(y / every)];
  const [columns, rows] = [Math.ceil((x + width) / every) - left, Math.ceil((y + height) / every) - top];
  const some = new Uint16Array(columns * rows);
  for (let row = 0, to = 0; row < rows; row++) {
    const from = ((top + row) * every - y) * width - x;
    for (let column = 0; column < columns; column++, to++) some[to] = cells[from + (left + column) * every]!;
  }
  return { x: left, y: top, width: columns, height: rows, cells: some };
}
