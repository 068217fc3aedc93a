// Stands within the page, so that it runs before anything else is there, and sets going what takes long elsewhere: a
// picture of the scan, the worker with its stream, and the graphics context. A worker starts with the help of this thread,
// so the large rest of the page is not run before it has.

import { CONTEXT } from './link.ts';
import type { FromWorker } from './link.ts';
import { parseState } from './url_state.ts';

/** So long all else waits for the picture, at most. */
const PAINTED_MS = 100;

const { scan, camera } = parseState(location.hash.slice(1));

/** A worker with a stream of its own, that opens a scan. */
function hire(scan: string): Worker {
  const worker = new Worker(`assets/${WORKER_FILE}`); // a module would start later
  worker.postMessage({ kind: 'start', origin: location.origin, scan });
  return worker;
}

/** A picture of a scan from where the camera stands when nobody has moved it. */
function pictureOf(scan: string): HTMLImageElement {
  const picture = new Image();
  Object.assign(picture, { id: 'poster', alt: '', fetchPriority: 'high' });
  picture.setAttribute('elementtiming', 'poster');
  picture.src = `v1/scans/${scan}/picture`;
  return picture;
}

/** Once a picture is painted, or will not be soon. */
function painted(picture: HTMLImageElement): Promise<void> {
  return new Promise((resolve) => {
    setTimeout(resolve, PAINTED_MS);
    picture.decode().then(
      () => requestAnimationFrame(() => setTimeout(resolve)),
      () => resolve(picture.remove()), // there is no such scan
    );
  });
}

const poster = camera ? null : pictureOf(scan ?? 'latest');
const worker = hire(scan ?? 'latest');
const said: MessageEvent<FromWorker>[] = [];
const started = new Promise((resolve) => {
  worker.onmessage = (event: MessageEvent<FromWorker>) => resolve(said.push(event));
});
addEventListener('DOMContentLoaded', async () => {
  if (poster) {
    document.body.append(poster);
    await painted(poster);
  }
  const canvas = document.createElement('canvas');
  const context = canvas.getContext('webgl2', CONTEXT);
  await started;
  const { main } = (await import(new URL(`assets/${MAIN_FILE}`, location.href).href)) as typeof import('./main.ts');
  setTimeout(() => main({ worker, said, canvas, context, poster, hire }));
});
