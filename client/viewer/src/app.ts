// The page: panels, picture and worker, and what passes between them.

import { changeSidecar, deleteScan, listScans, readCapture, readSidecar, Refused, startSweep } from './api.ts';
import type { Changes, Sidecar } from './api.ts';
import type { Answer, FromWorker, LinkState, Snapshot, ToWorker } from './link.ts';
import { thinned } from './live_picture.ts';
import { blocksAcross, blocksDown, RANGE, TEXTURE } from './protocol/lattice.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { channelShapes } from './protocol/messages.ts';
import { strings } from './strings.ts';
import { AboutPanel } from './ui/about_panel.ts';
import { CostPanel } from './ui/cost_panel.ts';
import { DisplayPanel } from './ui/display_panel.ts';
import { h } from './ui/dom.ts';
import { LookPanel } from './ui/look_panel.ts';
import type { Tool } from './ui/look_panel.ts';
import { Marks } from './ui/marks.ts';
import { PinsPanel } from './ui/pins_panel.ts';
import { ScanList } from './ui/scan_list.ts';
import { ScannerPanel } from './ui/scanner_panel.ts';
import { formatState, parseState } from './url_state.ts';
import type { Pin } from './url_state.ts';
import type { Place } from './view/pick.ts';
import { Stage } from './view/stage.ts';

const CLICK_MS = 500;
const CLICK_PX = 6;
const FOLLOW_MS = 200;
const CAPTURE_MS = 2000;
const NOTICE_MS = 6000;
const LIVE_RADIUS_SHARE = 0.42;

export class App {
  private readonly canvas = h('canvas', { id: 'view', tabindex: 0, role: 'application', 'aria-label': strings.view.label });
  private readonly link = h('p', { id: 'link', role: 'status' }, strings.link.connecting);
  private readonly retry = h('button', { type: 'button', class: 'secondary', hidden: true, click: () => this.tell({ kind: 'retry' }) }, strings.link.again);
  private readonly notice = h('p', { id: 'notice', role: 'status' });
  private readonly hint = h('p', { id: 'hint' }, strings.view.hints.sharpen);
  private readonly empty = h('p', { id: 'empty', hidden: true }, strings.view.empty);
  private readonly stage: Stage;
  private readonly marks: Marks;
  private readonly scans: ScanList;
  private readonly scanner = new ScannerPanel(() => void this.sweep(), () => this.watch());
  private readonly look = new LookPanel(() => this.sharpenMiddle(), (tool) => this.toolChanged(tool));
  private readonly display: DisplayPanel;
  private readonly cost = new CostPanel();
  private readonly pinsPanel: PinsPanel;
  private readonly about: AboutPanel;

  private state = parseState(location.hash.slice(1));
  private info: ScanInfo | null = null;
  private sidecar: Sidecar | null = null;
  private role = 'view';
  private looks = 0;
  private looking: { look: number; place: Place } | null = null;
  private queue: Place[] = [];
  private measured: Place[] = [];
  /** The sweep that runs; the same in `live` while the picture shows it. */
  private running: ScanInfo | null = null;
  private live: ScanInfo | null = null;
  private startedHere = false;
  private retryTimer: ReturnType<typeof setInterval> | undefined;
  private noticeTimer: ReturnType<typeof setTimeout> | undefined;
  private followed = 0;

  constructor(private readonly root: HTMLElement, private readonly worker: Worker) {
    const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.scans = new ScanList((id) => this.open(id), (scan) => this.tell({ kind: 'thumbnail', scan }));
    this.pinsPanel = new PinsPanel((pin) => void this.keepPins([...this.state.pins, pin]),
      (index) => void this.keepPins(this.state.pins.filter((_, at) => at !== index)), (pin) => this.goTo(pin));
    this.about = new AboutPanel((changes) => void this.save(changes), () => void this.remove());
    this.display = new DisplayPanel((shading, overlay) => this.stage.setLook(shading, overlay));
    this.lay();
    this.stage = new Stage(this.canvas, {
      drawn: () => this.marks?.update(),
      settled: () => this.writeState(),
      lost: () => this.say(strings.link.graphicsLost),
      restored: () => this.tell({ kind: 'restore' }),
    }, calm);
    this.marks = new Marks(this.stage);
    this.canvas.parentElement!.append(this.marks.element);
    this.listen();
    worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.hear(data);
    void this.refreshScans();
    void this.refreshCapture();
    setInterval(() => void this.refreshCapture(), CAPTURE_MS);
  }

  private lay(): void {
    const button = (text: string, label: string, act: () => void) =>
      h('button', { type: 'button', class: 'secondary', 'aria-label': label, title: label, click: act }, text);
    const zoom = h('div', { id: 'zoom' },
      button('+', strings.view.zoomIn, () => this.stage.zoom(1)), button('−', strings.view.zoomOut, () => this.stage.zoom(-1)),
      button('⌂', strings.view.home, () => this.home()));
    const panels = [this.scans.element, this.scanner.element, this.look.element, this.display.element, this.pinsPanel.element,
      this.cost.element, this.about.element];
    this.root.append(
      h('header', {}, h('h1', {}, strings.title), h('div', {}, this.link, this.retry)),
      h('main', {},
        h('section', { id: 'stage', 'aria-label': strings.view.label.split('.')[0]! }, this.canvas, this.empty, this.notice, this.hint, zoom, this.display.legend),
        h('aside', { id: 'panel' }, ...panels)),
    );
  }

  private tell(message: ToWorker): void {
    this.worker.postMessage(message);
  }

  // What the worker says

  private hear(said: FromWorker): void {
    switch (said.kind) {
      case 'link':
        this.linked(said.link);
        break;
      case 'opened':
        this.opened(said.snapshot, said.fresh);
        break;
      case 'restored':
        document.documentElement.dataset['restored'] = 'yes';
        break;
      case 'patch':
        this.stage.patch(said.channel, said.changed, said.level);
        break;
      case 'updated':
        this.updated(said.answer);
        break;
      case 'refused':
        this.refused(said.look, said.code, said.message);
        break;
      case 'published':
        void this.refreshScans();
        break;
      case 'liveStarted':
        this.liveStarted(said.grid);
        break;
      case 'livePicture':
        if (this.live) this.stage.replace(said.steps, said.texels);
        break;
      case 'liveProgress':
        this.scanner.sweeping(said.percent, said.secondsLeft);
        if (this.live) this.say(strings.view.live(said.percent, said.secondsLeft));
        break;
      case 'liveEnded':
        this.liveEnded(said.scan, said.why);
        break;
      case 'thumbnail':
        this.scans.picture(said.scan, said);
        break;
      case 'traffic':
        this.cost.traffic(said.received);
        break;
    }
  }

  private linked(link: LinkState): void {
    clearInterval(this.retryTimer);
    document.documentElement.dataset['link'] = link.state;
    this.retry.hidden = link.state !== 'lost';
    if (link.state === 'connecting') this.link.textContent = strings.link.connecting;
    if (link.state === 'ready') {
      this.role = link.role;
      this.link.textContent = strings.link.ready(link.node);
      this.scanner.allow(link.role);
      void this.refreshScans();
      void this.refreshCapture();
    }
    if (link.state !== 'lost') return;
    const due = performance.now() + link.retryMs;
    const count = () => {
      this.link.textContent = strings.link.lost(link.reason, Math.max(0, Math.ceil((due - performance.now()) / 1000)));
    };
    count();
    this.retryTimer = setInterval(count, 1000);
  }

  private opened(snapshot: Snapshot, fresh: boolean): void {
    const framed = fresh && this.info?.id !== snapshot.info.id;
    this.live = null;
    this.info = snapshot.info;
    this.empty.hidden = true;
    try {
      this.stage.show(snapshot, framed);
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
      this.say(strings.tooLarge);
      return;
    }
    if (this.stage.shrunk > 1) this.say(strings.shrunk(this.stage.shrunk));
    document.documentElement.dataset['scan'] = snapshot.info.id;
    if (!fresh) return;
    this.scans.mark(snapshot.info.id);
    this.about.show(snapshot.info);
    if (framed) this.restoreState(snapshot.info.id);
    void this.refreshSidecar(snapshot.info.id);
  }

  /** What the address asks for, when it is about this scan; else a clean view of it. */
  private restoreState(scan: string): void {
    const { camera, foveae, pins } = this.state;
    const meant = this.state.scan === scan;
    this.state = { scan, camera: meant ? camera : null, foveae: [], pins: meant ? pins : [] };
    if (meant && camera) this.stage.place(camera);
    this.setMeasured([]);
    this.showPins();
    this.queue = meant ? foveae : [];
    this.next();
    this.writeState();
  }

  private updated(answer: Answer): void {
    if (answer.reason !== 'superseded') {
      this.cost.answered(answer);
      const { dataset } = document.documentElement;
      dataset['updates'] = String(Number(dataset['updates'] ?? 0) + 1);
    }
    if (answer.look !== this.looking?.look) return;
    if (answer.reason !== 'superseded') this.state.foveae.push(this.looking.place);
    this.endLook();
    this.next();
    this.writeState();
  }

  private refused(look: number, code: string, message: string): void {
    if (look === this.looking?.look) this.endLook();
    if (code === 'not found') {
      this.empty.hidden = this.info !== null;
      if (this.state.scan && !this.info) this.tell({ kind: 'open', scan: 'latest' });
      this.state.scan = null;
      return;
    }
    this.say(strings.failed(message));
  }

  private endLook(): void {
    this.looking = null;
    this.marks.setBusy(null);
    document.documentElement.dataset['looking'] = 'no';
  }

  // A running sweep

  /** A sweep runs. It takes the picture of whoever started it, or sees nothing else; others are asked. */
  private liveStarted(grid: ScanInfo): void {
    this.running = grid;
    document.documentElement.dataset['live'] = 'offered';
    if (this.startedHere || !this.info) this.watch();
    else this.scanner.offer(true);
  }

  private watch(): void {
    const grid = this.running;
    if (!grid) return;
    this.live = grid;
    this.scanner.offer(false);
    this.empty.hidden = true;
    const info = thinned(grid);
    const levels = Object.values(channelShapes(info)).map((shape) => new Uint8Array(blocksAcross(shape) * blocksDown(shape)));
    const snapshot: Snapshot = {
      info, steps: new Uint16Array(info.width * info.height),
      coarseTexels: new Uint8Array(4 * info.coarseTextureWidth * info.coarseTextureHeight), levels: [levels[RANGE]!, levels[TEXTURE]!],
    };
    this.stage.show(snapshot, false);
    this.stage.frameEmpty(grid.height * grid.pitchMm * LIVE_RADIUS_SHARE);
    this.marks.setPins([]);
    this.marks.setMeasured([], null);
    document.documentElement.dataset['live'] = 'yes';
  }

  private liveEnded(scan: string | null, why: string): void {
    document.documentElement.dataset['live'] = 'no';
    this.running = null;
    this.startedHere = false;
    this.scanner.ended();
    void this.refreshCapture();
    const showing = this.live !== null;
    this.live = null;
    this.say(scan ? strings.scanner.done : strings.scanner.interrupted(why));
    if (scan && showing) this.open(scan);
    else if (showing && this.info) this.tell({ kind: 'restore' });
  }

  private async sweep(): Promise<void> {
    this.startedHere = true;
    try {
      await startSweep();
      this.say(strings.scanner.started);
    } catch (error) {
      this.startedHere = false;
      this.say(strings.failed((error as Error).message));
    }
    void this.refreshCapture();
  }

  // What people do

  private open(id: string): void {
    this.state = { scan: id, camera: null, foveae: [], pins: [] };
    this.info = null;
    this.tell({ kind: 'open', scan: id });
  }

  private listen(): void {
    let down: PointerEvent | null = null;
    this.canvas.addEventListener('pointerdown', (event) => (down = event.isPrimary ? event : null));
    this.canvas.addEventListener('pointerup', (event) => {
      const still = down && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < CLICK_PX;
      if (still && event.button === 0 && event.timeStamp - down!.timeStamp < CLICK_MS) this.click(event.clientX, event.clientY);
      down = null;
    });
    this.canvas.addEventListener('pointermove', (event) => {
      if (this.look.follow && !down && event.timeStamp - this.followed > FOLLOW_MS) {
        this.followed = event.timeStamp;
        const place = this.live ? null : this.stage.pick(event.clientX, event.clientY);
        if (place) this.sharpen(place);
      }
    });
    this.canvas.addEventListener('keydown', (event) => this.key(event));
    addEventListener('hashchange', () => this.addressChanged());
    addEventListener('online', () => this.tell({ kind: 'retry' }));
  }

  private click(x: number, y: number): void {
    if (this.live) return;
    const place = this.stage.pick(x, y);
    if (place) this.act(place);
    else if (this.look.tool !== 'sharpen') this.say(strings.view.missed);
  }

  private act(place: Place): void {
    if (this.look.tool === 'measure') this.measure(place);
    else if (this.look.tool === 'pin') this.pinsPanel.ask(place);
    else this.sharpen(place);
  }

  private key(event: KeyboardEvent): void {
    const arrows: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const arrow = arrows[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (arrow && event.shiftKey) this.stage.pan(-arrow[0], -arrow[1]);
    else if (arrow) this.stage.turn(...arrow);
    else if (event.key === '+' || event.key === '=') this.stage.zoom(1);
    else if (event.key === '-') this.stage.zoom(-1);
    else if (event.key === 'Home') this.home();
    else if (event.key === 'Enter') this.actInMiddle();
    else return;
    event.preventDefault();
  }

  private home(): void {
    this.stage.frame();
    this.writeState();
  }

  private actInMiddle(): void {
    const place = this.live ? null : this.stage.pickMiddle();
    if (place) this.act(place);
    else this.say(strings.view.missed);
  }

  private sharpenMiddle(): void {
    const place = this.live ? null : this.stage.pickMiddle();
    if (place) this.sharpen(place);
    else this.say(strings.view.missed);
  }

  private sharpen(place: Place): void {
    if (!this.info) return;
    this.queue = [];
    this.ask(place);
  }

  private ask(place: Place): void {
    const look = ++this.looks;
    this.looking = { look, place };
    this.marks.setBusy(place);
    document.documentElement.dataset['looking'] = 'yes';
    this.tell({ kind: 'look', look, u: place.u, v: place.v, options: this.look.options });
  }

  private next(): void {
    const place = this.queue.shift();
    if (place) this.ask(place);
  }

  private toolChanged(tool: Tool): void {
    this.hint.textContent = strings.view.hints[tool];
    if (tool !== 'pin') this.pinsPanel.ask(null);
    this.setMeasured([]);
    if (tool === 'measure') this.say(strings.measure.first);
  }

  private measure(place: Place): void {
    this.setMeasured(this.measured.length === 2 ? [place] : [...this.measured, place]);
    if (this.measured.length === 1) this.say(strings.measure.second);
  }

  private setMeasured(places: Place[]): void {
    this.measured = places;
    const [a, b] = places.map((place) => this.stage.locate(place));
    const distance = a && b ? a.distanceTo(b) : null;
    this.marks.setMeasured(places, distance);
    if (distance !== null) this.say(`${strings.measure.heading}: ${strings.measure.result(distance)}, ${strings.measure.straight}`);
  }

  private goTo({ u }: Pin): void {
    if (!this.info) return;
    this.stage.place({ ...this.stage.placed, azimuth: this.info.theta0Rad + 2 * Math.PI * u });
    this.writeState();
  }

  // What is said of scans

  private async keepPins(pins: Pin[]): Promise<void> {
    this.state.pins = pins;
    this.showPins();
    this.writeState();
    await this.save({ pins }, false);
  }

  private async save(changes: Changes, aloud = true): Promise<void> {
    const [scan, sidecar] = [this.info?.id, this.sidecar];
    if (!scan || !sidecar) return;
    try {
      this.takeSidecar(scan, await changeSidecar(scan, sidecar.revision, changes));
      if (aloud) this.say(strings.about.saved);
    } catch (error) {
      const conflict = error instanceof Refused && (error.status === 409 || error.status === 412);
      this.say(conflict ? strings.pins.conflict : strings.failed((error as Error).message));
      await this.refreshSidecar(scan);
    }
  }

  private async refreshSidecar(scan: string): Promise<void> {
    try {
      const sidecar = await readSidecar(scan);
      if (this.info?.id === scan) this.takeSidecar(scan, sidecar);
    } catch (error) {
      this.say(strings.failed((error as Error).message));
    }
  }

  private takeSidecar(scan: string, sidecar: Sidecar | null): void {
    this.sidecar = sidecar;
    this.about.said(sidecar, this.role);
    if (sidecar) {
      this.scans.said(scan, sidecar);
      this.state.pins = sidecar.pins;
    }
    this.showPins();
    this.writeState();
  }

  private showPins(): void {
    this.pinsPanel.show(this.state.pins, this.sidecar !== null);
    this.marks.setPins(this.state.pins);
  }

  private async remove(): Promise<void> {
    const scan = this.info?.id;
    if (!scan) return;
    try {
      await deleteScan(scan);
    } catch (error) {
      this.say(strings.failed((error as Error).message));
      return;
    }
    this.info = null;
    this.stage.clear();
    this.about.hide();
    this.marks.setPins([]);
    this.setMeasured([]);
    this.state = { scan: null, camera: null, foveae: [], pins: [] };
    await this.refreshScans();
    this.tell({ kind: 'open', scan: 'latest' });
  }

  private async refreshScans(): Promise<void> {
    try {
      this.scans.show(await listScans());
    } catch {
      return; // the line above the picture says why
    }
  }

  private async refreshCapture(): Promise<void> {
    try {
      this.scanner.show(await readCapture());
    } catch {
      return; // likewise
    }
  }

  // The address

  private writeState(): void {
    if (!this.info || this.live) return;
    const fragment = formatState({ ...this.state, scan: this.info.id, camera: this.stage.placed });
    history.replaceState(null, '', `#${fragment}`);
  }

  private addressChanged(): void {
    this.state = parseState(location.hash.slice(1));
    this.info = null;
    this.tell({ kind: 'open', scan: this.state.scan ?? 'latest' });
  }

  private say(text: string): void {
    this.notice.textContent = text;
    clearTimeout(this.noticeTimer);
    this.noticeTimer = setTimeout(() => (this.notice.textContent = ''), NOTICE_MS);
  }
}
