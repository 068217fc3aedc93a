import { App } from './app.ts';
import type { Boot } from './link.ts';
import { isCopy, showCopy } from './offline.ts';
import { strings } from './strings.ts';
import { h } from './ui/dom.ts';

/** Build the page from what was begun already. */
export function main({ worker, said, canvas, context, poster, hire }: Boot): void {
  const root = document.getElementById('app')!;
  if (!context) {
    poster?.remove();
    root.replaceChildren(h('main', { class: 'sorry' }, h('p', {}, strings.noWebgl)));
    return;
  }
  new App(root, worker, canvas, context, poster, hire);
  for (const event of said.splice(0)) worker.onmessage!(event);
}

if (isCopy()) showCopy(document.getElementById('app')!);
