// The dense model of a scan: filled by the first view, made finer by refinements, never coarser.
// Mirrors client/model.py and client/replica.py.

import { HoldingsDiffer, RemoteWireError } from './errors.ts';
import { Codecs } from './codec.ts';
import { ChannelHoldings, Holdings, rankOf } from './holdings.ts';
import { RANGE, TEXTURE } from './lattice.ts';
import type { Channel, ChannelShape } from './lattice.ts';
import { channelShapes } from './messages.ts';
import type { FromClient, ScanInfo, Statement } from './messages.ts';
import { polarPatch } from './polar.ts';
import type { PolarImage } from './polar.ts';
import {
  coarseToRange, contentHashes, denseOf, onlyFiner, paste, rangePatch, spans, texturePatch,
} from './reconstruct.ts';
import type { Chosen, Selection, Span } from './reconstruct.ts';
import { COARSE } from './refinement.ts';
import type { Refinement } from './refinement.ts';
import { buildStrips, imageOfPole, imageRows, samplesOf, selectStrips, splitParts } from './strips.ts';

const STATEMENTS_MAX = 3;

/** A rectangle of the dense model that has changed: steps of range, or RGBA of texture. */
export interface Changed extends Omit<Span, 'source'> {
  cells: Uint16Array | Uint8Array;
}

/**
 * Dense state of one scan, and our place in the node's refinements of it.
 * steps: range, 0 = void. texels: RGBA, alpha 0 where only the first view is known, which is `coarseTexels`.
 */
export class Model {
  readonly shapes: { [RANGE]: ChannelShape; [TEXTURE]: ChannelShape };
  holdings: Holdings;
  steps: Uint16Array = new Uint16Array();
  coarseSteps: Uint16Array = new Uint16Array();
  coarseTexels: Uint8Array = new Uint8Array();
  nextSeq = 0;
  private dense: Uint32Array | null = null;
  private readonly viewed = new Set<Channel>();
  private stated = false;
  private statements = 0;

  constructor(readonly info: ScanInfo, public epoch: number) {
    this.shapes = channelShapes(info);
    this.holdings = new Holdings(this.shapes);
  }

  /** The first view of both channels is in. */
  get complete(): boolean {
    return this.viewed.size === 2;
  }

  /** RGBA of the refined texture; its memory is taken when first needed. */
  get texels(): Uint32Array {
    this.dense ??= new Uint32Array(this.info.textureWidth * this.info.textureHeight);
    return this.dense;
  }

  /** Whether any texture has been refined. */
  get hasTexels(): boolean {
    return this.dense !== null;
  }

  /** Whether a refinement is the next one of this opening. Throws RemoteWireError for a void or repeated one. */
  isNext(refinement: Refinement): boolean {
    if (refinement.epoch !== this.epoch || refinement.seq < this.nextSeq) {
      throw new RemoteWireError(`refinement ${refinement.seq} when ${this.nextSeq} is next`);
    }
    return refinement.seq === this.nextSeq;
  }

  /** Take in one refinement. Throws HoldingsDiffer or RemoteWireError; the model is then unchanged. */
  async apply(refinement: Refinement, codecs: Codecs): Promise<Changed[]> {
    const changed = refinement.generator === COARSE
      ? await this.applyFirstView(refinement, codecs)
      : await this.applyFovea(refinement, codecs);
    this.nextSeq++;
    [this.stated, this.statements] = [false, 0];
    return changed;
  }

  /** What to say when everything sent so far is applied. */
  acknowledge(applyMs: number): FromClient {
    return { type: 'ack', epoch: this.epoch, nextSeq: this.nextSeq, digest: this.holdings.digest(), applyMs };
  }

  /** What to say to a refinement that does not fit; null when we said it and the node has not gone on yet. */
  object(): FromClient | null {
    return this.stated ? null : this.state();
  }

  /** What we hold. Throws RemoteWireError when saying so again and again brings no agreement. */
  state(): FromClient {
    if (this.statements === STATEMENTS_MAX) throw new RemoteWireError('no agreement on what we hold');
    this.stated = true;
    this.statements++;
    return { type: 'state', epoch: this.epoch, nextSeq: this.nextSeq, holdings: this.statement() };
  }

  /** Our holdings as they travel. From here on the digest counts anew, as it does at the node. */
  statement(): Statement {
    this.holdings.content = 0;
    return { range: this.holdings.channels[RANGE].toRuns(), texture: this.holdings.channels[TEXTURE].toRuns() };
  }

  /** Go on in a new opening of the same scan. */
  resume(epoch: number): void {
    this.epoch = epoch;
    this.nextSeq = 0;
    [this.stated, this.statements] = [false, 0];
  }

  private async applyFirstView(refinement: Refinement, codecs: Codecs): Promise<Changed[]> {
    const { channel, payload, codec, quality, samples } = refinement;
    const shape = this.shapes[channel];
    const [height, width] = [shape.coarseHeight, shape.coarseWidth];
    if (this.viewed.has(channel)) throw new RemoteWireError('a second first view');
    if (samples !== height * width) throw new RemoteWireError(`first view of ${samples} samples`);
    rankOf(channel, quality);
    if (channel === RANGE) {
      const coarse = await codecs.range(payload, codec, height, width, quality);
      await applyMask(coarse, refinement.mask, codecs, height, width);
      this.coarseSteps = coarse;
      this.steps = coarseToRange(coarse, shape);
    } else {
      if (refinement.mask.length) throw new RemoteWireError('texture has no voids of its own');
      this.coarseTexels = await codecs.texture(payload, codec, height, width, quality);
    }
    this.viewed.add(channel);
    return [];
  }

  private async applyFovea(refinement: Refinement, codecs: Codecs): Promise<Changed[]> {
    if (!this.complete) throw new RemoteWireError('a fovea before the first view');
    const { channel, quality } = refinement;
    const rank = rankOf(channel, quality);
    const { strips, pole } = this.selected(refinement, rank);
    const changed = channel === RANGE
      ? this.pasteRange(strips, await rangePatches(refinement, strips, codecs))
      : this.pasteTexture(strips, await texturePatches(refinement, strips, pole, codecs));
    for (const { selection, adopted } of strips) this.holdings.channels[channel].adopt(selection.lattice, adopted, rank);
    return changed;
  }

  private selected(refinement: Refinement, rank: number): { strips: Chosen[]; pole: PolarImage | null } {
    const { channel, parameters, samples, selfContained } = refinement;
    const held = this.holdings.channels[channel];
    const plannedOver = selfContained ? new ChannelHoldings(this.shapes[channel]) : held;
    const strips = selectStrips(buildStrips(this.shapes[channel], parameters!), plannedOver, rank);
    const pole = imageOfPole(this.shapes[channel], parameters!, strips);
    const expected = samplesOf(strips, pole);
    if (!strips.length || expected !== samples) throw new HoldingsDiffer(`${samples} samples, ${expected} expected`);
    return { strips: selfContained ? strips.map((strip) => onlyFiner(strip, held, rank)) : strips, pole };
  }

  private pasteRange(strips: Chosen[], patches: Uint16Array[]): Changed[] {
    return strips.flatMap(({ selection }, index) => {
      const rectangle = denseOf(patches[index]!, selection, 1);
      paste(this.steps, rectangle, selection);
      for (const [block, hash] of contentHashes(rectangle, selection)) this.holdings.addContent(block, hash);
      return this.cut(this.steps, selection, rectangle);
    });
  }

  private pasteTexture(strips: Chosen[], patches: Uint8Array[]): Changed[] {
    return strips.flatMap(({ selection }, index) => {
      const rectangle = denseOf(patches[index]!, selection, 4);
      paste(this.texels, new Uint32Array(rectangle.buffer, rectangle.byteOffset, rectangle.length / 4), selection);
      return this.cut(this.texels, selection, rectangle);
    });
  }

  /** What has changed; where all of a rectangle was adopted, that itself. */
  private cut(dense: Uint16Array | Uint32Array, selection: Selection, rectangle: Changed['cells']): Changed[] {
    const parts = spans(selection);
    if (parts.length === 1 && !selection.adopted.includes(0)) {
      const { x, y, width, height } = parts[0]!;
      return [{ x, y, width, height, cells: rectangle }];
    }
    return parts.map(({ x, y, width, height }) => {
      const cells = dense instanceof Uint16Array ? new Uint16Array(width * height) : new Uint32Array(width * height);
      const side = selection.lattice.shape.width;
      for (let row = 0; row < height; row++) {
        const from = (y + row) * side + x;
        cells.set(dense.subarray(from, from + width), row * width);
      }
      return { x, y, width, height, cells: cells instanceof Uint16Array ? cells : new Uint8Array(cells.buffer) };
    });
  }
}

/** What goes into each strip, voids included. */
async function rangePatches({ payload, mask, codec, quality }: Refinement, strips: Chosen[], codecs: Codecs): Promise<Uint16Array[]> {
  const masks = splitParts(mask, strips.length);
  const shapes = strips.map(({ selection: { x, y } }) => ({ height: y.sample.length, width: x.sample.length }));
  const images = await codecs.ranges(payload, codec, shapes, quality);
  return Promise.all(strips.map(async ({ selection }, index) => {
    const { x, y } = selection;
    const patch = rangePatch(selection, images[index]!);
    await applyMask(patch, masks[index]!, codecs, y.low.length, x.low.length);
    return patch;
  }));
}

/** The same of texture. */
async function texturePatches(
  { payload, mask, codec, quality }: Refinement, strips: Chosen[], pole: PolarImage | null, codecs: Codecs,
): Promise<Uint8Array[]> {
  if (mask.length) throw new RemoteWireError('texture has no voids of its own');
  if (pole) {
    const texels = await codecs.texture(payload, codec, pole.rows, pole.columns, quality);
    return strips.map(({ selection }) => polarPatch(pole, selection, texels));
  }
  const payloads = splitParts(payload, strips.length);
  return Promise.all(strips.map(async ({ selection }, index) => {
    const { x, y } = selection;
    const texels = await codecs.texture(payloads[index]!, codec, imageRows(selection, codec), x.sample.length, quality);
    return texturePatch(selection, texels.subarray(0, 4 * y.sample.length * x.sample.length));
  }));
}

async function applyMask(steps: Uint16Array, mask: Uint8Array, codecs: Codecs, height: number, width: number): Promise<void> {
  if (mask.length === 0) return;
  const voids = await codecs.mask(mask, height, width);
  for (let index = 0; index < voids.length; index++) if (voids[index]) steps[index] = 0;
}
