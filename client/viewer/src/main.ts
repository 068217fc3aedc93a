import { App } from './app.ts';
import type { Boot } from './link.ts';
import { isCopy, showCopy } from './offline.ts';
import { strings } from './strings.ts';
import { h } from './ui/dom.ts';
import { rendererOf } from './view/renderer.ts';

/** Build the page from what was begun already, in two tasks: together they would keep the page's thread too long. */
export async function main({ worker, said, canvas, context, poster, hire }: Boot): Promise<void> {
  const root = document.getElementById('app')!;
  if (!context) {
    poster?.remove();
    root.replaceChildren(h('main', { class: 'sorry' }, h('p', {}, strings.noWebgl)));
    return;
  }
  const renderer = rendererOf(canvas, context);
  await new Promise((resolve) => setTimeout(resolve));
  new App(root, worker, renderer, poster, hire);
  for (const event of said.splice(0)) worker.onmessage!(event);
}

if (isCopy()) showCopy(document.getElementById('app')!);
