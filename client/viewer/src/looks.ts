// What is asked for of one picture: one look after the other, the newest instead of an older one; and one ahead of a click.
// Where a pointer is pressed is known before it is known that it is a click: a tenth of a second, in which most looks are
// answered. What a press that is none has brought is held like any other detail, but nobody is told of a look.

import type { Answer } from './link.ts';
import type { Place } from './view/room.ts';

export interface LooksEvents {
  /** Ask the node. */
  ask(look: number, place: Place): void;
  /** What was asked is not wanted any more. */
  cancel(look: number): void;
  /** Somebody waits for detail at a place, or not any more. */
  awaited(place: Place | null): void;
  /** A look was answered, not superseded. */
  answered(answer: Answer): void;
  /** What was asked is done with: the foveae may be others. */
  ended(): void;
}

interface Looking {
  look: number;
  place: Place;
  /** For a press, of which nobody knows yet whether it is a click. */
  isAhead: boolean;
  /** What came of it meanwhile. */
  answer: Answer | null;
}

export class Looks {
  /** Where detail was got, in order. */
  foveae: Place[] = [];
  private count = 0;
  private looking: Looking | null = null;
  private queue: Place[] = [];

  constructor(private readonly events: LooksEvents) {}

  /** Get detail at a place, whatever was asked for before; if a press has asked for it, that was a click. */
  at(place: Place): void {
    this.queue = [];
    const looking = this.aheadAt(place);
    if (!looking) return this.ask(place);
    looking.isAhead = false;
    if (looking.answer) this.end(looking.answer);
    else this.events.awaited(place);
  }

  /** Ask for detail at a place that is pressed, unless something is on its way that this would end. */
  ahead(place: Place): void {
    if (!this.looking) this.begin(place, true);
  }

  /** That was no click. */
  takeBack(place: Place): void {
    const looking = this.aheadAt(place);
    if (!looking) return;
    this.looking = null;
    if (!looking.answer) this.events.cancel(looking.look);
  }

  /** Get detail at places, one after the other, and nowhere else. */
  all(places: Place[]): void {
    this.foveae = [];
    this.queue = [...places];
    this.next();
  }

  /** Want no more of what is on its way. */
  cancel(): void {
    this.queue = [];
    if (this.looking) this.events.cancel(this.looking.look);
  }

  /** Forget everything. */
  clear(): void {
    [this.queue, this.foveae] = [[], []];
    this.forget();
  }

  /** The node has answered, or will not. */
  answered(answer: Answer): void {
    const { looking } = this;
    if (answer.look !== looking?.look) return;
    if (looking.isAhead && answer.reason !== 'superseded') looking.answer = answer;
    else this.end(answer);
  }

  /** The node has refused a look. */
  refused(look: number): void {
    if (look === this.looking?.look) this.forget();
  }

  private aheadAt(place: Place): Looking | null {
    return this.looking?.isAhead && this.looking.place === place ? this.looking : null;
  }

  private ask(place: Place): void {
    this.begin(place, false);
    this.events.awaited(place);
  }

  private begin(place: Place, isAhead: boolean): void {
    const look = ++this.count;
    this.looking = { look, place, isAhead, answer: null };
    this.events.ask(look, place);
  }

  private end(answer: Answer): void {
    const { place } = this.looking!;
    if (answer.reason !== 'superseded') {
      this.foveae.push(place);
      this.events.answered(answer);
    }
    this.forget();
    this.next();
    this.events.ended();
  }

  private next(): void {
    const place = this.queue.shift();
    if (place) this.ask(place);
  }

  private forget(): void {
    this.looking = null;
    this.events.awaited(null);
  }
}
