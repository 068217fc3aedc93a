// The page: panels, picture and worker, and what passes between them.

import { deleteScan, listScans, readAccount, readCapture } from './api.ts';
import type { Sidecar } from './api.ts';
import type { FromWorker, LinkState, ToWorker } from './link.ts';
import { Measuring } from './measuring.ts';
import { Pane } from './pane.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { OpenSidecar } from './sidecar.ts';
import { strings } from './strings.ts';
import { Sweep } from './sweep.ts';
import { AboutPanel } from './ui/about_panel.ts';
import { CostPanel } from './ui/cost_panel.ts';
import { DisplayPanel } from './ui/display_panel.ts';
import { Frame } from './ui/frame.ts';
import { LookPanel } from './ui/look_panel.ts';
import type { Tool } from './ui/look_panel.ts';
import { PinsPanel } from './ui/pins_panel.ts';
import { ScanList } from './ui/scan_list.ts';
import { ScannerPanel } from './ui/scanner_panel.ts';
import { WorthPanel } from './ui/worth_panel.ts';
import { formatState, parseState } from './url_state.ts';
import type { Pin, ViewState } from './url_state.ts';
import type { Place } from './view/room.ts';

const CAPTURE_MS = 2000;
const WRITE_MS = 200;
const NOWHERE: ViewState = { scan: null, camera: null, foveae: [], pins: [] };

export class App {
  private readonly frame: Frame;
  private readonly pane: Pane;
  private readonly measuring: Measuring;
  private readonly scans: ScanList;
  private readonly scanner = new ScannerPanel(() => void this.sweep.start(), () => this.sweep.watch());
  private readonly look = new LookPanel(() => this.sharpen(this.pane.stage.pickMiddle()), (tool) => this.toolChanged(tool));
  private readonly display: DisplayPanel;
  private readonly cost = new CostPanel();
  private readonly pinsPanel: PinsPanel;
  private readonly worth = new WorthPanel();
  private readonly about: AboutPanel;
  private readonly sweep: Sweep;
  private readonly sidecar: OpenSidecar;

  private state = parseState(location.hash.slice(1));
  private mayChange = false;
  private writing: ReturnType<typeof setTimeout> | undefined;

  constructor(
    root: HTMLElement, private readonly worker: Worker, canvas: HTMLCanvasElement, context: WebGL2RenderingContext,
  ) {
    const say = (text: string) => this.frame.say(text);
    this.frame = new Frame(root, {
      retry: () => this.tell({ kind: 'retry' }), zoom: (steps) => this.pane.stage.zoom(steps), home: () => this.home(),
    });
    canvas.id = 'view';
    this.pane = new Pane(worker, canvas, context, () => this.look.options, {
      say,
      opened: (info, fresh, framed) => this.opened(info, fresh, framed),
      updated: (answer) => this.cost.answered(answer),
      missing: () => this.missing(),
      clicked: (place) => this.clicked(place),
      hovered: (place) => this.hovered(place),
      home: () => this.home(),
      changed: () => this.writeState(),
    }, document.documentElement);
    this.measuring = new Measuring(this.pane.stage, this.pane.marks, say);
    this.sweep = new Sweep(this.pane.stage, this.scanner, {
      say, watched: () => this.watched(), ended: (scan) => this.sweepEnded(scan), changed: () => void this.refreshCapture(),
    });
    this.sidecar = new OpenSidecar({ say, known: (scan, sidecar) => this.takeSidecar(scan, sidecar) });
    this.scans = new ScanList((id) => this.open(id), (scan) => this.tell({ kind: 'thumbnail', scan }));
    this.pinsPanel = new PinsPanel((pin) => void this.keepPins([...this.state.pins, pin]),
      (index) => void this.keepPins(this.state.pins.filter((_, at) => at !== index)), (pin) => this.goTo(pin));
    this.about = new AboutPanel((changes) => void this.sidecar.save(changes, true), () => void this.remove());
    this.display = new DisplayPanel((shading, overlay) => this.pane.stage.setLook(shading, overlay));
    this.frame.pictures.append(this.pane.element);
    this.frame.stage.append(this.display.legend);
    this.frame.add(this.scans.element, this.scanner.element, this.look.element, this.display.element, this.pinsPanel.element,
      this.worth.element, this.cost.element, this.about.element);
    addEventListener('hashchange', () => this.addressChanged());
    addEventListener('online', () => this.tell({ kind: 'retry' }));
    worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.hear(data);
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
      case 'published':
        void this.refreshScans();
        break;
      case 'liveStarted':
        this.sweep.started(said.grid, this.pane.info === null);
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
        this.scans.picture(said.scan, said.picture);
        break;
      case 'traffic':
        this.cost.traffic(said.received);
        break;
      default:
        this.pane.hear(said);
    }
  }

  private linked(link: LinkState): void {
    this.frame.linked(link);
    if (link.state === 'connecting') return;
    if (link.state === 'ready') this.allow(link.role !== 'view');
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

  private opened(info: ScanInfo, fresh: boolean, framed: boolean): void {
    this.sweep.leave();
    this.frame.showEmpty(false);
    if (!fresh) return;
    this.scans.mark(info.id);
    this.about.show(info);
    if (framed) this.restoreState(info.id);
    void this.sidecar.open(info.id);
    void this.readWorth(info.id);
  }

  /** What the address asks for, when it is about this scan; else a clean view of it. */
  private restoreState(scan: string): void {
    const meant = this.state.scan === scan;
    const { camera, foveae, pins } = meant ? this.state : NOWHERE;
    this.state = { ...NOWHERE, scan, pins };
    if (camera) this.pane.stage.place(camera);
    this.measuring.clear();
    this.showPins();
    this.pane.sharpenAll(foveae);
    this.writeState();
  }

  /** The scan that was asked for is gone: show another one, if there is any. */
  private missing(): void {
    this.frame.showEmpty(this.pane.info === null);
    if (this.state.scan && !this.pane.info) this.pane.open('latest');
    this.state.scan = null;
  }

  /** The picture shows a sweep: nothing that was marked on a scan belongs there. */
  private watched(): void {
    this.frame.showEmpty(false);
    this.pane.marks.setPins([]);
    this.measuring.clear();
  }

  private sweepEnded(scan: string | null): void {
    if (scan) this.open(scan);
    else if (this.pane.info) this.pane.restore();
  }

  // What people do

  private open(id: string): void {
    this.state = { ...NOWHERE, scan: id };
    this.pane.open(id);
  }

  private clicked(place: Place | null): void {
    if (this.sweep.isWatched) return;
    const { tool } = this.look;
    if (place && tool === 'measure') this.measuring.add(place);
    else if (place && tool === 'pin') this.pinsPanel.ask(place);
    else this.sharpen(place);
  }

  private sharpen(place: Place | null): void {
    if (this.sweep.isWatched) return;
    if (place) this.pane.sharpen(place);
    else this.frame.say(strings.view.missed);
  }

  private hovered(seek: () => Place | null): void {
    const place = this.look.follow && !this.sweep.isWatched ? seek() : null;
    if (place) this.pane.sharpen(place);
  }

  private home(): void {
    this.pane.stage.frame();
    this.writeState();
  }

  private toolChanged(tool: Tool): void {
    this.frame.hintAt(tool);
    if (tool !== 'pin') this.pinsPanel.ask(null);
    this.measuring.clear();
    if (tool === 'measure') this.frame.say(strings.measure.first);
  }

  private goTo(pin: Pin): void {
    if (!this.pane.info) return;
    this.pane.stage.face(pin);
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
    this.pane.marks.setPins(this.state.pins);
  }

  private async remove(): Promise<void> {
    const scan = this.pane.info?.id;
    if (!scan) return;
    try {
      await deleteScan(scan);
    } catch (error) {
      this.frame.say(strings.failed((error as Error).message));
      return;
    }
    this.sidecar.close();
    this.pane.clear();
    this.measuring.clear();
    this.about.hide();
    this.worth.hide();
    this.state = { ...NOWHERE };
    await this.refreshScans();
    this.pane.open('latest');
  }

  private async readWorth(scan: string): Promise<void> {
    const account = await readAccount(scan).catch(() => null);
    if (this.pane.info?.id === scan) this.worth.show(account);
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
      const { info, foveae, stage } = this.pane;
      if (!info || this.sweep.isWatched) return;
      const fragment = formatState({ ...this.state, scan: info.id, camera: stage.placed, foveae });
      history.replaceState(null, '', `#${fragment}`);
    }, WRITE_MS);
  }

  private addressChanged(): void {
    this.state = parseState(location.hash.slice(1));
    this.pane.open(this.state.scan ?? 'latest');
  }
}
