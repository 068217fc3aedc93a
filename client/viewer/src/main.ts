import { App } from './app.ts';
import type { FromWorker } from './link.ts';
import { strings } from './strings.ts';
import { h } from './ui/dom.ts';

const root = document.getElementById('app')!;
const { worker, said } = (globalThis as unknown as { boot: { worker: Worker; said: MessageEvent<FromWorker>[] } }).boot;
try {
  new App(root, worker);
  for (const event of said.splice(0)) worker.onmessage!(event);
} catch (error) {
  console.error(error);
  root.replaceChildren(h('main', { class: 'sorry' }, h('p', {}, strings.noWebgl)));
}
