// A view as one file: the page itself, and all that was received of the scan. It asks nobody for more.

import type { Channel } from './protocol/lattice.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { strings } from './strings.ts';
import type { Shading } from './view/surface.ts';

/** What a copy holds beside the refinements. view: as in an address. about: what people call the scan, '' if it stays unsaid. */
export interface Held {
  info: ScanInfo;
  view: string;
  shading: Shading;
  overlay: Channel | null;
  /** When the copy was made, ISO 8601. */
  made: string;
  /** When the scan was made, unix time [s]; null where that is not known. */
  swept: number | null;
  node: string;
  about: string;
}

/** Elements of a copy that hold data. */
export const HELD = 'held';
export const REFINEMENTS = 'refinements';
export const WASM = 'wasm';
export const WORKER = 'worker';

/** Make a copy and hand it to the browser's downloads. refinements: null where there were too many to be kept. */
export async function saveCopy(held: Held, refinements: Uint8Array | null, say: (text: string) => void): Promise<void> {
  if (!refinements) return say(strings.copy.tooMuch);
  try {
    const file = await fileOf(held, refinements);
    save(file, strings.copy.file(held));
    say(strings.copy.saved(file.size));
  } catch (error) {
    say(strings.failed((error as Error).message));
  }
}

/** The copy. Throws where a part of the page cannot be had again. */
async function fileOf(held: Held, refinements: Uint8Array): Promise<Blob> {
  const { script, scriptHash, style, styleHash, worker, wasm, notice } = document.body.dataset as Record<string, string>;
  const [scriptText, styleText, workerText, noticeText, wasmBytes] = await Promise.all([
    part(script!).then((answer) => answer.text()), part(style!).then((answer) => answer.text()),
    part(worker!).then((answer) => answer.text()), part(notice!).then((answer) => answer.text()),
    part(wasm!).then((answer) => answer.arrayBuffer()),
  ]);
  // Only what stands here may run, and nothing can be asked for or sent anywhere.
  const policy = `default-src 'none'; script-src '${scriptHash}' 'wasm-unsafe-eval'; style-src '${styleHash}'; worker-src blob:; `
    + "img-src data:; base-uri 'none'; form-action 'none'";
  const data = (id: string, text: string) => `<script type="text/plain" id="${id}">${text}</script>`;
  return new Blob([
    '<!doctype html><html lang="en"><head><meta charset="utf-8">', `<meta http-equiv="Content-Security-Policy" content="${policy}">`,
    '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">',
    '<meta name="robots" content="noindex"><title>foveascan</title><link rel="icon" href="data:,">', '<style>', styleText, '</style></head>',
    `<body><div id="app"><p class="late">${strings.copy.broken}</p></div>`, '<noscript>This page needs JavaScript.</noscript>',
    data(HELD, JSON.stringify(held).replaceAll('<', '\\u003c')), data(REFINEMENTS, await base64(refinements)),
    data(WASM, await base64(new Uint8Array(wasmBytes))), data(WORKER, workerText), data('licenses', noticeText),
    '<script type="module">', scriptText, '</script></body></html>\n',
  ], { type: 'text/html' });
}

function save(file: Blob, name: string): void {
  const link = document.createElement('a');
  const address = URL.createObjectURL(file);
  Object.assign(link, { href: address, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/** Inverse of what `fileOf` does with bytes. */
export const bytesOf = (text: string): Uint8Array<ArrayBuffer> => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

async function part(path: string): Promise<Response> {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${answer.status} ${path}`);
  return answer;
}

function base64(bytes: Uint8Array): Promise<string> {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.onload = () => resolve((reader.result as string).split(',')[1] ?? '');
    reader.onerror = () => reject(reader.error);
    reader.readAsDataURL(new Blob([bytes as Uint8Array<ArrayBuffer>]));
  });
}
