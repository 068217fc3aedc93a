import { strings } from '../strings.ts';
import { h } from './dom.ts';

/** Asks what an offline copy shall say, and says what it is. */
export class CopyDialog {
  readonly element: HTMLDialogElement;
  readonly button: HTMLButtonElement;

  /** named: whether the copy shall say whose scan it is. */
  constructor(make: (named: boolean) => void) {
    const { copy } = strings;
    const named = h('input', { type: 'checkbox' });
    const close = () => this.element.close();
    const yes = () => {
      close();
      make(named.checked);
    };
    this.element = h('dialog', { 'aria-labelledby': 'copy' }, h('article', {},
      h('h2', { id: 'copy' }, copy.heading), h('p', {}, copy.what), h('p', {}, copy.beware), h('label', {}, named, copy.named),
      h('footer', { class: 'row' }, h('button', { type: 'button', class: 'secondary', click: close }, copy.no),
        h('button', { type: 'button', click: yes }, copy.yes))));
    const ask = () => {
      named.checked = false; // whom one copy names, the next one does not
      this.element.showModal();
    };
    this.button = h('button', { type: 'button', class: 'secondary', click: ask }, copy.make);
  }
}
