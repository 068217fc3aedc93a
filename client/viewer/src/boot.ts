// Runs before everything else, and sets going what takes long elsewhere: the worker with its stream, and the graphics
// context. A worker starts with the help of this thread, so the large rest of the page is not run before it has.

import { CONTEXT } from './link.ts';
import type { FromWorker } from './link.ts';
import { parseState } from './url_state.ts';

/** A worker with a stream of its own, that opens a scan. */
function hire(scan: string): Worker {
  const worker = new Worker(new URL(WORKER_FILE, import.meta.url)); // a module would start later
  worker.postMessage({ kind: 'start', origin: location.origin, scan });
  return worker;
}

const worker = hire(parseState(location.hash.slice(1)).scan ?? 'latest');
const said: MessageEvent<FromWorker>[] = [];
const started = new Promise((resolve) => {
  worker.onmessage = (event: MessageEvent<FromWorker>) => resolve(said.push(event));
});
const canvas = document.createElement('canvas');
const context = canvas.getContext('webgl2', CONTEXT);
await started;
const { main } = (await import(new URL(MAIN_FILE, import.meta.url).href)) as typeof import('./main.ts');
setTimeout(() => main({ worker, said, canvas, context, hire }));
