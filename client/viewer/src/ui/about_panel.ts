import { downloadPath } from '../api.ts';
import type { Changes, Sidecar } from '../api.ts';
import type { ScanInfo } from '../protocol/messages.ts';
import { strings } from '../strings.ts';
import { CopyDialog } from './copy_dialog.ts';
import { h, refill, section } from './dom.ts';

const FIELDS = ['name', 'subject', 'body_site'] as const;

/** The scan that is open: its name and place, downloads, deletion. */
export class AboutPanel {
  readonly element: HTMLElement;
  private readonly samples = h('p', { class: 'quiet' });
  private readonly downloads = h('ul', { class: 'downloads' });
  private readonly inputs: Record<(typeof FIELDS)[number], HTMLInputElement>;
  /** What the form was filled with last, and of which scan. */
  private filled: Record<(typeof FIELDS)[number], string> = { name: '', subject: '', body_site: '' };
  private scan = '';
  private readonly form: HTMLFormElement;
  private readonly dialog: HTMLDialogElement;
  private readonly sure = h('p', { id: 'sure' });
  private readonly remove: HTMLButtonElement;
  private readonly mayNot = h('p', { class: 'quiet', hidden: true }, strings.role);
  private readonly copied = h('p', { class: 'quiet', role: 'status' });

  /** title: what to call a scan. remove: that scan, whatever is open by then. */
  constructor(
    save: (changes: Changes) => void, title: (scan: string) => string, remove: (scan: string) => void, makeCopy: (named: boolean) => void,
  ) {
    const { about } = strings;
    this.inputs = { name: text(200), subject: text(64), body_site: text(100) };
    const submit = (event: Event) => {
      event.preventDefault();
      for (const field of FIELDS) this.inputs[field].value = this.inputs[field].value.trim();
      const { name, subject, body_site } = this.inputs;
      save({ name: name.value, subject: subject.value, body_site: body_site.value });
    };
    this.form = h('form', { submit },
      h('label', {}, about.name, this.inputs.name), h('label', {}, about.subject, this.inputs.subject),
      h('label', {}, about.site, this.inputs.body_site), h('button', { type: 'submit', class: 'secondary' }, about.save));
    const close = () => this.dialog.close();
    const yes = () => {
      close();
      remove(this.scan);
    };
    this.dialog = h('dialog', { 'aria-labelledby': 'sure' }, h('article', {}, this.sure,
      h('footer', { class: 'row' }, h('button', { type: 'button', class: 'secondary', click: close }, about.no),
        h('button', { type: 'button', class: 'danger', click: yes }, about.yes))));
    const ask = () => {
      this.sure.textContent = about.sure(title(this.scan));
      this.dialog.showModal();
    };
    this.remove = h('button', { type: 'button', class: 'secondary', click: ask }, about.remove);
    const copy = h('button', { type: 'button', class: 'secondary', click: () => void this.copy() }, about.copy);
    const offline = new CopyDialog(makeCopy);
    this.element = section(about.heading, false, this.samples, this.form, this.mayNot,
      h('p', { class: 'label' }, about.download), this.downloads, offline.button, copy, this.copied, this.remove, this.dialog, offline.element);
    this.element.hidden = true;
  }

  show(info: ScanInfo): void {
    this.element.hidden = false;
    if (info.id !== this.scan) {
      this.dialog.close(); // it asked about the one before, as where somebody goes back meanwhile
      this.fill({ name: '', subject: '', body_site: '' }, true);
    }
    this.scan = info.id;
    this.samples.textContent = strings.about.samples(info.width, info.height, info.textureWidth, info.textureHeight);
    refill(this.downloads, ...Object.entries(strings.about.formats).map(([format, name]) =>
      h('li', {}, h('a', { href: downloadPath(info.id, format), download: '' }, name))));
    this.copied.textContent = '';
  }

  hide(): void {
    this.dialog.close();
    this.element.hidden = true;
  }

  /** What is said of it; null where this node keeps no such thing. */
  said(sidecar: Sidecar | null, mayChange: boolean): void {
    this.form.hidden = this.remove.hidden = !sidecar || !mayChange;
    this.mayNot.hidden = mayChange;
    if (!sidecar) return;
    this.fill({ name: sidecar.name ?? '', subject: sidecar.subject, body_site: sidecar.body_site }, false);
  }

  /** What somebody has typed and not saved stays, unless it was of another scan. */
  private fill(said: Record<(typeof FIELDS)[number], string>, anew: boolean): void {
    for (const field of FIELDS) {
      if (anew || this.inputs[field].value === this.filled[field]) this.inputs[field].value = said[field];
    }
    this.filled = said;
  }

  private async copy(): Promise<void> {
    try {
      await navigator.clipboard.writeText(location.href);
      this.copied.textContent = strings.about.copied;
    } catch {
      this.copied.textContent = strings.about.address; // no clipboard over plain HTTP
    }
  }
}

const text = (most: number): HTMLInputElement => h('input', { type: 'text', maxlength: most, autocomplete: 'off' });
