import type { CutSweep } from '../api.ts';
import { strings } from '../strings.ts';
import { h, refill } from './dom.ts';

export interface CutSweepEvents {
  /** Go on with one. */
  resume(id: string): void;
  /** Delete one for good. */
  drop(id: string): void;
}

/** The sweeps that were cut: what is kept of each and why it ended, and what is to become of it. */
export class CutSweeps {
  readonly element: HTMLElement;
  private readonly list = h('ul', { class: 'cut' });
  private readonly sure: HTMLDialogElement;
  private readonly question = h('p', { id: 'cut-sure' });
  private shown = '';
  private sweeps: CutSweep[] = [];
  private going: HTMLButtonElement[] = [];
  private dropping = '';
  private allowed = false;
  private isReady = false;

  constructor(private readonly events: CutSweepEvents) {
    const words = strings.cut;
    const close = () => this.sure.close();
    const yes = () => {
      close();
      this.events.drop(this.dropping);
    };
    this.sure = h('dialog', { 'aria-labelledby': 'cut-sure' }, h('article', {}, this.question, h('footer', { class: 'row' },
      h('button', { type: 'button', class: 'secondary', click: close }, words.keep),
      h('button', { type: 'button', class: 'danger', click: yes }, words.drop))));
    this.element = h('div', { hidden: true }, h('p', { class: 'label', id: 'cut' }, words.heading), this.list, this.sure);
    this.list.setAttribute('aria-labelledby', 'cut');
  }

  /** sweeps: oldest first. */
  show(sweeps: CutSweep[]): void {
    this.sweeps = sweeps;
    this.fill();
  }

  /** Whether who looks at the page may change anything. */
  allow(allowed: boolean): void {
    this.allowed = allowed;
    this.fill();
  }

  /** Whether the scanner can sweep now. */
  ready(isReady: boolean): void {
    this.isReady = isReady;
    for (const button of this.going) button.disabled = !isReady;
  }

  private fill(): void {
    const shown = JSON.stringify([this.sweeps, this.allowed]);
    if (shown === this.shown) return; // what has the focus keeps it
    this.shown = shown;
    this.element.hidden = !this.sweeps.length;
    this.going = [];
    refill(this.list, ...[...this.sweeps].reverse().map((sweep) => this.item(sweep)));
  }

  private item({ id, ended, why, held, expected }: CutSweep): HTMLLIElement {
    const words = strings.cut;
    const what = words.kept(Math.floor((100 * held) / Math.max(expected, 1)), ended);
    const ask = () => {
      this.dropping = id;
      this.question.textContent = words.sure(what);
      this.sure.showModal();
    };
    const goOn = h('button', { type: 'button', class: 'secondary', 'aria-label': words.resumeOf(what), disabled: !this.isReady,
      click: () => this.events.resume(id) }, words.resume);
    this.going.push(goOn);
    const buttons = h('div', { class: 'row' }, goOn,
      h('button', { type: 'button', class: 'secondary', 'aria-label': words.dropOf(what), click: ask }, words.dropAsk));
    return h('li', {}, h('strong', {}, what), h('small', {}, why), this.allowed ? buttons : null);
  }
}
