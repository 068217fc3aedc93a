import { App } from './app.ts';
import type { Boot } from './link.ts';
import { isCopy, showCopy } from './offline.ts';
import { strings } from './strings.ts';
import { h } from './ui/dom.ts';
import { cardIsDone } from './view/compile.ts';
import { rendererOf } from './view/renderer.ts';

/**
 * Build the page from what was begun already, in two tasks: together they would keep its thread too long. Each asks the
 * graphics card something, which answers only when it has done what it was given before.
 */
export async function main({ worker, said, canvas, context, poster, hire }: Boot): Promise<void> {
  const root = document.getElementById('app')!;
  if (!context) {
    poster?.remove();
    root.replaceChildren(h('main', { class: 'sorry' }, h('p', {}, strings.noWebgl)));
    return;
  }
  await cardIsDone(context);
  const renderer = rendererOf(canvas, context);
  await cardIsDone(context);
  new App(root, worker, renderer, poster, hire);
  for (const event of said.splice(0)) worker.onmessage!(event);
}

if (isCopy()) showCopy(document.getElementById('app')!);
