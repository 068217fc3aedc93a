import { strings } from '../strings.ts';
import type { Pin } from '../url_state.ts';
import type { Place } from '../view/room.ts';
import { h, refill, section } from './dom.ts';

/** The pins of a scan as a list, and the label of a new one. */
export class PinsPanel {
  readonly element: HTMLDetailsElement;
  private readonly list = h('ol', { class: 'pins' });
  private readonly label = h('input', { type: 'text', maxlength: 200, required: true, 'aria-label': strings.pins.label, placeholder: strings.pins.label });
  private readonly form: HTMLFormElement;
  private readonly note = h('p', { class: 'quiet', hidden: true }, strings.pins.unsaved);
  private place: Place | null = null;
  private cameFrom: Element | null = null;
  private mayChange = true;

  constructor(
    private readonly add: (pin: Pin) => void, private readonly remove: (index: number) => void,
    private readonly go: (pin: Pin) => void,
  ) {
    const submit = (event: Event) => {
      event.preventDefault();
      if (this.place) this.add({ ...this.place, label: this.label.value.trim() });
      this.ask(null);
    };
    this.form = h('form', { hidden: true, submit }, this.label,
      h('div', { class: 'row' }, h('button', { type: 'submit' }, strings.pins.add),
        h('button', { type: 'button', class: 'secondary', click: () => this.ask(null) }, strings.pins.cancel)));
    this.element = section(strings.pins.heading, false, this.form, this.list, this.note);
  }

  /** Ask for the label of a pin at a place; null: of none. */
  ask(place: Place | null): void {
    const wasIn = this.form.contains(document.activeElement);
    this.place = place;
    if (place && !wasIn) this.cameFrom = document.activeElement;
    if (!place && wasIn) (this.cameFrom as HTMLElement | null)?.focus({ preventScroll: true }); // else who uses keys is nowhere
    this.form.hidden = place === null;
    this.label.value = '';
    if (!place) return;
    this.element.open = true;
    this.label.focus();
  }

  /** Whether who looks at the page may set and remove pins; before the next `show`. */
  allow(allowed: boolean): void {
    this.mayChange = allowed;
    if (!allowed) this.ask(null);
  }

  show(pins: Pin[], kept: boolean): void {
    this.note.hidden = kept || pins.length === 0;
    const items = pins.map((pin, index) => h('li', {},
      h('button', { type: 'button', class: 'plain', 'aria-label': strings.pins.go(pin.label), click: () => this.go(pin) }, pin.label || '·'),
      !this.mayChange ? null : h('button', { type: 'button', class: 'plain remove', 'aria-label': strings.pins.remove(pin.label), click: () => this.remove(index) }, '×'),
    ));
    refill(this.list, ...(items.length ? items : [h('li', { class: 'quiet none' }, this.mayChange ? strings.pins.none : strings.pins.noneYet)]));
  }
}
