// A look that nobody asked for, at a scan that is not there: once it was taken in a few times, the browser has compiled well
// what the first real one takes. Without it that, and the next few, take twice as long.

import { LIFT, RAW } from './protocol/codec.ts';
import type { Codecs } from './protocol/codec.ts';
import { RANGE } from './protocol/lattice.ts';
import type { Parameters } from './protocol/lattice.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { Model } from './protocol/model.ts';
import { FOVEA } from './protocol/refinement.ts';
import type { Refinement } from './protocol/refinement.ts';
import { buildStrips, samplesOf, selectStrips } from './protocol/strips.ts';

const SIDE = 512;
const COARSE_SIDE = 64;
/** As large as a look at an average scan. */
const WINDOW: Parameters = { halfSpacing: 2, blockX: 12, blockY: 16, blocksWide: 40, blocksHigh: 28, rhoX: 0, rhoY: 0, listed: null };
const LOOKS = 4;
/** A first view's texture is so much smaller than that of a look. */
const PICTURES_A_LOOK = 6;
const MISSES = 0b11_10_01_00; // four of two bits; the last stands for a byte of its own
const MISS_BYTE = 9;
const NOTHING = new Uint8Array();

/** texture: of the first view of a scan, as it came. isOver: whether somebody waits for a real look, and this shall end. */
export async function rehearse(info: ScanInfo, texture: Refinement, codecs: Codecs, isOver: () => boolean): Promise<void> {
  const { coarseTextureWidth: width, coarseTextureHeight: height } = info;
  const model = await modelOf(info, texture, codecs);
  const payload = await deflated(madeUp(model));
  for (let look = 0; look < LOOKS; look++) {
    for (let picture = 0; picture < PICTURES_A_LOOK; picture++) {
      if (isOver()) return;
      await codecs.texture(texture.payload, texture.codec, height, width, texture.quality);
      await aMoment();
    }
    if (isOver()) return;
    await model.apply({ ...fovea(model), quality: LOOKS - look, payload }, codecs); // each better than the last
    await aMoment();
  }
}

/** A square cylinder with the first view of another scan's texture. */
async function modelOf(info: ScanInfo, texture: Refinement, codecs: Codecs): Promise<Model> {
  const model = new Model({ ...info, geometry: 'cylinder', width: SIDE, height: SIDE, coarseWidth: COARSE_SIDE, coarseHeight: COARSE_SIDE }, 0);
  const steps = new Uint8Array(2 * COARSE_SIDE ** 2).fill(1);
  const range: Refinement = { ...texture, channel: RANGE, codec: RAW, quality: 1, samples: COARSE_SIDE ** 2, payload: steps };
  for (const view of [range, texture]) await model.apply(view, codecs);
  return model;
}

function fovea(model: Model): Refinement {
  const strips = selectStrips(buildStrips(model.shapes[RANGE], WINDOW), model.holdings.channels[RANGE], 65534);
  return {
    generator: FOVEA, channel: RANGE, epoch: 0, seq: 0, look: 0, codec: LIFT, quality: 1, samples: samplesOf(strips), selfContained: false,
    parameters: WINDOW, mask: NOTHING, payload: NOTHING,
  };
}

/** What a look at range carries: a miss for every sample. */
function madeUp(model: Model): Uint8Array<ArrayBuffer> {
  const fours = fovea(model).samples / 4;
  const packed = Math.ceil(fours);
  return new Uint8Array(packed + Math.floor(fours)).fill(MISSES, 0, packed).fill(MISS_BYTE, packed);
}

async function deflated(data: Uint8Array<ArrayBuffer>): Promise<Uint8Array> {
  const stream = new Blob([data]).stream().pipeThrough(new CompressionStream('deflate-raw'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const aMoment = (): Promise<void> => new Promise((resolve) => setTimeout(resolve, 0));
