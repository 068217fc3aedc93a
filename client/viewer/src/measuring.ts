// Distances between points of a scan.

import { strings } from './strings.ts';
import type { Marks } from './ui/marks.ts';
import type { Place } from './view/room.ts';
import type { Stage } from './view/stage.ts';

export class Measuring {
  private places: Place[] = [];

  constructor(private readonly stage: Stage, private readonly marks: Marks, private readonly say: (text: string) => void) {}

  /** One more point: the second ends a distance, the next begins another. */
  add(place: Place): void {
    this.show(this.places.length === 2 ? [place] : [...this.places, place]);
    if (this.places.length === 1) this.say(strings.measure.second);
  }

  clear(): void {
    this.show([]);
  }

  private show(places: Place[]): void {
    this.places = places;
    const [a, b] = places.map((place) => this.stage.locate(place));
    const distance = a && b ? a.distanceTo(b) : null;
    this.marks.setMeasured(places, distance);
    if (distance !== null) this.say(`${strings.measure.heading}: ${strings.measure.result(distance)}, ${strings.measure.straight}`);
  }
}
