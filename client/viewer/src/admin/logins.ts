import { Refused } from '../api.ts';
import { h, refill } from '../ui/dom.ts';
import type { Options } from '../ui/dom.ts';
import type { Words } from './admin.ts';
import { listLogins, listWaiting, offerCode, revoke } from './answers.ts';
import type { Offered } from './answers.ts';

const NO_LOGINS = 409;
const COUNT_MS = 1000;
const ROLES = ['view', 'operate', 'admin', 'monitor'] as const;

/** Who is paired, with the way out; a code for one more. */
export class Logins {
  readonly element: HTMLElement;
  private readonly list = h('ul', { class: 'logins' });
  private readonly none = h('p', { class: 'quiet', hidden: true });
  private readonly form: HTMLFormElement;
  private readonly name: HTMLInputElement;
  private readonly code = h('div', { class: 'code', role: 'status' });
  private readonly sure: HTMLDialogElement;
  private readonly question = h('p', { id: 'admin-sure' });
  private readonly role: HTMLSelectElement;
  private readonly minutes: HTMLSelectElement;
  private leaving = { name: '', own: false };
  private counting: ReturnType<typeof setInterval> | undefined;

  constructor(private readonly words: Words, private readonly attempt: (work: () => Promise<void>) => Promise<void>) {
    const { admin } = words;
    this.name = h('input', { type: 'text', required: true, maxlength: 60, autocomplete: 'off' });
    this.role = choice(ROLES.map((role) => [role, admin.roles[role]]));
    this.minutes = choice(admin.lengths);
    const submit = (event: Event) => {
      event.preventDefault();
      void this.attempt(() => this.offer());
    };
    this.form = h('form', { submit },
      h('label', {}, admin.who, this.name),
      h('label', {}, admin.role, this.role), h('label', {}, admin.minutes, this.minutes),
      h('button', { type: 'submit', class: 'secondary' }, admin.offer));
    const close = () => this.sure.close();
    const yes = () => {
      close();
      void this.attempt(() => this.revoke());
    };
    this.sure = h('dialog', { 'aria-labelledby': 'admin-sure' }, h('article', {}, this.question, h('footer', { class: 'row' },
      h('button', { type: 'button', class: 'secondary', click: close }, admin.keep),
      h('button', { type: 'button', class: 'danger', click: yes }, admin.revoke))));
    this.element = h('section', { 'aria-labelledby': 'admin-logins' }, h('h3', { id: 'admin-logins' }, admin.logins), this.none, this.list,
      h('h4', {}, admin.pair), this.form, this.code, this.sure);
  }

  /** Ask anew who is paired and for whom a code waits. */
  async refresh(): Promise<void> {
    const { admin } = this.words;
    try {
      const [logins, waiting] = await Promise.all([listLogins(), listWaiting()]);
      this.none.hidden = logins.length > 0;
      this.none.textContent = admin.nobody;
      refill(this.list,
        ...logins.map(({ name, role, created, lastUsed, own }) => this.row(name, admin.login(role, created, lastUsed, own), own)),
        ...waiting.map(({ name, role, expires }) => this.row(name, admin.waits(role, expires))));
    } catch (error) {
      if (!(error instanceof Refused && error.status === NO_LOGINS)) throw error;
      this.none.hidden = false;
      this.none.textContent = error.message;
      this.form.hidden = this.form.previousElementSibling!.toggleAttribute('hidden', true);
    }
  }

  private row(name: string, what: string, own = false): HTMLElement {
    const { admin } = this.words;
    const ask = () => {
      this.leaving = { name, own };
      this.question.textContent = own ? admin.sureOfOwn(name) : admin.sure(name);
      this.sure.showModal();
    };
    return h('li', {}, h('span', {}, h('strong', {}, name), h('small', {}, what)),
      h('button', { type: 'button', class: 'secondary', 'aria-label': admin.revokeOf(name), click: ask }, admin.revokeAsk));
  }

  private async revoke(): Promise<void> {
    const { name, own } = this.leaving;
    await revoke(name);
    if (own) location.replace('/pair');
    else await this.refresh();
  }

  private async offer(): Promise<void> {
    const name = this.name.value.trim();
    const offered = await offerCode(name, this.role.value, Number(this.minutes.value));
    this.name.value = '';
    this.show(name, offered);
    await this.refresh();
  }

  /** The code, said once, with what is left of its time. */
  private show(name: string, { code, fingerprint, expires }: Offered): void {
    const { admin } = this.words;
    const left = h('p', { class: 'quiet', 'aria-live': 'off' });
    refill(this.code, h('p', {}, admin.codeFor(name)), h('p', {}, h('code', {}, code)), left,
      h('p', {}, admin.compare), h('p', {}, h('code', { class: 'fingerprint' }, admin.pairs(fingerprint))));
    clearInterval(this.counting);
    const count = () => {
      const seconds = Math.ceil(expires - Date.now() / 1000);
      left.textContent = admin.left(Math.max(seconds, 0));
      if (seconds > 0) return;
      clearInterval(this.counting);
      this.code.replaceChildren();
      void this.attempt(() => this.refresh());
    };
    this.counting = setInterval(count, COUNT_MS);
    count();
  }
}

/** The first is chosen. It stands in its label, since names for labels are counted by the page, which is another script. */
const choice = (options: Options): HTMLSelectElement =>
  h('select', {}, ...options.map(([value, text]) => h('option', { value }, text)));
