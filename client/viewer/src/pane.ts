// One picture with one scan in it: shows what the worker says of it, and asks for detail.

import type { WebGLRenderer } from 'three';
import type { Answer, FromWorker, LookOptions, ToWorker } from './link.ts';
import { Looks } from './looks.ts';
import { Measuring } from './measuring.ts';
import type { Measured } from './measuring.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { strings } from './strings.ts';
import { assign, h } from './ui/dom.ts';
import { listen } from './ui/gestures.ts';
import { Marks } from './ui/marks.ts';
import type { Place } from './view/room.ts';
import { Stage } from './view/stage.ts';

/** So long the page waits for its first picture before it shows, or asks for, anything else. */
const PICTURE_MS = 400;

/** What a worker says of the scan it has open. */
export type OfScan = Extract<FromWorker, { kind: 'opened' | 'restored' | 'patch' | 'patched' | 'updated' | 'refused' | 'traffic' | 'broken' }>;

export interface PaneEvents {
  say(text: string): void;
  /** How sharp the next look shall be. */
  options(): LookOptions;
  /** A scan is in the picture. fresh: asked for by us; framed: another than before, with the camera where it sees all. */
  opened(info: ScanInfo, fresh: boolean, framed: boolean): void;
  /** A look was answered, not superseded. */
  updated(answer: Answer): void;
  /** There is no such scan. */
  missing(): void;
  /** The pointer is down there: a click, perhaps. */
  pressed(place: Place): void;
  /** Somebody clicked there, or asked for the middle; null: where nothing was measured. */
  clicked(place: Place | null): void;
  /** What was pressed was not clicked. */
  dropped(): void;
  /** The pointer is there. */
  hovered(place: () => Place | null): void;
  home(): void;
  /** Lengths were measured on it, or are no more. */
  measured(measured: Measured): void;
  /** The last point shall be taken back. */
  undone(): void;
  /** The camera moves. */
  moved(): void;
  /** So many bytes have come. */
  received(bytes: number): void;
  /** The camera has come to rest, or there is one more fovea: the view is another one. */
  changed(): void;
}

export class Pane {
  readonly element: HTMLElement;
  readonly stage: Stage;
  readonly marks: Marks;
  readonly measuring: Measuring;
  /** The scan in the picture; null while another one is on its way. */
  info: ScanInfo | null = null;
  readonly looks: Looks;
  /** Kept once a first picture stands, or none will soon. */
  readonly pictured: Promise<void>;
  private painted!: () => void;
  private poster: HTMLImageElement | null = null;
  private pressed: Place | null = null;
  private bytes = 0;
  private readonly noted: HTMLElement;

  /** noted: where it stands to be read how far things are; its own element, if nothing else. */
  constructor(
    private readonly tell: (message: ToWorker) => void, renderer: WebGLRenderer, private readonly events: PaneEvents, noted?: HTMLElement,
  ) {
    const canvas = renderer.domElement;
    const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    assign(canvas, { tabindex: 0, role: 'application', 'aria-label': strings.view.label });
    this.element = h('div', { class: 'picture' }, canvas);
    this.noted = noted ?? this.element;
    this.pictured = new Promise<void>((resolve) => (this.painted = resolve)).then(() => this.stage.done());
    setTimeout(() => this.painted(), PICTURE_MS);
    this.stage = new Stage(renderer, {
      drawn: () => this.drawn(),
      moved: () => {
        if (this.stage.moving) this.showMeanwhile(null);
        this.events.moved();
      },
      settled: () => this.events.changed(),
      lost: () => this.events.say(strings.link.graphicsLost),
      restored: () => this.restore(),
    }, calm);
    this.marks = new Marks(this.stage.sight);
    this.measuring = new Measuring(this.stage.sight, this.marks, (measured) => this.events.measured(measured));
    this.looks = new Looks({
      ask: (look, { u, v }) => this.tell({ kind: 'look', look, u, v, options: this.events.options() }),
      cancel: (look) => this.tell({ kind: 'cancel', look }),
      awaited: (place) => this.await(place),
      answered: (answer) => this.answered(answer),
      ended: () => this.events.changed(),
    });
    this.element.append(this.marks.element);
    listen(canvas, {
      press: (x, y) => {
        this.pressed = this.stage.sight.pick(x, y);
        if (this.pressed) this.events.pressed(this.pressed);
      },
      click: () => this.events.clicked(this.pressed),
      drop: () => this.events.dropped(),
      hover: (x, y) => this.events.hovered(() => this.stage.sight.pick(x, y)),
      turn: (across, up) => this.stage.turn(across, up),
      pan: (right, up) => this.stage.pan(right, up),
      zoom: (steps) => this.stage.zoom(steps),
      home: () => this.events.home(),
      act: () => this.events.clicked(this.stage.sight.pickMiddle()),
      undo: () => this.events.undone(),
      cancel: () => this.looks.cancel(),
    });
  }

  hear(said: OfScan): void {
    switch (said.kind) {
      case 'opened':
        this.opened(said);
        break;
      case 'restored':
        this.noted.dataset['restored'] = 'yes';
        break;
      case 'patch':
        this.stage.patch(said.channel, said.changed, said.level);
        break;
      case 'patched':
        this.stage.paintNow();
        break;
      case 'updated':
        if (said.answer.reason !== 'superseded') this.measuring.renew();
        this.looks.answered(said.answer);
        break;
      case 'refused':
        this.refused(said);
        break;
      case 'broken':
        this.events.say(strings.copy.broken);
        break;
      case 'traffic':
        if (said.received < this.bytes) this.bytes = 0; // another worker counts anew
        this.events.received(said.received - this.bytes);
        this.bytes = said.received;
        break;
    }
  }

  /** Show a picture of the scan until it is drawn itself; null: no more. It is as the camera sees it that nobody has moved. */
  showMeanwhile(poster: HTMLImageElement | null): void {
    this.poster?.remove();
    this.poster = poster;
    if (poster) this.element.prepend(poster);
  }

  /** Have another scan opened. */
  open(scan: string): void {
    this.info = null;
    this.showMeanwhile(null);
    this.tell({ kind: 'open', scan });
  }

  /** Show again what is held. */
  restore(): void {
    this.tell({ kind: 'restore' });
  }

  /** Show nothing. */
  clear(): void {
    this.painted();
    this.showMeanwhile(null);
    this.info = null;
    delete this.noted.dataset['scan'];
    this.looks.clear();
    this.stage.clear();
    this.marks.setPins([]);
    this.measuring.clear();
  }

  /** Get detail at a place. */
  sharpen(place: Place): void {
    if (this.info) this.looks.at(place);
  }

  /** Ask for it, since the place is pressed. */
  lookAhead(place: Place): void {
    if (this.info) this.looks.ahead(place);
  }

  private drawn(): void {
    this.marks?.update();
    if (!this.info) return;
    this.painted();
    if (this.poster) void this.stage.done().then(() => this.showMeanwhile(null));
  }

  private opened({ snapshot, fresh }: Extract<OfScan, { kind: 'opened' }>): void {
    const framed = fresh && this.info?.id !== snapshot.info.id;
    this.info = snapshot.info;
    this.stage.show(snapshot, framed);
    const { colour, shape } = this.stage.shrunk;
    if (colour > 1 || shape > 1) this.events.say(strings.shrunk(colour, shape));
    this.noted.dataset['scan'] = snapshot.info.id;
    this.events.opened(snapshot.info, fresh, framed);
    this.stage.paintNow();
  }

  private answered(answer: Answer): void {
    this.noted.dataset['updates'] = String(Number(this.noted.dataset['updates'] ?? 0) + 1);
    this.events.updated(answer);
  }

  private refused({ look, code, message }: Extract<OfScan, { kind: 'refused' }>): void {
    this.looks.refused(look);
    if (code === 'not found') this.events.missing();
    else if (code === 'not open' && this.info) this.open(this.info.id); // it was deleted: the node will say so
    else this.events.say(strings.failed(message));
  }

  private await(place: Place | null): void {
    this.marks.setBusy(place);
    this.noted.dataset['looking'] = place ? 'yes' : 'no';
  }
}
