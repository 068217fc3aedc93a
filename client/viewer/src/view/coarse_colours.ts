// Colours of a sphere's first view, made as soft along its rings as they are across them.

const PARTS = 4;

/**
 * RGBA of the same size. Towards a pole cells are as high as ever but ever narrower: as they are they would draw a star.
 * Each becomes the mean of those that together are as wide as high; transparent ones do not count.
 */
export function evened(texels: Uint8Array, width: number, height: number): Uint8Array {
  const even = texels.slice();
  for (let row = 0; row < height; row++) {
    const ring = Math.sin((Math.PI * (row + 0.5)) / height);
    const reach = Math.min(Math.floor(width / (4 * height * ring)), (width - 1) >> 1);
    if (reach > 0) evenRow(texels.subarray(PARTS * row * width, PARTS * (row + 1) * width), even, PARTS * row * width, reach);
  }
  return even;
}

/** A row as means over `reach` cells to either side, round and round; alpha stays. */
function evenRow(row: Uint8Array, even: Uint8Array, start: number, reach: number): void {
  const width = row.length / PARTS;
  const sum = [0, 0, 0, 0];
  const count = (column: number, sign: number) => {
    const at = PARTS * ((column + width) % width);
    for (let part = 0; part < PARTS - 1; part++) sum[part]! += sign * row[at + part]! * row[at + PARTS - 1]!;
    sum[PARTS - 1]! += sign * row[at + PARTS - 1]!;
  };
  for (let column = -reach; column < reach; column++) count(column, 1);
  for (let column = 0; column < width; column++) {
    count(column + reach, 1);
    for (let part = 0; part < PARTS - 1; part++) even[start + PARTS * column + part] = Math.round(sum[part]! / Math.max(sum[PARTS - 1]!, 1));
    count(column - reach, -1);
  }
}
