import type { Pin } from '../url_state.ts';
import type { Path } from '../view/path.ts';
import type { Place } from '../view/room.ts';
import type { Sight } from '../view/sight.ts';
import { h, refill } from './dom.ts';

/** From a point to what is written over it. */
const OVER_PX = 12;
/** What takes no longer than that needs no sign that it is coming. */
const AT_ONCE_MS = 200;
const SVG = 'http://www.w3.org/2000/svg';

/** What lies over the picture: pins, and the line of a measurement. */
export class Marks {
  readonly element = h('div', { class: 'marks', 'aria-hidden': 'true' });
  private readonly svg = document.createElementNS(SVG, 'svg');
  private readonly line = document.createElementNS(SVG, 'line');
  /** Of a path along the surface, what faces us and what is turned away. */
  private readonly ways = [document.createElementNS(SVG, 'path'), document.createElementNS(SVG, 'path')] as const;
  private readonly result = h('output', { class: 'distance' });
  private readonly busy = h('span', { class: 'busy', hidden: true });
  private ends: { place: Place; element: HTMLElement }[] = [];
  private legs: Path[] = [];
  private isStraight = false;
  private pins: { pin: Pin; element: HTMLElement }[] = [];
  /** Where detail is coming, and where that is shown. */
  private awaited: Place | null = null;
  private looked: Place | null = null;
  private patience: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly sight: Sight) {
    this.ways[1].classList.add('away');
    this.svg.append(...this.ways, this.line);
    this.element.append(this.svg, this.result, this.busy);
    this.update();
  }

  setPins(pins: Pin[]): void {
    for (const { element } of this.pins) element.remove();
    this.pins = pins.map((pin) => ({ pin, element: h('span', { class: 'pin' }, h('span', {}, pin.label)) }));
    this.element.append(...this.pins.map(({ element }) => element));
    this.update();
  }

  /** The points of a measurement, the ways between them, and what to write beside: straight across, along the surface. */
  setMeasured(places: Place[], legs: Path[], straight: string | null, along: string | null): void {
    for (const { element } of this.ends) element.remove();
    this.ends = places.map((place) => ({ place, element: h('span', { class: 'end' }) }));
    this.element.append(...this.ends.map(({ element }) => element));
    [this.legs, this.isStraight] = [legs, straight !== null];
    this.result.dataset['places'] = places.map(({ u, v }) => `${u},${v}`).join(' ');
    refill(this.result, straight && h('strong', {}, straight), along && h('span', {}, along));
    this.update();
  }

  /**
   * Where detail is coming, unless it comes at once: to show that and take it away again, the browser would put the page
   * together twice, and where a processor draws, each time takes as long as drawing the detail.
   */
  setBusy(place: Place | null): void {
    this.awaited = place;
    if (!place) {
      clearTimeout(this.patience);
      this.patience = undefined;
    }
    if (!place || this.looked) {
      this.looked = place;
      this.update();
    } else {
      this.patience ??= setTimeout(() => {
        [this.patience, this.looked] = [undefined, this.awaited];
        this.update();
      }, AT_ONCE_MS);
    }
  }

  /** Move along with the picture. */
  update(): void {
    for (const { pin, element } of this.pins) this.turn(element, this.put(element, pin));
    this.put(this.busy, this.looked);
    const ends = this.ends.map(({ place, element }) => this.put(element, place));
    this.drawWays();
    const [a, b] = this.isStraight ? ends : [ends.at(-1), ends.at(-1)];
    this.line.style.display = this.isStraight && a && b ? '' : 'none';
    this.result.hidden = !(a && b && this.legs.length);
    if (!a || !b) return;
    for (const [name, value] of [['x1', a.x], ['y1', a.y], ['x2', b.x], ['y2', b.y]] as const) this.line.setAttribute(name, value.toFixed(1));
    const { x, y } = this.inside((a.x + b.x) / 2, Math.min(a.y, b.y));
    this.result.style.transform = `translate(${x}px, ${y}px)`;
  }

  /** Where the result stands so that it is over a point, but nowhere cut. */
  private inside(x: number, y: number): { x: number; y: number } {
    const { offsetWidth: width, offsetHeight: height } = this.result;
    const { clientWidth: widest, clientHeight: highest } = this.element;
    return {
      x: Math.min(Math.max(x - width / 2, 0), Math.max(widest - width, 0)),
      y: Math.min(Math.max(y - height - OVER_PX, 0), Math.max(highest - height, 0)),
    };
  }

  /** Have a pin's label stand where there is more room, beside it and above or below. */
  private turn(element: HTMLElement, at: { x: number; y: number } | null): void {
    if (!at) return;
    const { clientWidth: widest, clientHeight: highest } = this.element;
    element.classList.toggle('left', at.x > widest / 2);
    element.classList.toggle('below', at.y < highest / 2);
    element.style.setProperty('--room', `${Math.max(at.x, widest - at.x)}px`);
  }

  private drawWays(): void {
    const drawn = ['', ''];
    for (const { points, normals } of this.legs) {
      let before = -1;
      points.forEach((point, at) => {
        const { x, y, away } = this.sight.sketch(point, normals[at]!);
        const here = `${x.toFixed(1)} ${y.toFixed(1)}`;
        if (before >= 0) drawn[before] += `L${here}`;
        if (before !== Number(away)) drawn[Number(away)] += `M${here}`;
        before = Number(away);
      });
    }
    this.ways.forEach((way, at) => way.setAttribute('d', drawn[at]!));
  }

  private put(element: HTMLElement, place: Place | null): { x: number; y: number } | null {
    const at = place && this.sight.project(place);
    element.hidden = !at;
    if (!at) return null;
    element.style.transform = `translate(${at.x}px, ${at.y}px)`;
    element.classList.toggle('behind', at.hidden);
    return at;
  }
}
