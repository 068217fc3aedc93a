import assert from 'node:assert/strict';
import { test } from 'node:test';
import { PerspectiveCamera, Ray, Vector3 } from 'three';
import { backoffMs } from '../src/backoff.ts';
import { inParts } from '../src/telling.ts';
import { drawThumbnail, THUMBNAIL_SIDE } from '../src/thumbnail.ts';
import { formatState, parseState } from '../src/url_state.ts';
import { evened } from '../src/view/coarse_colours.ts';
import { boundsOf, fittingDistance } from '../src/view/framing.ts';
import { shortestPath } from '../src/view/path.ts';
import { locate, pick } from '../src/view/pick.ts';
import { joined, partOf, within } from '../src/view/repaint.ts';
import type { Part } from '../src/view/repaint.ts';
import { pointAt } from '../src/view/room.ts';
import { shrink, thin } from '../src/view/shrink.ts';
import { STRIDES, Tiles } from '../src/view/tiles.ts';
import type { Batch, Detail } from '../src/view/tiles.ts';

const INFO = {
  id: 'a', width: 360, height: 200, textureWidth: 720, textureHeight: 400, coarseWidth: 45, coarseHeight: 25,
  coarseTextureWidth: 90, coarseTextureHeight: 50, stepMm: 0.01, pitchMm: 1, zMaxMm: 100, theta0Rad: 0.3,
};
const TILE = 64;
const SPHERE = { ...INFO, geometry: 'sphere' as const };
/** A camera that looks at the middle from the side where x is less. */
function fromTheSide(): PerspectiveCamera {
  const camera = new PerspectiveCamera(28, 1, 1, 1000);
  camera.position.set(-500, 0, 0);
  camera.lookAt(0, 0, 0);
  camera.updateMatrixWorld();
  return camera;
}

function chosen(tiles: Tiles, camera: PerspectiveCamera, detail: Detail): Batch[] {
  tiles.choose(camera, 700, detail);
  return tiles.batches(camera);
}

const alike = (radiusMm: number) => new Uint16Array(INFO.width * INFO.height).fill(radiusMm / INFO.stepMm);

test('an address holds a view, and nonsense in it is left out', () => {
  const state = {
    scan: 'ab12', camera: { azimuth: 1, elevation: -0.5, distance: 300, target: [1, 2, 3] as [number, number, number] },
    foveae: [{ u: 0.25, v: 0.5 }], pins: [{ u: 0, v: 0.125, label: 'a, b & <c>' }],
    beside: { scan: 'cd34', camera: { azimuth: 2, elevation: 0.25, distance: 200, target: [0, 5, 0] as [number, number, number] }, foveae: [] },
  };
  assert.deepEqual(parseState(formatState(state)), state);
  const nothing = { scan: null, camera: null, foveae: [], pins: [], beside: null };
  for (const text of ['', 'scan=', 'camera=1,2,3', 'camera=0,0,-1,0,0,0', 'fovea=2,0', 'fovea=x', 'pin=1,1,a', 'beside=../x']) {
    assert.deepEqual(parseState(text), nothing, text);
  }
  assert.deepEqual(parseState('scan=../x)'), { ...nothing, scan: '---x-' }, 'no scan has such an id, so none is shown');
});

test('waits grow from half a second to eight', () => {
  assert.deepEqual([0, 1, 4, 30].map((attempt) => backoffMs(attempt, 0.5)), [500, 1000, 8000, 8000]);
});

test('what is picked is where it is drawn', () => {
  const steps = alike(50);
  for (const place of [{ u: 0.1, v: 0.5 }, { u: 0.999, v: 0.2 }, { u: 0.002, v: 0.9 }]) {
    const point = locate(INFO, steps, place)!;
    const from = new Vector3(point.x * 6, point.y + 20, point.z * 6);
    const picked = pick(INFO, steps, new Ray(from, point.clone().sub(from).normalize()))!;
    assert.ok(Math.abs(picked.u - place.u) < 1e-4 && Math.abs(picked.v - place.v) < 1e-4, JSON.stringify(picked));
  }
});

test('a void is looked through, on to the other side', () => {
  const steps = alike(50);
  for (let row = 80; row < 120; row++) steps.fill(0, row * INFO.width, row * INFO.width + 40);
  const inVoid = { u: 20 / 360, v: 0.5 };
  assert.equal(locate(INFO, steps, inVoid), null);
  const angle = INFO.theta0Rad + 2 * Math.PI * inVoid.u;
  const from = new Vector3(300 * Math.cos(angle), 0, -300 * Math.sin(angle));
  const picked = pick(INFO, steps, new Ray(from, from.clone().negate().normalize()))!;
  assert.ok(Math.abs(picked.u - (inVoid.u + 0.5)) < 1e-3);
});

test('a small picture of a stretched sphere has no gaps', () => {
  const [across, down] = [SPHERE.coarseWidth, SPHERE.coarseHeight];
  const steps = new Uint16Array(across * down).map((_, cell) => (cell < across * (down / 2) ? 8000 : 2000));
  const pixels = drawThumbnail(SPHERE, steps, new Uint8Array(3 * 90 * 50).fill(200), 0);
  for (const along of [1, THUMBNAIL_SIDE]) { // down the middle, then across it a quarter from the top
    const start = along === 1 ? THUMBNAIL_SIDE * 24 : 48;
    const step = along === 1 ? 1 : THUMBNAIL_SIDE;
    const line = Array.from({ length: THUMBNAIL_SIDE }, (_, at) => pixels[4 * (start + step * at) + 3]! > 0);
    const inside = line.slice(line.indexOf(true), line.lastIndexOf(true) + 1);
    assert.ok(inside.length > 50 && inside.every(Boolean), `${along}: ${line.map(Number).join('')}`);
  }
});

test('a sphere is picked where it is drawn, its poles too, from any side', () => {
  // A ball whose centre is not the grid's: it slopes at the poles, and columns differ there.
  const steps = alike(0).map((_, at) => {
    const [angle, polar] = [2 * Math.PI * ((at % 360) + 0.5) / 360 + SPHERE.theta0Rad, Math.PI * (Math.floor(at / 360) + 0.5) / 200];
    return Math.round((50 + 8 * Math.sin(polar) * Math.cos(angle)) / INFO.stepMm);
  });
  for (const place of [{ u: 0.1, v: 0.5 }, { u: 0.999, v: 0.003 }, { u: 0.4, v: 0 }, { u: 0.002, v: 0.9999 }]) {
    const point = locate(SPHERE, steps, place)!;
    const from = point.clone().sub(new Vector3(0, SPHERE.zMaxMm, 0)).multiplyScalar(4).add(new Vector3(20, SPHERE.zMaxMm + 9, 5));
    const picked = pick(SPHERE, steps, new Ray(from, point.clone().sub(from).normalize()))!;
    assert.ok(picked.u >= 0 && picked.u < 1 && picked.v >= 0 && picked.v < 1);
    assert.ok(locate(SPHERE, steps, picked)!.distanceTo(point) < 0.02, JSON.stringify([place, picked]));
  }
});

test('across a pole, and across the seam, nothing jumps', () => {
  const steps = alike(0).map((_, at) => 5000 + Math.round(100 * Math.cos((2 * Math.PI * ((at % 360) + 0.5)) / 360)));
  const along = (places: { u: number; v: number }[]) => places.map((place) => locate(SPHERE, steps, place)!);
  const [before, after] = along([{ u: 0.25, v: 1e-6 }, { u: 0.75, v: 1e-6 }]);
  assert.ok(before!.distanceTo(after!) < 0.01);
  const [left, right] = along([{ u: 1 - 1e-6, v: 0.4 }, { u: 1e-6, v: 0.4 }]);
  assert.ok(left!.distanceTo(right!) < 0.01);
});

test('the way over a cylinder is a helix, over the seam too, and bridges what was not measured', () => {
  const steps = alike(50);
  for (const [from, to] of [[{ u: 0.1, v: 0.3 }, { u: 0.3, v: 0.5 }], [{ u: 0.95, v: 0.7 }, { u: 0.1, v: 0.2 }]] as const) {
    const turn = Math.min(Math.abs(to.u - from.u), 1 - Math.abs(to.u - from.u));
    const helixMm = Math.hypot(2 * Math.PI * 50 * turn, (to.v - from.v) * 200);
    const path = shortestPath(INFO, steps, from, to)!;
    assert.ok(Math.abs(path.lengthMm / helixMm - 1) < 1e-3, `${path.lengthMm} ${helixMm}`);
    assert.equal(path.gapsMm, 0);
  }
  for (let row = 60; row < 140; row++) steps.fill(0, row * INFO.width + 60, row * INFO.width + 80);
  const over = shortestPath(INFO, steps, { u: 0.15, v: 0.5 }, { u: 0.25, v: 0.5 })!;
  const chordMm = 2 * 50 * Math.sin(Math.PI / 18);
  assert.ok(Math.abs(over.gapsMm - chordMm) < 1.5, `${over.gapsMm} ${chordMm}`);
  assert.equal(shortestPath(INFO, steps, { u: 70 / 360, v: 0.5 }, { u: 0.5, v: 0.5 }), null);
});

test('the way over a ball is a great circle, wherever its centre, poles and seam lie', () => {
  // A ball of 50 mm whose centre lies 20 mm off the grid's.
  const offset = new Vector3(12, -10, 12.5);
  const steps = alike(0).map((_, at) => {
    const out = pointAt(SPHERE, { u: ((at % 360) + 0.5) / 360, v: (Math.floor(at / 360) + 0.5) / 200 }, 1).setY(Math.cos((Math.PI * (Math.floor(at / 360) + 0.5)) / 200));
    const along = out.dot(offset);
    return Math.round((along + Math.sqrt(along * along - offset.lengthSq() + 2500)) / INFO.stepMm);
  });
  const centre = offset.clone().add(new Vector3(0, SPHERE.zMaxMm, 0));
  for (const [from, to] of [[{ u: 0.1, v: 0.3 }, { u: 0.3, v: 0.6 }], [{ u: 0.9, v: 0.45 }, { u: 0.15, v: 0.2 }], [{ u: 0.1, v: 0.08 }, { u: 0.55, v: 0.1 }]] as const) {
    const [a, b] = [from, to].map((place) => locate(SPHERE, steps, place)!.sub(centre));
    const arcMm = 50 * a!.angleTo(b!);
    const path = shortestPath(SPHERE, steps, from, to)!;
    assert.ok(Math.abs(path.lengthMm / arcMm - 1) < 2e-3, `${path.lengthMm} ${arcMm}`);
  }
});

test('a sphere is closed over its poles by a fan for each tile beside them', () => {
  const tiles = new Tiles(SPHERE, TILE);
  tiles.update(alike(50), new Uint8Array(45 * 25));
  const camera = new PerspectiveCamera(120, 1, 1, 1000);
  camera.position.set(0, SPHERE.zMaxMm, 120);
  camera.updateMatrixWorld();
  const batches = chosen(tiles, camera, { cellPx: 1, awayFactor: 1, trianglesMax: 1e6, tileSide: TILE });
  const fans = batches.flatMap(({ fans }) => fans.filter((_, at) => at % 2 === 0).map((column, at) => `${column} ${fans[2 * at + 1]}`));
  const columns = Array.from({ length: Math.ceil(INFO.width / TILE) }, (_, at) => at * TILE);
  assert.deepEqual(fans.sort(), columns.flatMap((column) => [`${column} 0`, `${column} 1`]).sort());
});

test('first colours of a sphere draw no star at a pole, and stay as they are elsewhere', () => {
  const [width, height] = [64, 33];
  const striped = Uint8Array.from({ length: 4 * width * height }, (_, at) => (at % 4 === 3 ? 255 : 200 * ((at >> 2) % 2)));
  striped.fill(0, 0, 16); // void: four cells of the first row
  const even = evened(striped, width, height);
  const row = (index: number) => [...even.subarray(4 * index * width, 4 * (index + 1) * width)].filter((_, at) => at % 4 === 0);
  for (const pole of [0, height - 1]) assert.ok(row(pole).every((value) => Math.abs(value - 100) <= 12), String(row(pole)));
  assert.deepEqual(row(16), row(16).map((_, column) => 200 * (column % 2)));
  assert.deepEqual([...even].filter((_, at) => at % 4 === 3), [...striped].filter((_, at) => at % 4 === 3));
});

test('everything fits the picture, however narrow', () => {
  const bounds = boundsOf(INFO, alike(50));
  assert.deepEqual([bounds.bottomMm, bounds.topMm], [-100, 100]);
  const ball = boundsOf(SPHERE, alike(50));
  assert.deepEqual([ball.bottomMm, ball.topMm], [50, 150]);
  assert.ok(Math.abs(ball.radiusMm - 50) < 0.01);
  assert.ok(fittingDistance(bounds, 0.4) > fittingDistance(bounds, 2));
});

test('what is turned away is drawn with fewer triangles, and what is not with as many', () => {
  const tiles = new Tiles(INFO, TILE);
  tiles.update(alike(50), new Uint8Array(45 * 25));
  const camera = fromTheSide();
  const strides = (awayFactor: number): Map<string, number> => {
    const batches = chosen(tiles, camera, { tileSide: TILE, cellPx: 4, awayFactor, trianglesMax: 1e6 });
    return new Map(batches.flatMap(({ corners }, index) => Array.from({ length: corners.length / 2 }, (_, k) => [`${corners[2 * k]},${corners[2 * k + 1]}`, STRIDES[index]!])));
  };
  const [all, fewer] = [strides(1), strides(4)];
  assert.deepEqual([...all.keys()].sort(), [...fewer.keys()].sort());
  for (const [tile, stride] of all) {
    const column = Number(tile.split(',')[0]) + TILE / 2;
    const towards = -Math.cos(INFO.theta0Rad + (2 * Math.PI * column) / INFO.width); // the camera is at -x
    if (towards > 0.2) assert.equal(fewer.get(tile), stride);
    if (towards < -0.6) assert.equal(fewer.get(tile), 4 * stride);
  }
});

test('the part of the picture that shows cells holds all of them, and little else', () => {
  const camera = fromTheSide();
  const steps = alike(50);
  const facing = INFO.width * (0.5 - INFO.theta0Rad / (2 * Math.PI)); // the column at -x
  const cells = { x: Math.round(facing) - 20, y: 80, width: 40, height: 40 };
  const part = partOf(INFO, steps, cells, 4, camera, 700, 700) as Part;
  for (let row = cells.y; row < cells.y + cells.height; row += 3) {
    for (let column = cells.x; column < cells.x + cells.width; column += 3) {
      const seen = pointAt(INFO, { u: (column + 0.5) / INFO.width, v: (row + 0.5) / INFO.height }, 50).project(camera);
      const [x, y] = [350 * (seen.x + 1), 350 * (1 - seen.y)];
      assert.ok(x > part.left && x < part.right && y > part.top && y < part.bottom);
    }
  }
  assert.ok(part.right - part.left < 125 && part.bottom - part.top < 140, JSON.stringify(part));
  assert.equal(partOf(INFO, new Uint16Array(steps.length), cells, 4, camera, 700, 700), null);
  camera.position.set(-40, 0, 0);
  camera.updateMatrixWorld();
  assert.equal(partOf(INFO, steps, cells, 4, camera, 700, 700), 'all', 'some of it is behind the camera');
  assert.deepEqual(joined({ left: 0, top: 5, right: 2, bottom: 6 }, { left: 1, top: 1, right: 9, bottom: 2 }), { left: 0, top: 1, right: 9, bottom: 6 });
  assert.deepEqual(within({ left: -3, top: 1.5, right: 9.2, bottom: 99 }, 50, 60), { left: 0, top: 1, right: 10, bottom: 60 });
  assert.equal(within({ left: 60, top: 0, right: 70, bottom: 9 }, 50, 60), null);
});

test('tiles that touch what has changed are looked at again, and are then as if all were', () => {
  const [steps, level, camera] = [alike(50), new Uint8Array(45 * 25).fill(6), fromTheSide()];
  const [some, all] = [new Tiles(INFO, TILE), new Tiles(INFO, TILE)];
  some.update(steps, level);
  const seen = (tiles: Tiles) => chosen(tiles, camera, { tileSide: TILE, cellPx: 1, awayFactor: 1, trianglesMax: 1e6 });
  const before = seen(some);
  const changed = { x: 152, y: 96, width: 16, height: 16 };
  for (let row = 96; row < 112; row++) {
    steps.fill(20 / INFO.stepMm, row * INFO.width + 152, row * INFO.width + 168);
    level.fill(0, Math.floor(row / 8) * 45 + 19, Math.floor(row / 8) * 45 + 21);
  }
  some.update(steps, level, changed);
  all.update(steps, level);
  assert.deepEqual(seen(some), seen(all));
  assert.notDeepEqual(seen(some), before);
});

test('neighbouring tiles share every vertex of their border', () => {
  const tiles = new Tiles(INFO, TILE);
  tiles.update(alike(50), new Uint8Array(45 * 25).map((_, block) => (block % 45 < 24 ? 0 : 6)));
  const camera = fromTheSide();
  const batches = chosen(tiles, camera, { tileSide: TILE, cellPx: 1, awayFactor: 4, trianglesMax: 1e6 });
  assert.ok(batches.filter(({ corners }) => corners.length).length > 1, 'several strides are drawn');
  const drawn = new Map<string, { stride: number; right: number; left: number }>();
  batches.forEach(({ corners, edges }, index) => {
    for (let k = 0; k < corners.length / 2; k++) {
      drawn.set(`${corners[2 * k]},${corners[2 * k + 1]}`, { stride: STRIDES[index]!, left: edges[4 * k]!, right: edges[4 * k + 1]! });
    }
  });
  for (const [name, tile] of drawn) {
    const [column, row] = name.split(',').map(Number) as [number, number];
    const beside = drawn.get(`${column + TILE < INFO.width ? column + TILE : 0},${row}`);
    if (beside) assert.deepEqual(border(tile.stride, tile.right), border(beside.stride, beside.left));
  }
});

/** Rows of the vertices on a tile's side, as the vertex shader moves them. */
function border(stride: number, edge: number): number[] {
  const rows = Array.from({ length: TILE / stride + 1 }, (_, k) => k * stride - ((k * stride) % edge));
  return [...new Set(rows)];
}

test('shrunk colour is the mean of what is there, wherever its rectangle begins', () => {
  const grey = (values: number[]) => Uint8Array.from(values.flatMap((value) => (value ? [value, value, value, 255] : [0, 0, 0, 0])));
  const texels = { x: 3, y: 2, width: 3, height: 2, cells: grey([10, 20, 40, 30, 0, 60]) };
  assert.equal(shrink(texels, [1, 1]), texels);
  assert.deepEqual(shrink(texels, [2, 1]), { x: 1, y: 2, width: 2, height: 2, cells: grey([10, 30, 30, 60]) });
  assert.deepEqual(shrink(texels, [2, 2]), { x: 1, y: 1, width: 2, height: 1, cells: grey([20, 40]) });
});

test('of thinned shape those samples are there that stand at multiples, wherever a rectangle begins', () => {
  const samples = { x: 3, y: 2, width: 4, height: 3, cells: Uint16Array.of(32, 42, 52, 62, 33, 43, 53, 63, 34, 44, 54, 64) };
  assert.deepEqual(thin(samples, 2), { x: 2, y: 1, width: 2, height: 2, cells: Uint16Array.of(42, 62, 44, 64) });
  assert.deepEqual(thin(samples, 4), { x: 1, y: 1, width: 1, height: 1, cells: Uint16Array.of(44) });
  assert.equal(thin({ ...samples, width: 1 }, 2).cells.length, 0);
  assert.equal(thin({ x: 1, y: 1, width: 1, height: 1, cells: Uint16Array.of(11) }, 8).cells.length, 0);
});

test('a large change is told in parts, which are the same together', () => {
  const [width, height] = [1000, 1200];
  const cells = Uint16Array.from({ length: width * height }, (_, at) => at % 65521);
  const small = { x: 1, y: 2, width: 2, height: 1, cells: Uint8Array.of(1, 2, 3, 4, 5, 6, 7, 8) };
  const parts = inParts([{ x: 7, y: 100, width, height, cells }, small]);
  assert.ok(parts.length > 2 && parts.every((part) => part.reduce((sum, one) => sum + one.width * one.height, 0) <= 1 << 19));
  const told = parts.flat();
  assert.deepEqual(told.at(-1), small);
  let row = 100;
  for (const one of told.slice(0, -1)) {
    assert.deepEqual([one.x, one.y, one.width], [7, row, width]);
    assert.deepEqual(one.cells, cells.slice((row - 100) * width, (row - 100 + one.height) * width));
    row += one.height;
  }
  assert.equal(row, 100 + height);
  assert.deepEqual(inParts([small, small]), [[small, small]]);
});
