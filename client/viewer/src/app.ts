// The page: panels, picture and worker, and what passes between them.

import { deleteScan, listScans, readAccount, readCapture } from './api.ts';
import type { Sidecar } from './api.ts';
import type { Answer, FromWorker, LinkState, Snapshot, ToWorker } from './link.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { OpenSidecar } from './sidecar.ts';
import { strings } from './strings.ts';
import { Sweep } from './sweep.ts';
import { AboutPanel } from './ui/about_panel.ts';
import { CostPanel } from './ui/cost_panel.ts';
import { DisplayPanel } from './ui/display_panel.ts';
import { Frame } from './ui/frame.ts';
import { listen } from './ui/gestures.ts';
import { LookPanel } from './ui/look_panel.ts';
import type { Tool } from './ui/look_panel.ts';
import { Marks } from './ui/marks.ts';
import { PinsPanel } from './ui/pins_panel.ts';
import { ScanList } from './ui/scan_list.ts';
import { ScannerPanel } from './ui/scanner_panel.ts';
import { WorthPanel } from './ui/worth_panel.ts';
import { formatState, parseState } from './url_state.ts';
import type { Pin } from './url_state.ts';
import type { Place } from './view/room.ts';
import { Stage } from './view/stage.ts';

const CAPTURE_MS = 2000;
const WRITE_MS = 200;

export class App {
  private readonly frame: Frame;
  private readonly stage: Stage;
  private readonly marks: Marks;
  private readonly scans: ScanList;
  private readonly scanner = new ScannerPanel(() => void this.sweep.start(), () => this.sweep.watch());
  private readonly look = new LookPanel(() => this.atMiddle((place) => this.sharpen(place)), (tool) => this.toolChanged(tool));
  private readonly display: DisplayPanel;
  private readonly cost = new CostPanel();
  private readonly pinsPanel: PinsPanel;
  private readonly worth = new WorthPanel();
  private readonly about: AboutPanel;
  private readonly sweep: Sweep;
  private readonly sidecar: OpenSidecar;

  private state = parseState(location.hash.slice(1));
  private info: ScanInfo | null = null;
  private mayChange = false;
  private looks = 0;
  private looking: { look: number; place: Place } | null = null;
  private queue: Place[] = [];
  private measured: Place[] = [];
  private writing: ReturnType<typeof setTimeout> | undefined;

  constructor(
    root: HTMLElement, private readonly worker: Worker, private readonly canvas: HTMLCanvasElement, context: WebGL2RenderingContext,
  ) {
    const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.frame = new Frame(root, canvas, {
      retry: () => this.tell({ kind: 'retry' }), zoom: (steps) => this.stage.zoom(steps), home: () => this.home(),
    });
    this.stage = new Stage(canvas, context, {
      drawn: () => this.marks?.update(),
      settled: () => this.writeState(),
      lost: () => this.frame.say(strings.link.graphicsLost),
      restored: () => this.tell({ kind: 'restore' }),
    }, calm);
    this.marks = new Marks(this.stage);
    const say = (text: string) => this.frame.say(text);
    this.sweep = new Sweep(this.stage, this.scanner, {
      say, watched: () => this.watched(), ended: (scan) => this.sweepEnded(scan), changed: () => void this.refreshCapture(),
    });
    this.sidecar = new OpenSidecar({ say, known: (scan, sidecar) => this.takeSidecar(scan, sidecar) });
    this.scans = new ScanList((id) => this.open(id), (scan) => this.tell({ kind: 'thumbnail', scan }));
    this.pinsPanel = new PinsPanel((pin) => void this.keepPins([...this.state.pins, pin]),
      (index) => void this.keepPins(this.state.pins.filter((_, at) => at !== index)), (pin) => this.goTo(pin));
    this.about = new AboutPanel((changes) => void this.sidecar.save(changes, true), () => void this.remove());
    this.display = new DisplayPanel((shading, overlay) => this.stage.setLook(shading, overlay));
    this.frame.stage.append(this.display.legend, this.marks.element);
    this.frame.add(this.scans.element, this.scanner.element, this.look.element, this.display.element, this.pinsPanel.element,
      this.worth.element, this.cost.element, this.about.element);
    this.listen();
    worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.hear(data);
    void this.refreshScans();
    void this.refreshCapture();
    setInterval(() => void this.refreshCapture(), CAPTURE_MS);
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
        this.sweep.started(said.grid, this.info === null);
        break;
      case 'livePicture':
        this.sweep.picture(said.steps, said.texels);
        break;
      case 'liveProgress':
        this.sweep.progress(said.percent, said.secondsLeft);
        break;
      case 'liveEnded':
        this.sweep.ended(said.scan, said.why);
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
    this.frame.linked(link);
    if (link.state !== 'ready') return;
    this.allow(link.role !== 'view');
    void this.refreshScans();
    void this.refreshCapture();
  }

  /** Show what who looks may do, and nothing that the node would refuse. */
  private allow(mayChange: boolean): void {
    this.mayChange = mayChange;
    this.frame.allow(mayChange);
    this.scanner.allow(mayChange);
    this.look.allowPins(mayChange);
    this.pinsPanel.allow(mayChange);
    this.showPins();
  }

  private opened(snapshot: Snapshot, fresh: boolean): void {
    const framed = fresh && this.info?.id !== snapshot.info.id;
    this.sweep.leave();
    this.info = snapshot.info;
    this.frame.showEmpty(false);
    try {
      this.stage.show(snapshot, framed);
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
      this.frame.say(strings.tooLarge);
      return;
    }
    if (this.stage.shrunk > 1) this.frame.say(strings.shrunk(this.stage.shrunk));
    document.documentElement.dataset['scan'] = snapshot.info.id;
    if (!fresh) return;
    this.scans.mark(snapshot.info.id);
    this.about.show(snapshot.info);
    if (framed) this.restoreState(snapshot.info.id);
    void this.sidecar.open(snapshot.info.id);
    void this.readWorth(snapshot.info.id);
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
      this.frame.showEmpty(this.info === null);
      if (this.state.scan && !this.info) this.tell({ kind: 'open', scan: 'latest' });
      this.state.scan = null;
      return;
    }
    this.frame.say(strings.failed(message));
  }

  private endLook(): void {
    this.looking = null;
    this.marks.setBusy(null);
    document.documentElement.dataset['looking'] = 'no';
  }

  /** The picture shows a sweep: nothing that was marked on a scan belongs there. */
  private watched(): void {
    this.frame.showEmpty(false);
    this.marks.setPins([]);
    this.marks.setMeasured([], null);
  }

  private sweepEnded(scan: string | null): void {
    if (scan) this.open(scan);
    else if (this.info) this.tell({ kind: 'restore' });
  }

  // What people do

  private open(id: string): void {
    this.state = { scan: id, camera: null, foveae: [], pins: [] };
    this.info = null;
    this.tell({ kind: 'open', scan: id });
  }

  private listen(): void {
    listen(this.canvas, {
      click: (x, y) => this.click(x, y),
      hover: (x, y) => this.hover(x, y),
      turn: (across, up) => this.stage.turn(across, up),
      pan: (right, up) => this.stage.pan(right, up),
      zoom: (steps) => this.stage.zoom(steps),
      home: () => this.home(),
      act: () => this.atMiddle((place) => this.act(place)),
    });
    addEventListener('hashchange', () => this.addressChanged());
    addEventListener('online', () => this.tell({ kind: 'retry' }));
  }

  private click(x: number, y: number): void {
    if (this.sweep.isWatched) return;
    const place = this.stage.pick(x, y);
    if (place) this.act(place);
    else if (this.look.tool !== 'sharpen') this.frame.say(strings.view.missed);
  }

  private hover(x: number, y: number): void {
    const place = this.look.follow && !this.sweep.isWatched ? this.stage.pick(x, y) : null;
    if (place) this.sharpen(place);
  }

  private atMiddle(act: (place: Place) => void): void {
    const place = this.sweep.isWatched ? null : this.stage.pickMiddle();
    if (place) act(place);
    else this.frame.say(strings.view.missed);
  }

  private act(place: Place): void {
    if (this.look.tool === 'measure') this.measure(place);
    else if (this.look.tool === 'pin') this.pinsPanel.ask(place);
    else this.sharpen(place);
  }

  private home(): void {
    this.stage.frame();
    this.writeState();
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
    this.frame.hintAt(tool);
    if (tool !== 'pin') this.pinsPanel.ask(null);
    this.setMeasured([]);
    if (tool === 'measure') this.frame.say(strings.measure.first);
  }

  private measure(place: Place): void {
    this.setMeasured(this.measured.length === 2 ? [place] : [...this.measured, place]);
    if (this.measured.length === 1) this.frame.say(strings.measure.second);
  }

  private setMeasured(places: Place[]): void {
    this.measured = places;
    const [a, b] = places.map((place) => this.stage.locate(place));
    const distance = a && b ? a.distanceTo(b) : null;
    this.marks.setMeasured(places, distance);
    if (distance !== null) this.frame.say(`${strings.measure.heading}: ${strings.measure.result(distance)}, ${strings.measure.straight}`);
  }

  private goTo(pin: Pin): void {
    if (!this.info) return;
    this.stage.face(pin);
    this.writeState();
  }

  // What is kept at the node

  private async keepPins(pins: Pin[]): Promise<void> {
    this.state.pins = pins;
    this.showPins();
    this.writeState();
    await this.sidecar.save({ pins }, false);
  }

  private takeSidecar(scan: string, sidecar: Sidecar | null): void {
    this.about.said(sidecar, this.mayChange);
    if (sidecar) {
      this.scans.said(scan, sidecar);
      this.state.pins = sidecar.pins;
    }
    this.showPins();
    this.writeState();
  }

  private showPins(): void {
    this.pinsPanel.show(this.state.pins, this.sidecar.isKept);
    this.marks.setPins(this.state.pins);
  }

  private async remove(): Promise<void> {
    const scan = this.info?.id;
    if (!scan) return;
    try {
      await deleteScan(scan);
    } catch (error) {
      this.frame.say(strings.failed((error as Error).message));
      return;
    }
    this.info = null;
    this.sidecar.close();
    this.stage.clear();
    this.about.hide();
    this.worth.hide();
    this.marks.setPins([]);
    this.setMeasured([]);
    this.state = { scan: null, camera: null, foveae: [], pins: [] };
    await this.refreshScans();
    this.tell({ kind: 'open', scan: 'latest' });
  }

  private async readWorth(scan: string): Promise<void> {
    const account = await readAccount(scan).catch(() => null);
    if (this.info?.id === scan) this.worth.show(account);
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

  /** Soon, and once for any number of calls: browsers take it slowly, and not too often. */
  private writeState(): void {
    this.writing ??= setTimeout(() => {
      this.writing = undefined;
      if (!this.info || this.sweep.isWatched) return;
      const fragment = formatState({ ...this.state, scan: this.info.id, camera: this.stage.placed });
      history.replaceState(null, '', `#${fragment}`);
    }, WRITE_MS);
  }

  private addressChanged(): void {
    this.state = parseState(location.hash.slice(1));
    this.info = null;
    this.tell({ kind: 'open', scan: this.state.scan ?? 'latest' });
  }
}
