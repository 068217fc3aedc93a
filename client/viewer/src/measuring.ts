// Lengths on a scan: between two points, or along a path of many.

import { strings } from './strings.ts';
import type { Marks } from './ui/marks.ts';
import type { Path } from './view/path.ts';
import type { Place } from './view/room.ts';
import type { Sight } from './view/sight.ts';

/** A distance has two ends; a path goes on from point to point. */
export type Kind = 'distance' | 'path';

const PLACES_MAX = 100;
/** Samples from one to the next: where they are farther apart, a length is a guess. */
const SPACING_SHARP = 2;

/** What was measured, so far. */
export interface Measured {
  kind: Kind;
  count: number;
  /** From the first point to the last as the crow flies; null while there are no two. */
  straightMm: number | null;
  alongMm: number | null;
  /** Of the length along the surface, over what was not measured. */
  gapsMm: number;
  /** Whether full detail is held at every point. */
  isSharp: boolean;
}

export class Measuring {
  private kind: Kind = 'distance';
  private places: Place[] = [];
  /** From each place to the next. */
  private legs: Path[] = [];

  constructor(private readonly sight: Sight, private readonly marks: Marks, private readonly changed: (measured: Measured) => void) {}

  /** Measure anew. */
  begin(kind: Kind): void {
    this.kind = kind;
    this.clear();
  }

  /** Measure this from now on, or nothing; points stay, unless something else is measured. */
  choose(kind: Kind | null): void {
    if (kind && kind !== this.kind) this.begin(kind);
    else this.put(this.places, this.legs);
  }

  /** Forget all points. */
  clear(): void {
    this.put([], []);
  }

  /** One more point; of a distance, the third begins another. */
  add(place: Place): void {
    const [last, isDone] = [this.places.at(-1), this.kind === 'distance' && this.places.length === 2];
    if (!last || isDone) return this.put([place], []);
    const leg = this.sight.path(last, place);
    if (leg && this.places.length < PLACES_MAX) this.put([...this.places, place], [...this.legs, leg]);
  }

  /** Take the last point back. */
  undo(): void {
    this.put(this.places.slice(0, -1), this.legs.slice(0, -1));
  }

  /** The surface has changed: measure the same again. */
  renew(): void {
    if (!this.places.length) return;
    const legs = this.places.slice(1).map((place, at) => this.sight.path(this.places[at]!, place));
    if (legs.every((leg) => leg !== null)) this.put(this.places, legs);
    else this.clear();
  }

  private put(places: Place[], legs: Path[]): void {
    [this.places, this.legs] = [places, legs];
    const [first, last] = [places[0], places.at(-1)].map((place) => place && this.sight.locate(place));
    const sum = (part: 'lengthMm' | 'gapsMm') => legs.reduce((total, leg) => total + leg[part], 0);
    const measured: Measured = {
      kind: this.kind,
      count: places.length,
      straightMm: legs.length && first && last ? first.distanceTo(last) : null,
      alongMm: legs.length ? sum('lengthMm') : null,
      gapsMm: sum('gapsMm'),
      isSharp: places.every((place) => this.sight.spacingAt(place) <= SPACING_SHARP),
    };
    const { measure } = strings;
    const { straightMm, alongMm } = measured;
    const along = alongMm === null ? null : measure.along(alongMm);
    this.marks.setMeasured(places, legs, this.kind === 'distance' && straightMm !== null ? measure.result(straightMm) : null, along);
    this.changed(measured);
  }
}
