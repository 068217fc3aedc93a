// Everything that costs time, off the page's own thread: the stream, decoding, reconstruction, thumbnails.

import wasmPath from '@cornerstonejs/codec-openjph/wasm';
import type { FromWorker, ToWorker } from './link.ts';
import { decodeJpegNatively } from './jpeg_native.ts';
import { Codecs } from './protocol/codec.ts';
import { Htj2kDecoder } from './protocol/codec_htj2k.ts';
import type { Model } from './protocol/model.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { modelOf } from './recording.ts';
import { Stream } from './stream.ts';
import { tellAll } from './telling.ts';
import { drawThumbnail, THUMBNAIL_SIDE } from './thumbnail.ts';
import { strings } from './strings.ts';
import { FACING_RAD } from './facing.ts';

interface Scope {
  postMessage(message: FromWorker, transfer?: Transferable[]): void;
  onmessage: (event: MessageEvent<ToWorker>) => void;
  location: Location;
}
const scope = globalThis as unknown as Scope;

let htj2k: Promise<Htj2kDecoder>;
const codecs = new Codecs(() => htj2k, decodeJpegNatively);
/** In an offline copy, all that there is. */
let copied: Model | null = null;

let stream: Stream | null = null;
let origin = '';

// Small pictures wait until the large one can be drawn, or will not be.
let begin = (): void => undefined;
let pictures = new Promise<void>((resolve) => (begin = resolve));

function tell(said: FromWorker, transfer?: Transferable[]): void {
  scope.postMessage(said, transfer);
  if (said.kind === 'opened' || said.kind === 'refused' || (said.kind === 'link' && said.link.state === 'lost')) begin();
}

scope.onmessage = ({ data: said }) => {
  switch (said.kind) {
    case 'start':
      load(new URL(wasmPath, scope.location.href).href); // at once, so that it comes beside the first view
      origin = said.origin;
      stream = new Stream(`${origin.replace(/^http/, 'ws')}/v1/stream`, codecs, tell, explain);
      if (said.scan) stream.open(said.scan);
      stream.connect();
      break;
    case 'open':
      stream?.open(said.scan);
      break;
    case 'look':
      stream?.look(said.look, said.u, said.v, said.options);
      break;
    case 'cancel':
      stream?.cancel(said.look);
      break;
    case 'restore':
      stream?.restore();
      if (copied) restoreCopy(copied);
      break;
    case 'record':
      stream?.record();
      break;
    case 'replay':
      load(said.wasm);
      void replay(said.info, said.refinements);
      break;
    case 'retry':
      stream?.connect();
      break;
    case 'thumbnail':
      pictures = pictures.then(() => thumbnail(said.scan));
      break;
  }
};

function load(wasm: ArrayBuffer | string): void {
  htj2k = Htj2kDecoder.load(wasm);
  htj2k.catch(() => undefined); // whoever awaits it hears of it
}

/** Show what was recorded of a scan. */
async function replay(info: ScanInfo, refinements: Uint8Array): Promise<void> {
  try {
    copied = await modelOf(info, refinements, codecs);
    tellAll(copied, true, tell);
  } catch (error) {
    console.error(error);
    tell({ kind: 'broken' });
  }
}

function restoreCopy(model: Model): void {
  tellAll(model, false, tell);
  tell({ kind: 'restored' });
}

/** A browser does not say why a WebSocket failed; the node's other end does. */
async function explain(): Promise<string | null> {
  try {
    const answer = await fetch(`${origin}/v1/stream`, { cache: 'no-store' });
    if (answer.status === 503) return ((await answer.json()) as { message: string }).message;
    if (answer.status === 401) return null;
    if (answer.status === 403) return strings.link.needsToken;
    return strings.link.cut;
  } catch {
    return strings.link.unreachable;
  }
}

/** Tells the page a small picture of a scan; null where none can be had now. */
async function thumbnail(scan: string): Promise<void> {
  try {
    tell({ kind: 'thumbnail', scan, picture: await pictured(scan) });
  } catch (error) {
    console.warn(`no thumbnail of ${scan}`, error);
    tell({ kind: 'thumbnail', scan, picture: null });
  }
}

async function pictured(scan: string): Promise<Blob | null> {
  const [info, coarse] = await Promise.all([fetch(`${origin}/v1/scans/${scan}`), fetch(`${origin}/v1/scans/${scan}/coarse`)]);
  if (!info.ok || !coarse.ok) return null;
  const model = await modelOf((await info.json()) as ScanInfo, new Uint8Array(await coarse.arrayBuffer()), codecs);
  const canvas = new OffscreenCanvas(THUMBNAIL_SIDE, THUMBNAIL_SIDE);
  const pixels = drawThumbnail(model.info, model.coarseSteps, model.coarseTexels, FACING_RAD);
  canvas.getContext('2d', { willReadFrequently: true })!.putImageData(new ImageData(pixels, THUMBNAIL_SIDE), 0, 0);
  return canvas.convertToBlob();
}
