// A second scan beside the open one: cameras that move together, detail for both, each over a stream of its own.

import { Vector3 } from 'three';
import { readSidecar } from './api.ts';
import { CONTEXT } from './link.ts';
import type { FromWorker } from './link.ts';
import { Pane } from './pane.ts';
import type { PaneEvents } from './pane.ts';
import { strings } from './strings.ts';
import type { Beside } from './url_state.ts';
import { rendererOf } from './view/renderer.ts';
import type { Place } from './view/room.ts';
import type { CameraPlace } from './view/stage.ts';

/** What the page hears of the picture beside; `changed` also when there is a comparison, or none any more. */
export type ComparisonEvents = Omit<PaneEvents, 'opened' | 'moved' | 'missing'>;

/** How the camera of one scan stands when it moves along with another's. Distances stay alike: both have one scale. */
interface Offset {
  azimuth: number;
  elevation: number;
  shift: Vector3;
}

const UP = new Vector3(0, 1, 0);
const NONE: Offset = { azimuth: 0, elevation: 0, shift: new Vector3() };

export class Comparison {
  /** Whether both cameras move together, and whether detail is got for both. */
  readonly moves = { together: true, sharpenBoth: true };
  private other: Pane | null = null;
  private worker: Worker | null = null;
  /** What the other picture shows, or shall show. */
  private beside: Beside | null = null;
  private offset = NONE;
  private isFollowing = false;
  /** Until the scan beside is there, its camera says nothing. */
  private isShown = false;
  /** A place that is pressed, and where that asks for detail. */
  private pressed: { place: Place; looks: [Pane, Place][] } | null = null;

  constructor(
    private readonly pane: Pane, private readonly pictures: HTMLElement, private readonly hire: (scan: string) => Worker,
    private readonly events: ComparisonEvents,
  ) {}

  /** The scan beside, and the view of it; null while there is none. */
  get state(): Beside | null {
    const { beside, other } = this;
    if (!beside || other?.info?.id !== beside.scan) return beside;
    return { scan: beside.scan, camera: other.stage.placed, foveae: other.looks.foveae };
  }

  /** The picture of the scan beside; null while there is none. */
  get picture(): Pane | null {
    return this.beside && this.other;
  }

  /** Show a scan beside the open one. */
  open(beside: Beside): void {
    this.other ??= this.build();
    if (!this.other) return this.events.say(strings.compare.noPicture);
    this.beside = beside;
    this.isShown = false;
    if (!this.other.element.isConnected) this.pictures.append(this.other.element);
    if (this.worker) {
      this.other.open(beside.scan);
    } else {
      this.worker = this.hire(beside.scan);
      this.worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.hear(data);
    }
    this.events.changed();
  }

  close(): void {
    if (!this.beside || !this.other) return;
    this.worker?.terminate();
    this.worker = this.beside = null;
    this.offset = NONE;
    this.other.clear();
    this.other.element.remove();
    this.events.changed();
  }

  /** Have the cameras move together from here on, as they stand to each other now, or each alone. */
  link(together: boolean): void {
    this.moves.together = together;
    const { picture } = this;
    if (!together || !picture) return;
    this.offset = offsetBetween(this.pane.stage.placed, picture.stage.placed);
    this.moved(this.pane);
  }

  /** Let both stand alike again, where the first stands. */
  align(): void {
    this.offset = NONE;
    this.moved(this.pane);
  }

  /** A camera has moved: the other one follows. */
  moved(pane: Pane): void {
    const { picture } = this;
    if (!picture || !this.isShown || this.isFollowing || !this.moves.together) return;
    this.isFollowing = true;
    const { placed, moving } = pane.stage;
    if (pane === this.pane) picture.stage.follow(along(placed, this.offset), moving);
    else this.pane.stage.follow(back(placed, this.offset), moving);
    this.isFollowing = false;
  }

  /** Get detail at a place of one picture, and at what is seen there in the other. */
  sharpen(pane: Pane, place: Place): void {
    const looks = this.pressed?.place === place ? this.pressed.looks : this.looksAt(pane, place);
    for (const [one, there] of looks) one.sharpen(there);
  }

  /** Ask for that already: the place is pressed, and will be sharpened if it is clicked. */
  lookAhead(pane: Pane, place: Place): void {
    this.pressed = { place, looks: this.looksAt(pane, place) };
    for (const [one, there] of this.pressed.looks) one.lookAhead(there);
  }

  /** What was pressed was not clicked. */
  takeBack(): void {
    for (const [one, there] of this.pressed?.looks ?? []) one.looks.takeBack(there);
    this.pressed = null;
  }

  private looksAt(pane: Pane, place: Place): [Pane, Place][] {
    const { picture } = this;
    if (!picture || !this.moves.sharpenBoth || !this.moves.together) return [[pane, place]];
    const twin = pane === this.pane ? picture : this.pane;
    const at = pane.stage.sight.project(place);
    const seen = at && twin.stage.sight.pickOnPicture(at.x, at.y);
    return seen ? [[pane, place], [twin, seen]] : [[pane, place]];
  }

  private build(): Pane | null {
    const canvas = document.createElement('canvas');
    const context = canvas.getContext('webgl2', CONTEXT);
    if (!context) return null;
    canvas.id = 'view-beside';
    const pane: Pane = new Pane((message) => this.worker?.postMessage(message), rendererOf(canvas, context), {
      ...this.events,
      opened: (info, _, framed) => this.opened(info.id, framed),
      moved: () => this.moved(pane),
      missing: () => {
        this.close();
        this.events.say(strings.compare.missing);
      },
    });
    return pane;
  }

  private hear(said: FromWorker): void {
    switch (said.kind) {
      case 'opened':
      case 'restored':
      case 'patch':
      case 'patched':
      case 'updated':
      case 'refused':
      case 'traffic':
        this.other?.hear(said);
        break;
      default: // what the first stream says too
    }
  }

  private opened(scan: string, framed: boolean): void {
    const { picture, beside } = this;
    if (!picture || !beside || !framed) return;
    const { camera, foveae } = beside;
    this.beside = { scan, camera: null, foveae: [] };
    this.isShown = true;
    this.offset = camera ? offsetBetween(this.pane.stage.placed, camera) : NONE;
    if (camera && !this.moves.together) picture.stage.place(camera);
    else this.moved(this.pane);
    picture.measuring.clear();
    picture.looks.all(foveae);
    void this.showPins(scan);
    this.events.changed();
  }

  private async showPins(scan: string): Promise<void> {
    const sidecar = await readSidecar(scan).catch(() => null);
    if (this.beside?.scan === scan) this.picture?.marks.setPins(sidecar?.pins ?? []);
  }
}

function offsetBetween(one: CameraPlace, other: CameraPlace): Offset {
  const azimuth = other.azimuth - one.azimuth;
  const shift = new Vector3(...other.target).sub(new Vector3(...one.target).applyAxisAngle(UP, azimuth));
  return { azimuth, elevation: other.elevation - one.elevation, shift };
}

function along({ azimuth, elevation, distance, target }: CameraPlace, offset: Offset): CameraPlace {
  const moved = new Vector3(...target).applyAxisAngle(UP, offset.azimuth).add(offset.shift);
  return { azimuth: azimuth + offset.azimuth, elevation: elevation + offset.elevation, distance, target: moved.toArray() };
}

/** Inverse of along. */
function back({ azimuth, elevation, distance, target }: CameraPlace, offset: Offset): CameraPlace {
  const moved = new Vector3(...target).sub(offset.shift).applyAxisAngle(UP, -offset.azimuth);
  return { azimuth: azimuth - offset.azimuth, elevation: elevation - offset.elevation, distance, target: moved.toArray() };
}
