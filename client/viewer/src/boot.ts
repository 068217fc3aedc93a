// Runs before everything else, so that the stream is open by the time the rest of the page is compiled.

import type { FromWorker } from './link.ts';
import { parseState } from './url_state.ts';

const worker = new Worker(new URL(WORKER_FILE, import.meta.url), { type: 'module' });
const said: MessageEvent<FromWorker>[] = [];
worker.onmessage = (event: MessageEvent<FromWorker>) => said.push(event);
worker.postMessage({ kind: 'start', origin: location.origin, scan: parseState(location.hash.slice(1)).scan ?? 'latest' });
Object.assign(globalThis, { boot: { worker, said } });
