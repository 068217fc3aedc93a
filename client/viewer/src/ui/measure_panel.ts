import type { Measured } from '../measuring.ts';
import { strings } from '../strings.ts';
import { h, refill, section } from './dom.ts';

/** What was measured, and what to do with its points. */
export class MeasurePanel {
  readonly element: HTMLDetailsElement;
  private readonly figures = h('dl', {});
  private readonly advice = h('p', { class: 'quiet' });
  private readonly buttons: HTMLButtonElement[];

  constructor(undo: () => void, anew: () => void) {
    const { measure } = strings;
    this.buttons = [[measure.undo, undo] as const, [measure.anew, anew] as const].map(([text, click]) =>
      h('button', { type: 'button', class: 'secondary', click }, text));
    this.element = section(measure.heading, true, this.figures, this.advice, h('div', { class: 'row' }, ...this.buttons));
    this.element.hidden = true;
  }

  /** isAsked: a click adds a point. Else what was measured stays to be read. */
  show(measured: Measured, isAsked: boolean): void {
    this.element.hidden = !isAsked && measured.count === 0;
    const { measure } = strings;
    refill(this.figures, ...measure.figures(measured).flatMap(([name, figure]) => [h('dt', {}, name), h('dd', {}, figure)]));
    this.advice.textContent = measure.advice(measured, isAsked);
    for (const button of this.buttons) button.disabled = measured.count === 0;
  }
}
