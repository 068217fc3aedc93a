import type { ScanSummary } from '../api.ts';
import { strings } from '../strings.ts';
import { h, refill, section } from './dom.ts';

export interface CompareActions {
  /** null: nothing beside any more. */
  choose(scan: string | null): void;
  together(on: boolean): void;
  sharpenBoth(on: boolean): void;
  align(): void;
}

/** Which scan stands beside the open one, and what they do together. */
export class ComparePanel {
  readonly element: HTMLDetailsElement;
  private readonly select: HTMLSelectElement;
  private readonly more: HTMLElement;

  constructor(actions: CompareActions) {
    const { compare } = strings;
    this.select = h('select', { id: 'beside', change: () => actions.choose(this.select.value || null) });
    const toggle = (text: string, change: (on: boolean) => void) => {
      const box = h('input', { type: 'checkbox', role: 'switch', checked: true, change: () => change(box.checked) });
      return h('label', {}, box, text);
    };
    this.more = h('div', { hidden: true }, toggle(compare.together, (on) => actions.together(on)),
      toggle(compare.both, (on) => actions.sharpenBoth(on)), h('p', { class: 'quiet' }, compare.how),
      h('button', { type: 'button', class: 'secondary', click: () => actions.align() }, compare.align));
    this.element = section(compare.heading, false, h('label', { for: 'beside' }, compare.beside), this.select, this.more);
    this.element.hidden = true;
  }

  /** open: the scan that is open, beside: the one beside it. Those of the open one's subject come first. */
  show(scans: ScanSummary[], open: string | null, beside: string | null): void {
    const { compare } = strings;
    const others = scans.filter(({ id }) => id !== open);
    this.element.hidden = open === null || others.length === 0;
    if (beside !== null && this.more.hidden) this.element.open = true;
    this.more.hidden = beside === null;
    const subject = scans.find(({ id }) => id === open)?.subject;
    const same = others.filter((scan) => subject && scan.subject === subject);
    const rest = others.filter((scan) => !same.includes(scan));
    const options = (some: ScanSummary[]) => some.map((scan) => h('option', { value: scan.id }, strings.scans.title(scan)));
    refill(this.select, h('option', { value: '' }, compare.none),
      same.length ? h('optgroup', { label: compare.same(subject!) }, ...options(same)) : null,
      ...(same.length && rest.length ? [h('optgroup', { label: compare.others }, ...options(rest))] : options(rest)));
    this.select.value = beside ?? '';
  }
}
