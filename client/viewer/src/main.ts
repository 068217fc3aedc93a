import { App } from './app.ts';
import { strings } from './strings.ts';
import { h } from './ui/dom.ts';

const root = document.getElementById('app')!;
const worker = new Worker(new URL(WORKER_FILE, import.meta.url), { type: 'module' });
try {
  new App(root, worker);
} catch (error) {
  console.error(error);
  root.replaceChildren(h('main', { class: 'sorry' }, h('p', {}, strings.noWebgl)));
}
