import type { Account } from '../api.ts';
import { strings } from '../strings.ts';
import { h, refill, section } from './dom.ts';

/** What the scan that is open is worth: how much was measured, how exactly, what to beware of. */
export class WorthPanel {
  readonly element = section(strings.worth.heading, false);
  private readonly content = this.element.lastElementChild!;

  constructor() {
    this.element.hidden = true;
  }

  /** null: the node does not say. */
  show(account: Account | null): void {
    this.element.hidden = account === null;
    if (!account) return;
    const { worth } = strings;
    const { quality, note } = account;
    const beware = quality?.complaints ?? [];
    this.element.classList.toggle('beware', beware.length > 0);
    refill(this.content, note ? h('p', {}, note) : null, ...(quality ? [
      beware.length ? h('ul', { class: 'complaints' }, ...beware.map((complaint) => h('li', {}, complaint))) : h('p', {}, worth.sound),
      h('dl', {}, ...worth.figures(quality).flatMap(([name, figure]) => [h('dt', {}, name), h('dd', {}, figure)])),
    ] : [h('p', { class: 'quiet' }, worth.unknown)]));
  }

  hide(): void {
    this.element.hidden = true;
  }
}
