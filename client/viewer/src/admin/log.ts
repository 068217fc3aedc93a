import { h, refill } from '../ui/dom.ts';
import type { Words } from './admin.ts';
import { readAudit } from './answers.ts';
import type { Entry } from './answers.ts';

const [FEW, MANY] = [50, 1000];

/** The audit log, the newest first: who did what to which scan, or was turned away. */
export class Log {
  readonly element: HTMLElement;
  private readonly scan = h('input', { type: 'text', maxlength: 32, autocomplete: 'off', spellcheck: 'false' });
  private readonly by = h('input', { type: 'text', maxlength: 60, autocomplete: 'off' });
  private readonly since = h('input', { type: 'date' });
  private readonly refused = h('input', { type: 'checkbox' });
  private readonly list = h('ol', { class: 'log' });
  private readonly none = h('p', { class: 'quiet', role: 'status' });
  private readonly more: HTMLButtonElement;

  constructor(private readonly words: Words, private readonly attempt: (work: () => Promise<void>) => Promise<void>) {
    const { admin } = words;
    const submit = (event: Event) => {
      event.preventDefault();
      void this.attempt(() => this.refresh());
    };
    this.more = h('button', { type: 'button', class: 'secondary', hidden: true, click: () => void this.attempt(() => this.refresh(MANY)) },
      admin.older(MANY));
    const form = h('form', { submit, class: 'narrow' },
      h('label', {}, admin.ofScan, this.scan), h('label', {}, admin.byWhom, this.by), h('label', {}, admin.sinceDay, this.since),
      h('label', { class: 'check' }, this.refused, admin.refused), h('button', { type: 'submit', class: 'secondary' }, admin.show));
    this.element = h('section', { 'aria-labelledby': 'admin-log' }, h('h3', { id: 'admin-log' }, admin.log), form, this.none, this.list, this.more);
  }

  /** Ask for it anew. most: entries at most. */
  async refresh(most = FEW): Promise<void> {
    const [scan, by, since] = [this.scan, this.by, this.since].map((input) => input.value.trim()) as [string, string, string];
    const entries = await readAudit({ scan, by, since, refused: this.refused.checked, limit: most });
    const { admin } = this.words;
    this.none.textContent = entries.length ? admin.shown(entries.length) : admin.nothing;
    this.more.hidden = entries.length < most || most === MANY;
    refill(this.list, ...entries.map((entry) => this.row(entry)));
  }

  private row({ at, event, by, role, address, scan, sweep, what, left_out: missing }: Entry): HTMLElement {
    const { admin } = this.words;
    const of = (id: string) => h('button', { type: 'button', class: 'secondary', 'aria-label': admin.onlyScan(id), click: () => this.only(id) }, id.slice(0, 8));
    const more = [what, sweep && admin.sweep(sweep), address, missing && admin.missing(missing)].filter(Boolean).join(' · ');
    return h('li', {}, h('time', { datetime: at }, admin.moment(at)), h('span', {}, h('strong', {}, by), role ? ` (${role}) ` : ' ', event, ' ',
      scan ? of(scan) : null), more ? h('small', {}, more) : null);
  }

  private only(scan: string): void {
    this.scan.value = scan;
    void this.attempt(() => this.refresh());
  }
}
