import assert from 'node:assert/strict';
import { test } from 'node:test';
import { PerspectiveCamera, Ray, Vector3 } from 'three';
import { backoffMs } from '../src/backoff.ts';
import { formatState, parseState } from '../src/url_state.ts';
import { boundsOf, fittingDistance } from '../src/view/framing.ts';
import { locate, pick } from '../src/view/pick.ts';
import { STRIDES, Tiles } from '../src/view/tiles.ts';

const INFO = {
  id: 'a', width: 360, height: 200, textureWidth: 720, textureHeight: 400, coarseWidth: 45, coarseHeight: 25,
  coarseTextureWidth: 90, coarseTextureHeight: 50, stepMm: 0.01, pitchMm: 1, zMaxMm: 100, theta0Rad: 0.3,
};
const TILE = 64;
const cylinder = (radiusMm: number) => new Uint16Array(INFO.width * INFO.height).fill(radiusMm / INFO.stepMm);

test('an address holds a view, and nonsense in it is left out', () => {
  const state = {
    scan: 'ab12', camera: { azimuth: 1, elevation: -0.5, distance: 300, target: [1, 2, 3] as [number, number, number] },
    foveae: [{ u: 0.25, v: 0.5 }], pins: [{ u: 0, v: 0.125, label: 'a, b & <c>' }],
  };
  assert.deepEqual(parseState(formatState(state)), state);
  const nothing = { scan: null, camera: null, foveae: [], pins: [] };
  for (const text of ['', 'scan=../x', 'camera=1,2,3', 'camera=0,0,-1,0,0,0', 'fovea=2,0', 'fovea=x', 'pin=1,1,a']) {
    assert.deepEqual(parseState(text), nothing, text);
  }
});

test('waits grow from half a second to eight', () => {
  assert.deepEqual([0, 1, 4, 30].map((attempt) => backoffMs(attempt, 0.5)), [500, 1000, 8000, 8000]);
});

test('what is picked is where it is drawn', () => {
  const steps = cylinder(50);
  for (const place of [{ u: 0.1, v: 0.5 }, { u: 0.999, v: 0.2 }, { u: 0.002, v: 0.9 }]) {
    const point = locate(INFO, steps, place)!;
    const from = new Vector3(point.x * 6, point.y + 20, point.z * 6);
    const picked = pick(INFO, steps, new Ray(from, point.clone().sub(from).normalize()))!;
    assert.ok(Math.abs(picked.u - place.u) < 1e-4 && Math.abs(picked.v - place.v) < 1e-4, JSON.stringify(picked));
  }
});

test('a void is looked through, on to the other side', () => {
  const steps = cylinder(50);
  for (let row = 80; row < 120; row++) steps.fill(0, row * INFO.width, row * INFO.width + 40);
  const inVoid = { u: 20 / 360, v: 0.5 };
  assert.equal(locate(INFO, steps, inVoid), null);
  const angle = INFO.theta0Rad + 2 * Math.PI * inVoid.u;
  const from = new Vector3(300 * Math.cos(angle), 0, -300 * Math.sin(angle));
  const picked = pick(INFO, steps, new Ray(from, from.clone().negate().normalize()))!;
  assert.ok(Math.abs(picked.u - (inVoid.u + 0.5)) < 1e-3);
});

test('everything fits the picture, however narrow', () => {
  const bounds = boundsOf(INFO, cylinder(50));
  assert.deepEqual([bounds.bottomMm, bounds.topMm], [-100, 100]);
  assert.ok(fittingDistance(bounds, 0.4) > fittingDistance(bounds, 2));
});

test('neighbouring tiles share every vertex of their border', () => {
  const tiles = new Tiles(INFO, TILE);
  tiles.update(cylinder(50), new Uint8Array(45 * 25).map((_, block) => (block % 45 < 24 ? 0 : 6)));
  const camera = new PerspectiveCamera(28, 1, 1, 1000);
  camera.position.set(-500, 0, 0);
  camera.lookAt(0, 0, 0);
  camera.updateMatrixWorld();
  const { batches } = tiles.choose(camera, 700, { tileSide: TILE, cellPx: 1, trianglesMax: 1e6 });
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
