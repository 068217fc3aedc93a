// Spheres as the wire has them: strips of own samples, held against the vectors that Python reads too.

import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Codecs } from '../src/protocol/codec.ts';
import { crc32 } from '../src/protocol/crc32.ts';
import { RemoteWireError } from '../src/protocol/errors.ts';
import { littleEndian, mix32, rankOf } from '../src/protocol/holdings.ts';
import { RANGE, TEXTURE } from '../src/protocol/lattice.ts';
import type { Channel, ChannelShape } from '../src/protocol/lattice.ts';
import { Model } from '../src/protocol/model.ts';
import { COARSE, FOVEA, parseRefinement } from '../src/protocol/refinement.ts';
import type { Refinement } from '../src/protocol/refinement.ts';
import { ringStrides } from '../src/protocol/rings.ts';
import type { ScanInfo } from '../src/protocol/messages.ts';
import { buildStrips, imageOfPole, samplesOf, selectStrips, splitParts } from '../src/protocol/strips.ts';
import { bytes, fromHex, json, words, worst } from './golden.ts';

const GOLDEN = json('sphere/strips.json');
const [RAW, JPEG, QUALITY] = [0, 1, 53];
const SCANLESS = fromHex('ffd9'); // a JPEG's end, for a decoder that does not look
const INFO = {
  id: 'a', width: 64, height: 136, textureWidth: 64, textureHeight: 136, coarseWidth: 8, coarseHeight: 17,
  coarseTextureWidth: 8, coarseTextureHeight: 17, stepMm: 1, pitchMm: 1, zMaxMm: 0, theta0Rad: 0, geometry: 'sphere' as const,
};
const SHAPE: ChannelShape = { channel: RANGE, width: 64, height: 136, coarseWidth: 8, coarseHeight: 17, sphere: true };

/** A model with a first view that is 1 everywhere, whose JPEGs decode to what `texels` says. */
async function opened(texels: (count: number) => Uint8Array, info: ScanInfo = INFO): Promise<{ model: Model; codecs: Codecs }> {
  const codecs = new Codecs(() => Promise.reject(new Error('no HTJ2K here')), (_, width, height) => Promise.resolve(texels(width * height)));
  const model = new Model(info, 1);
  const size = INFO.coarseWidth * INFO.coarseHeight;
  const ones = littleEndian(new Uint16Array(size).fill(1));
  await model.apply(refinement({ generator: COARSE, channel: RANGE, payload: ones, samples: size }), codecs);
  await model.apply(refinement({ generator: COARSE, channel: TEXTURE, codec: JPEG, quality: QUALITY, samples: size, payload: SCANLESS }), codecs);
  model.nextSeq = 0;
  return { model, codecs };
}

function refinement(said: Partial<Refinement> & { channel: Channel }): Refinement {
  return {
    generator: FOVEA, epoch: 1, seq: 0, look: 1, codec: RAW, quality: 1, samples: 0, selfContained: false, parameters: null,
    mask: new Uint8Array(), payload: new Uint8Array(), ...said,
  };
}

test('strides of rings are those of Python', () => {
  for (const [width, height, side, half, strides] of GOLDEN.strides) {
    assert.deepEqual([...ringStrides(width, height, side, half)], strides, `${width} x ${height}`);
  }
});

test('strips carry what Python says', () => {
  const { holdings } = new Model(INFO, 1);
  for (const [channel, cases] of [[RANGE, [GOLDEN.range[0]]], [TEXTURE, GOLDEN.texture]] as const) {
    for (const want of cases) {
      const rank = rankOf(channel, want.quality ?? 1);
      const strips = selectStrips(buildStrips({ ...SHAPE, channel }, want.parameters), holdings.channels[channel], rank);
      assert.equal(strips.length, want.strips.length);
      strips.forEach(({ selection: { lattice, x, y } }, index) => {
        const { stride, xAt, rows, columns, yStart, xStart, height, width } = want.strips[index];
        assert.deepEqual([lattice.shape.stride, lattice.x.at], [stride, xAt]);
        assert.deepEqual([y.sample.length, x.sample.length, y.start, x.start], [rows, columns, yStart, xStart]);
        assert.deepEqual([y.low.length, x.low.length], [height, width]);
      });
    }
  }
});

test('a sphere refined step by step is held as Python holds it', async () => {
  const { model, codecs } = await opened((count) => new Uint8Array(4 * count));
  for (const want of GOLDEN.range) {
    if (want.refinement) await model.apply(parseRefinement(fromHex(want.refinement)), codecs);
    assert.equal(crc32(littleEndian(model.steps)).toString(16).padStart(8, '0'), want.denseCrc);
    assert.deepEqual(model.holdings.channels[RANGE].toRuns(), want.runs);
    assert.deepEqual([model.holdings.content, model.holdings.digest()], [want.content, want.digest]);
  }
  assert.deepEqual(model.steps, words('sphere/range.bin'));
});

test('texture of a sphere agrees within the tolerance', async () => {
  for (const want of GOLDEN.texture) {
    let done = 0;
    const { model, codecs } = await opened((count) => {
      const first = done;
      done += 3 * count;
      return Uint8Array.from({ length: 4 * count }, (_, k) => (k % 4 === 3 ? 255 : mix32(first + 3 * (k >> 2) + (k % 4)) % 256));
    });
    done = 0;
    const { parameters } = want;
    const strips = selectStrips(buildStrips({ ...SHAPE, channel: TEXTURE }, parameters), model.holdings.channels[TEXTURE], rankOf(TEXTURE, QUALITY));
    const pole = imageOfPole(model.shapes[TEXTURE], parameters, strips);
    assert.deepEqual(pole && [pole.left, pole.top, pole.columns, pole.rows], want.polar);
    const payload = strips.length > 1 && !pole ? fromHex('02000000ffd9'.repeat(strips.length)) : SCANLESS;
    const samples = samplesOf(strips, pole);
    await model.apply(refinement({ channel: TEXTURE, codec: JPEG, quality: QUALITY, samples, parameters, payload }), codecs);
    assert.ok(worst(new Uint8Array(model.texels.buffer), bytes(`sphere/${want.dense}`)) <= want.tolerance, want.dense);
  }
});

test('what has changed is told as it is held, adopted whole or in part', async () => {
  const colours = (count: number) => Uint8Array.from({ length: 4 * count }, (_, k) => mix32(k) % 256);
  for (const geometry of ['cylinder', 'sphere'] as const) {
    const { model, codecs } = await opened(colours, { ...INFO, geometry });
    for (const channel of [RANGE, TEXTURE] as const) {
      const whole: boolean[] = [];
      for (const further of [0, 1]) {
        const parameters = { halfSpacing: 2, blockX: 1 + further, blockY: (channel === RANGE ? 7 : 3) + further, blocksWide: 2, blocksHigh: 2, rhoX: 0, rhoY: 0, listed: null };
        const strips = selectStrips(buildStrips(model.shapes[channel], parameters), model.holdings.channels[channel], rankOf(channel, QUALITY));
        whole.push(strips.every(({ selection }) => !selection.adopted.includes(0)));
        const samples = samplesOf(strips);
        const values = littleEndian(Uint16Array.from({ length: samples }, (_, k) => 1 + (mix32(k) % 900)));
        const changed = await model.apply(
          refinement(channel === RANGE ? { channel, quality: QUALITY, samples, parameters, payload: values } : { channel, codec: JPEG, quality: QUALITY, samples, parameters, payload: SCANLESS }),
          codecs,
        );
        const held = channel === RANGE ? model.steps : model.texels;
        assert.ok(changed.length);
        for (const { x, y, width, height, cells } of changed) {
          const told = channel === RANGE ? cells : new Uint32Array(cells.slice().buffer);
          for (let row = 0; row < height; row++) {
            const from = (y + row) * INFO.width + x;
            assert.deepEqual([...told.subarray(row * width, (row + 1) * width)], [...held.subarray(from, from + width)], `${geometry} ${channel}`);
          }
        }
      }
      if (geometry === 'cylinder' && channel === TEXTURE) assert.deepEqual(whole, [true, false]);
    }
  }
});

test('parts of strips come apart, and bad ones are refused', () => {
  const parts = splitParts(fromHex('02000000' + '0102' + '00000000' + '01000000' + '03'), 3);
  assert.deepEqual(parts.map((part) => [...part]), [[1, 2], [], [3]]);
  assert.deepEqual(splitParts(fromHex('0102'), 1), [fromHex('0102')]);
  assert.deepEqual(splitParts(new Uint8Array(), 2), [new Uint8Array(), new Uint8Array()]);
  for (const hex of ['010000', '0200000001', '00000000', '00000000' + '00000000' + '01']) {
    assert.throws(() => splitParts(fromHex(hex), 2), RemoteWireError);
  }
});
