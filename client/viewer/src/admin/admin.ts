// What who looks after the node sees of it. Fetched when it is first opened; the words come from the page.

import type { strings } from '../strings.ts';
import { h } from '../ui/dom.ts';
import { readUpkeep } from './answers.ts';
import { Log } from './log.ts';
import { Logins } from './logins.ts';
import { Keeping } from './keeping.ts';

export type Words = typeof strings;

const LOOK_MS = 5000;
const [LOOKING, ASKED] = ['looking', 'asked'];

export class Admin {
  private readonly element: HTMLDialogElement;
  private readonly keeping: Keeping;
  private readonly logins: Logins;
  private readonly log: Log;
  private readonly trouble = h('p', { class: 'trouble', role: 'alert', hidden: true });
  private failed = '';
  private looking: ReturnType<typeof setInterval> | undefined;

  constructor(private readonly words: Words) {
    const { admin } = words;
    const attempt = (work: () => Promise<void>) => this.attempt(work);
    this.keeping = new Keeping(words);
    this.logins = new Logins(words, attempt);
    this.log = new Log(words, attempt);
    const close = h('button', { type: 'button', class: 'secondary', click: () => this.element.close() }, admin.close);
    this.element = h('dialog', { id: 'admin', 'aria-labelledby': 'admin-title', close: () => clearInterval(this.looking) }, h('article', {},
      h('header', {}, h('h2', { id: 'admin-title' }, admin.heading), close),
      this.trouble, this.keeping.element, this.logins.element, this.log.element));
    document.getElementById('app')!.append(this.element); // whose buttons look as those of the page
  }

  /** Show everything as it is now, and health as it goes on. */
  open(): void {
    this.element.showModal();
    void this.attempt(() => this.look(), LOOKING);
    void this.attempt(() => this.logins.refresh());
    void this.attempt(() => this.log.refresh());
    this.looking = setInterval(() => void this.attempt(() => this.look(), LOOKING), LOOK_MS);
  }

  /** Who may not any more sees nothing of it any more. */
  close(): void {
    this.element.close();
  }

  private async look(): Promise<void> {
    this.keeping.show(await readUpkeep());
  }

  /** Do what may fail, and say how, until the same kind of work succeeds. */
  private async attempt(work: () => Promise<void>, kind = ASKED): Promise<void> {
    try {
      await work();
      if (this.failed === kind) this.trouble.hidden = true;
    } catch (error) {
      this.failed = kind;
      this.trouble.textContent = this.words.failed((error as Error).message);
      this.trouble.hidden = false;
    }
  }
}
