import { strings } from '../strings.ts';
import type { Pin } from '../url_state.ts';
import type { Place } from '../view/room.ts';
import type { Stage } from '../view/stage.ts';
import { h, refill } from './dom.ts';

const SVG = 'http://www.w3.org/2000/svg';

/** What lies over the picture: pins, and the line of a measurement. */
export class Marks {
  readonly element = h('div', { class: 'marks', 'aria-hidden': 'true' });
  private readonly svg = document.createElementNS(SVG, 'svg');
  private readonly line = document.createElementNS(SVG, 'line');
  private readonly ends = [h('span', { class: 'end' }), h('span', { class: 'end' })];
  private readonly result = h('output', { class: 'distance' });
  private readonly busy = h('span', { class: 'busy', hidden: true });
  private pins: { pin: Pin; element: HTMLElement }[] = [];
  private measured: Place[] = [];
  private looked: Place | null = null;

  constructor(private readonly stage: Stage) {
    this.svg.append(this.line);
    this.element.append(this.svg, ...this.ends, this.result, this.busy);
    this.update();
  }

  setPins(pins: Pin[]): void {
    for (const { element } of this.pins) element.remove();
    this.pins = pins.map((pin) => ({ pin, element: h('span', { class: 'pin' }, h('span', {}, pin.label)) }));
    this.element.append(...this.pins.map(({ element }) => element));
    this.update();
  }

  setMeasured(places: Place[], distanceMm: number | null): void {
    this.measured = places;
    this.result.dataset['places'] = places.map(({ u, v }) => `${u},${v}`).join(' ');
    refill(this.result, distanceMm === null ? null : strings.measure.result(distanceMm));
    this.update();
  }

  /** Where detail is coming. */
  setBusy(place: Place | null): void {
    this.looked = place;
    this.update();
  }

  /** Move along with the picture. */
  update(): void {
    for (const { pin, element } of this.pins) this.put(element, pin);
    this.put(this.busy, this.looked);
    const ends = this.ends.map((element, index) => this.put(element, this.measured[index] ?? null));
    const [a, b] = ends;
    this.line.style.display = a && b ? '' : 'none';
    this.result.hidden = !(a && b && this.result.textContent);
    if (!a || !b) return;
    for (const [name, value] of [['x1', a.x], ['y1', a.y], ['x2', b.x], ['y2', b.y]] as const) this.line.setAttribute(name, value.toFixed(1));
    this.result.style.transform = `translate(${(a.x + b.x) / 2}px, ${(a.y + b.y) / 2}px) translate(-50%, -140%)`;
  }

  private put(element: HTMLElement, place: Place | null): { x: number; y: number } | null {
    const at = place && this.stage.project(place);
    element.hidden = !at;
    if (!at) return null;
    element.style.transform = `translate(${at.x}px, ${at.y}px)`;
    element.classList.toggle('behind', at.hidden);
    return at;
  }
}
