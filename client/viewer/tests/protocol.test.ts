import assert from 'node:assert/strict';
import { test } from 'node:test';
import { crc32 } from '../src/protocol/crc32.ts';
import { RemoteWireError } from '../src/protocol/errors.ts';
import { ChannelHoldings, hashBlock, Holdings, littleEndian, mix32, rankOf } from '../src/protocol/holdings.ts';
import { buildLattice, coarseLevel, levelOfGap, RANGE, skirtSteps, TEXTURE } from '../src/protocol/lattice.ts';
import type { ChannelShape } from '../src/protocol/lattice.ts';
import { isLive, parseLive } from '../src/protocol/live.ts';
import { parseMessage } from '../src/protocol/messages.ts';
import {
  coarseToRange, forEachAdopted, paste, rangePatch, select, spans, texturePatch,
} from '../src/protocol/reconstruct.ts';
import type { Selection } from '../src/protocol/reconstruct.ts';
import { parseRefinement } from '../src/protocol/refinement.ts';
import { bytes, fromHex, json, rgba, shapeOf, words, worst } from './golden.ts';

const hexCrc = (data: Uint8Array) => crc32(data).toString(16).padStart(8, '0');

test('lattices stand where Python puts them', () => {
  const golden = json('protocol/lattice.json');
  for (const [gap, level] of golden.levels) assert.equal(levelOfGap(gap), level);
  for (const s of golden.skirts) assert.deepEqual(skirtSteps(s.halfSpacing, s.rho, s.coarseSpacing, s.reach), s.steps);
  for (const want of golden.lattices) {
    const shape = shapeOf(want.shape);
    const got = buildLattice(shape, want.parameters);
    assert.equal(coarseLevel(shape), want.coarseLevel);
    assert.deepEqual(got.x, want.x);
    assert.deepEqual(got.y, want.y);
    assert.deepEqual([...got.level], want.level);
    assert.deepEqual([...got.listed], want.listed);
  }
});

test('parameters out of bounds are refused', () => {
  const golden = json('protocol/lattice.json');
  for (const p of golden.refused) assert.throws(() => buildLattice(shapeOf(golden.refusedShape), p), RemoteWireError);
});

function assertSelected(selection: Selection, want: any, shape: ChannelShape): void {
  assert.deepEqual(selection.y.sample, want.ySample);
  assert.deepEqual(selection.x.sample, want.xSample);
  assert.deepEqual([selection.y.start, selection.x.start], [want.yStart, want.xStart]);
  assert.deepEqual([selection.y.low.length, selection.x.low.length], [want.height, want.width]);
  const adopted: number[] = [];
  forEachAdopted(selection, ({ block }) => adopted.push(block));
  assert.deepEqual(adopted, want.adopted);
  assert.equal(spans(selection).reduce((sum, span) => sum + span.width, 0), want.width);
  assert.ok(spans(selection).every((span) => span.x + span.width <= shape.width));
}

test('range refinements, holdings and digests agree', () => {
  for (const series of json('protocol/range.json')) {
    const shape = shapeOf(series.shape);
    const holdings = new Holdings({ [RANGE]: shape, [TEXTURE]: shapeOf(series.textureShape) });
    const held = holdings.channels[RANGE];
    const dense = new Uint16Array(shape.width * shape.height).fill(series.denseBefore);
    assert.equal(holdings.digest(), series.digestBefore);
    for (const step of series.steps) {
      assert.equal(rankOf(RANGE, step.quantum), step.rank);
      const lattice = buildLattice(shape, step.parameters);
      const chosen = select(lattice, held, step.rank);
      if (!step.rows) {
        assert.equal(chosen, null);
        continue;
      }
      const { selection, adopted } = chosen!;
      assertSelected(selection, step, shape);
      const samples = scanSamples(selection, shape, step.quantum);
      if (step.values) assert.deepEqual([...samples.coded], step.values);
      const patch = rangePatch(selection, samples.decoded);
      assert.equal(hexCrc(littleEndian(patch)), step.patchCrc);
      paste(dense, patch, selection);
      held.adopt(lattice, adopted, step.rank);
      const hashes: number[] = [];
      forEachAdopted(selection, ({ row, column, height, wide, block }) => {
        hashes.push(hashBlock(patch, row * selection.x.low.length + column, selection.x.low.length, wide, height));
        holdings.addContent(block, hashes.at(-1)!);
      });
      assert.deepEqual(hashes, step.hashes);
      assert.equal(hexCrc(littleEndian(dense)), step.denseCrc);
      assert.deepEqual(held.toRuns(), step.runs);
      assert.equal(holdings.content, step.content);
      assert.equal(holdings.digest(), step.digest);
    }
    assert.deepEqual(dense, words(`protocol/${series.denseAfter}`));
  }
});

/** The made-up scan of the golden vectors, where a selection looks. */
function scanSamples(selection: Selection, shape: ChannelShape, quantum: number) {
  const [{ x, y }, border] = [selection, selection.lattice];
  const coded = new Uint16Array(x.sample.length * y.sample.length);
  let at = 0;
  for (const sampleY of y.sample) {
    for (const sampleX of x.sample) {
      const row = border.y.border[sampleY]! / 2;
      const column = (((border.x.border[sampleX]! / 2) % shape.width) + shape.width) % shape.width;
      const z = 1 + (mix32(row * shape.width + column) % 65535);
      coded[at++] = Math.floor((z + (quantum >> 1)) / quantum);
    }
  }
  return { coded, decoded: coded.map((k) => Math.min(Math.max(k * quantum, 1), 65535)) };
}

test('texture patches agree within the tolerance', () => {
  for (const want of json('protocol/texture.json')) {
    const shape = shapeOf(want.shape);
    const { selection } = select(buildLattice(shape, want.parameters), new ChannelHoldings(shape), rankOf(TEXTURE, want.quality))!;
    assertSelected(selection, want, shape);
    const size = want.rows * want.columns * 3;
    const patch = texturePatch(selection, rgba(Uint8Array.from({ length: size }, (_, k) => mix32(k) % 256)));
    const shown = new Uint32Array(selection.y.low.length * selection.x.low.length);
    const all = new Uint32Array(patch.buffer);
    forEachAdopted(selection, ({ row, column, height, wide }) => {
      for (let r = row; r < row + height; r++) {
        const from = r * selection.x.low.length + column;
        shown.set(all.subarray(from, from + wide), from);
      }
    });
    assert.ok(worst(new Uint8Array(shown.buffer), bytes(`protocol/${want.patch}`)) <= want.tolerance, want.patch);
  }
});

test('first views of range are exact', () => {
  for (const want of json('protocol/first_view.json').range) {
    assert.deepEqual(coarseToRange(Uint16Array.from(want.coarse), shapeOf(want.shape)), words(`protocol/${want.dense}`));
  }
});

test('holdings: hashes, adoption, runs', () => {
  const golden = json('protocol/holdings.json');
  for (const [value, mixed] of golden.mix32) assert.equal(mix32(value), mixed);
  const cells = Uint16Array.from(golden.hashes.cells);
  assert.deepEqual([0, 64].map((start) => hashBlock(cells, start, 8, 8, 8)), golden.hashes.hash);
  const shape = shapeOf(golden.shape);
  assert.deepEqual(new ChannelHoldings(shape).toRuns(), golden.coarseRuns);
  assert.deepEqual(ChannelHoldings.fromRuns(shape, golden.accepted).toRuns(), golden.accepted);
  for (const runs of golden.refused) assert.throws(() => ChannelHoldings.fromRuns(shape, runs), RemoteWireError);
  const halfSpacing: Record<number, number> = { 0: 2, 2: 4, 4: 8 };
  for (const [name, heldLevel, heldRank, level, rank, adopts] of golden.adoption) {
    const channel = name === 'range' ? RANGE : TEXTURE;
    const held = new ChannelHoldings({ channel, width: 64, height: 64, coarseWidth: 16, coarseHeight: 16 });
    held.level.fill(heldLevel);
    held.rank.fill(heldRank);
    const plateau = { blockX: 1, blockY: 1, blocksWide: 1, blocksHigh: 1, rhoX: 0, rhoY: 0, listed: null };
    const lattice = buildLattice(held.shape, { halfSpacing: halfSpacing[level]!, ...plateau });
    const index = lattice.y.block.indexOf(1) * lattice.x.block.length + lattice.x.block.indexOf(1);
    assert.equal(held.adoptable(lattice, rank)[index], adopts);
  }
});

test('refinements are read and bad ones refused', () => {
  const golden = json('protocol/refinement.json');
  for (const { hex, mask, payload, channel, ...fields } of golden.whole) {
    const got = parseRefinement(fromHex(hex));
    assert.deepEqual({ ...got, mask: undefined, payload: undefined, channel: undefined }, {
      ...fields, mask: undefined, payload: undefined, channel: undefined,
    });
    assert.deepEqual([got.channel, got.mask, got.payload], [channel, fromHex(mask), fromHex(payload)]);
  }
  for (const hex of golden.refused) assert.throws(() => parseRefinement(fromHex(hex)), RemoteWireError);
});

test('what a node says is understood, what it never says is refused', () => {
  const golden = json('protocol/messages.json');
  const ours = ['hello', 'open', 'look', 'ack', 'state', 'cancel', 'watch'];
  for (const message of golden.accepted) {
    if (ours.includes(message.type)) assert.throws(() => parseMessage(JSON.stringify(message)), RemoteWireError);
    else assert.deepEqual(parseMessage(JSON.stringify(message)), message);
  }
  for (const text of golden.refused) assert.throws(() => parseMessage(text), RemoteWireError);
});

test('live columns are read and cut ones refused', () => {
  const data = fromHex('464c0100070000000200030005000900' + '010002000300' + '040005000600');
  assert.ok(isLive(data));
  const got = parseLive(data);
  assert.deepEqual([got.channel, got.sweep, got.columns, got.rows, got.samples.length], [RANGE, 7, [5, 9], 3, 12]);
  for (let cut = 0; cut < data.length; cut++) assert.throws(() => parseLive(data.subarray(0, cut)), RemoteWireError);
});
