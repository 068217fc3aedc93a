// The page: panels, picture and worker, and what passes between them.

import type { WebGLRenderer } from 'three';
import { deleteScan, deleteSweep, listCutSweeps, listScans, readAccount, readCapture, resumeSweep } from './api.ts';
import type { Sidecar } from './api.ts';
import { Comparison } from './comparison.ts';
import { saveCopy } from './copy.ts';
import type { Held } from './copy.ts';
import type { Answer, FromWorker, LinkState, ToWorker } from './link.ts';
import type { Measured, Measuring } from './measuring.ts';
import { Pane } from './pane.ts';
import { Pins } from './pins.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { OpenSidecar } from './sidecar.ts';
import { strings } from './strings.ts';
import { Sweep } from './sweep.ts';
import { AboutPanel } from './ui/about_panel.ts';
import { ComparePanel } from './ui/compare_panel.ts';
import { CostPanel } from './ui/cost_panel.ts';
import { DisplayPanel } from './ui/display_panel.ts';
import { Frame } from './ui/frame.ts';
import { LookPanel } from './ui/look_panel.ts';
import { MeasurePanel } from './ui/measure_panel.ts';
import { ScanList } from './ui/scan_list.ts';
import { ScannerPanel } from './ui/scanner_panel.ts';
import { kindOf } from './ui/tool_choice.ts';
import type { Tool } from './ui/tool_choice.ts';
import { WorthPanel } from './ui/worth_panel.ts';
import { formatState, parseState } from './url_state.ts';
import type { ViewState } from './url_state.ts';
import type { Place } from './view/room.ts';

const [CAPTURE_MS, LIST_MS, WRITE_MS] = [2000, 10_000, 200];
const NOWHERE: ViewState = { scan: null, camera: null, foveae: [], pins: [], beside: null };

export class App {
  private readonly frame: Frame;
  private readonly pane: Pane;
  /** What a point was added to last. */
  private latest: Measuring;
  private readonly comparison: Comparison;
  private readonly comparePanel: ComparePanel;
  private readonly scans: ScanList;
  private readonly scanner = new ScannerPanel(() => void this.sweep.start(), () => this.sweep.watch(), {
    resume: (id) => void this.sweep.start(() => resumeSweep(id)), drop: (id) => void this.dropSweep(id),
  });
  private readonly look = new LookPanel(() => this.sharpen(this.pane, this.pane.stage.sight.pickMiddle()), (tool) => this.toolChanged(tool));
  private readonly measurePanel = new MeasurePanel(() => this.latest.undo(), () => this.beginMeasuring());
  private readonly display: DisplayPanel;
  private readonly cost = new CostPanel();
  private readonly pins: Pins;
  private readonly worth = new WorthPanel();
  private readonly about: AboutPanel;
  private readonly sweep: Sweep;
  private readonly sidecar: OpenSidecar;

  private state = parseState(location.hash.slice(1));
  /** The scan to be opened next is what the address asks for. */
  private isAddressed = true;
  private mayChange = false;
  private node = '';
  private isCopyNamed = false;
  private writing: ReturnType<typeof setTimeout> | undefined;

  constructor(
    root: HTMLElement, private readonly worker: Worker, renderer: WebGLRenderer, poster: HTMLImageElement | null, hire: (scan: string) => Worker,
  ) {
    const say = (text: string) => this.frame.say(text);
    this.frame = new Frame(root, {
      retry: () => this.tell({ kind: 'retry' }), zoom: (steps) => this.pane.stage.zoom(steps), home: () => this.home(),
    });
    renderer.domElement.id = 'view';
    const shared = {
      say, options: () => this.look.options, home: () => this.home(), undone: () => this.latest.undo(), changed: () => this.writeState(),
      received: (bytes: number) => this.cost.traffic(bytes), updated: (answer: Answer) => this.cost.answered(answer),
      measured: (measured: Measured) => this.measured(measured), dropped: () => this.comparison.takeBack(),
    };
    this.pane = new Pane((message) => this.tell(message), renderer, {
      ...shared,
      opened: (info, fresh, framed) => this.opened(info, fresh, framed),
      missing: () => this.missing(),
      pressed: (place) => this.pressed(this.pane, place),
      clicked: (place) => this.clicked(this.pane, place),
      hovered: (place) => this.hovered(this.pane, place),
      moved: () => this.comparison?.moved(this.pane),
    }, document.documentElement);
    this.latest = this.pane.measuring;
    this.comparison = new Comparison(this.pane, this.frame.pictures, hire, {
      ...shared,
      pressed: (place) => this.pressed(this.comparison.picture!, place),
      clicked: (place) => this.clicked(this.comparison.picture!, place),
      hovered: (place) => this.hovered(this.comparison.picture!, place),
      changed: () => {
        if (!this.comparison.picture) this.latest = this.pane.measuring;
        this.showComparison();
        this.writeState();
      },
    });
    this.comparePanel = new ComparePanel({
      choose: (scan) => (scan ? this.comparison.open({ scan, camera: null, foveae: [] }) : this.comparison.close()),
      together: (on) => this.comparison.link(on),
      sharpenBoth: (on) => (this.comparison.moves.sharpenBoth = on),
      align: () => this.comparison.align(),
    });
    this.sweep = new Sweep(this.pane.stage, this.scanner, {
      say, watched: () => this.watched(), ended: (scan) => this.sweepEnded(scan), changed: () => void Promise.all([this.refreshCapture(), this.refreshCut()]),
    });
    this.sidecar = new OpenSidecar({ say, known: (scan, sidecar) => this.takeSidecar(scan, sidecar) });
    this.scans = new ScanList((id) => this.open(id), (scan) => this.tell({ kind: 'thumbnail', scan }));
    this.pins = new Pins(this.pane, this.sidecar, () => this.writeState());
    this.about = new AboutPanel((changes) => void this.sidecar.save(changes, true), (scan) => this.titleOf(scan),
      (scan) => void this.remove(scan), (named) => this.copy(named));
    this.display = new DisplayPanel(() => this.showAs());
    if (poster) this.pane.showMeanwhile(poster);
    this.frame.pictures.append(this.pane.element);
    this.frame.stage.append(this.display.legend);
    this.frame.showAfter(this.pane.pictured);
    void this.pane.pictured.then(() => this.frame.add(...[this.scans, this.scanner, this.look, this.measurePanel, this.comparePanel,
      this.display, this.pins.panel, this.worth, this.cost, this.about].map(({ element }) => element)));
    addEventListener('hashchange', ({ newURL }) => this.addressChanged(new URL(newURL).hash));
    addEventListener('online', () => this.tell({ kind: 'retry' }));
    worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.hear(data);
    addEventListener('focus', () => void this.refreshScans());
    setInterval(() => void this.refreshCapture(), CAPTURE_MS);
    setInterval(() => void this.refreshScans(), LIST_MS);
  }

  /** All pictures; the one of the open scan is the last. */
  private get panes(): Pane[] {
    return [this.comparison.picture, this.pane].filter((pane) => pane !== null);
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
        this.sweep.started(said.grid, this.pane.info === null && this.state.scan === null);
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
      case 'recorded':
        this.recorded(said.info, said.refinements);
        break;
      case 'thumbnail':
        this.scans.picture(said.scan, said.picture);
        break;
      default:
        this.pane.hear(said);
    }
  }

  private linked(link: LinkState): void {
    this.frame.linked(link);
    if (link.state === 'connecting' || link.state === 'out') return;
    if (link.state === 'ready') {
      this.node = link.node;
      this.allow(link.role !== 'view');
    }
    void this.pane.pictured.then(() => Promise.all([this.refreshScans(), this.refreshCapture()]));
  }

  /** Show what who looks may do, and nothing that the node would refuse. */
  private allow(mayChange: boolean): void {
    this.mayChange = mayChange;
    this.frame.allow(mayChange);
    this.scanner.allow(mayChange);
    this.look.tools.allow('pin', mayChange);
    this.pins.allow(mayChange);
  }

  private opened(info: ScanInfo, fresh: boolean, framed: boolean): void {
    this.sweep.leave();
    this.frame.showEmpty(null);
    if (!fresh) return;
    this.scans.mark(info.id);
    this.about.show(info);
    this.showComparison();
    if (framed) this.restoreState(info.id);
    void this.pane.pictured.then(() => this.readMore(info.id));
  }

  /** What the address asks for, when it is about this scan; else a clean view of it. */
  private restoreState(scan: string): void {
    const meant = this.state.scan === scan;
    const { camera, foveae, pins, beside } = meant ? this.state : NOWHERE;
    this.state = { ...NOWHERE, scan };
    if (camera) this.pane.stage.place(camera);
    this.beginMeasuring();
    this.pins.show(pins);
    this.pane.looks.all(foveae);
    if (this.isAddressed && beside) this.comparison.open(beside);
    else if (this.isAddressed || this.comparison.state?.scan === scan) this.comparison.close();
    this.writeState();
  }

  /** What was asked for is not there. No other scan takes its place: it might pass for the one that was meant. */
  private missing(): void {
    if (!this.state.scan && this.sweep.isWatched) return; // the first one is coming
    this.sweep.leave();
    this.close();
    this.frame.showEmpty(this.state.scan ? 'gone' : 'none');
    void this.refreshScans();
  }

  /** Show nothing of any scan. */
  private close(): void {
    this.sidecar.close();
    this.comparison.close();
    this.pane.clear();
    this.pins.show([]);
    this.about.hide();
    this.worth.hide();
    this.scans.mark(null);
    this.showComparison();
  }

  /** The picture shows a sweep: nothing that was marked on a scan belongs there. */
  private watched(): void {
    this.frame.showEmpty(null);
    this.comparison.close();
    this.pane.showMeanwhile(null);
    this.pane.marks.setPins([]);
    this.beginMeasuring();
  }

  private sweepEnded(scan: string | null): void {
    if (scan) this.open(scan);
    else if (this.pane.info) this.pane.restore();
  }

  // What people do

  private open(id: string): void {
    this.state = { ...NOWHERE, scan: id };
    this.isAddressed = false;
    this.pane.open(id);
  }

  private pressed(pane: Pane, place: Place): void {
    if (!this.sweep.isWatched && this.look.tools.tool === 'sharpen') this.comparison.lookAhead(pane, place);
  }

  private clicked(pane: Pane, place: Place | null): void {
    if (this.sweep.isWatched) return;
    const { tool } = this.look.tools;
    if (!place || !(kindOf(tool) || tool === 'pin')) return this.sharpen(pane, place);
    if (tool === 'pin') return pane === this.pane ? this.pins.panel.ask(place) : this.frame.say(strings.compare.pins);
    this.latest = pane.measuring;
    this.latest.add(place);
  }

  private sharpen(pane: Pane, place: Place | null): void {
    if (this.sweep.isWatched) return;
    if (place) this.comparison.sharpen(pane, place);
    else this.frame.say(strings.view.missed);
  }

  private hovered(pane: Pane, seek: () => Place | null): void {
    const place = this.look.follow && !this.sweep.isWatched ? seek() : null;
    if (place) this.comparison.sharpen(pane, place);
  }

  private home(): void {
    this.pane.stage.frame();
    this.writeState();
  }

  private toolChanged(tool: Tool): void {
    this.frame.hintAt(tool);
    if (tool !== 'pin') this.pins.panel.ask(null);
    for (const measuring of [...this.panes.map((pane) => pane.measuring), this.latest]) measuring.choose(kindOf(tool)); // the panel shows the last
    if (!kindOf(tool)) this.frame.say('');
  }

  /** Forget all points. */
  private beginMeasuring(): void {
    for (const pane of this.panes) pane.measuring.begin(kindOf(this.look.tools.tool) ?? 'distance');
  }

  private showAs(): void {
    const { shading, overlay } = this.display;
    for (const pane of this.panes) pane.stage.setLook(shading, overlay);
  }

  private showComparison(): void {
    const [open, beside] = [this.pane.info?.id ?? null, this.comparison.state?.scan ?? null];
    this.comparePanel.show(this.scans.scans, open, beside);
    this.frame.caption(this.titleOf(open), beside && this.titleOf(beside), () => this.comparison.close());
    this.showAs();
  }

  private titleOf(id: string | null): string {
    const scan = this.scans.scans.find((one) => one.id === id);
    return scan ? strings.scans.title(scan) : strings.scans.untitled;
  }

  private measured(measured: Measured): void {
    const isAsked = kindOf(this.look.tools.tool) !== null;
    this.measurePanel.show(measured, isAsked);
    if (measured.alongMm !== null) this.frame.say(strings.measure.said(measured));
    else if (isAsked && this.pane.info) this.frame.say(strings.measure.advice(measured, true));
  }

  // What is kept at the node

  private takeSidecar(scan: string, sidecar: Sidecar | null): void {
    this.about.said(sidecar, this.mayChange);
    if (sidecar) {
      this.scans.said(scan, sidecar);
      this.showComparison();
    }
    this.pins.show(sidecar?.pins ?? this.pins.list);
    this.writeState();
  }

  private async remove(scan: string): Promise<void> {
    try {
      await deleteScan(scan);
    } catch (error) {
      return this.frame.say(strings.failed((error as Error).message));
    }
    if (this.pane.info?.id !== scan) return void this.refreshScans();
    this.close();
    this.state = { ...NOWHERE };
    await this.refreshScans();
    this.frame.showEmpty(this.scans.scans.length ? 'gone' : 'none'); // another one might pass for the one that was meant
  }

  private async readMore(scan: string): Promise<void> {
    if (this.pane.info?.id !== scan) return;
    void this.sidecar.open(scan);
    const account = await readAccount(scan).catch(() => null);
    if (this.pane.info?.id === scan) this.worth.show(account);
  }

  private async refreshScans(): Promise<void> {
    void this.refreshCut();
    const shown = this.panes.map((pane) => ({ pane, id: pane.info?.id }));
    try {
      if (this.scans.show(await listScans())) this.showComparison();
    } catch {
      return; // the line above the picture says why
    }
    if (this.sweep.isWatched) return;
    const listed = new Set(this.scans.scans.map(({ id }) => id));
    for (const { pane, id } of shown) if (id && id === pane.info?.id && !listed.has(id)) pane.open(id); // the node will say that it is gone
  }

  private async refreshCapture(): Promise<void> {
    const wasAwaited = this.sweep.isAwaited; // what was asked before the sweep was tells nothing of it
    try {
      const capture = await readCapture();
      this.scanner.show(capture);
      if (wasAwaited) this.sweep.heard(capture);
    } catch {
      return; // likewise
    }
  }

  private async refreshCut(): Promise<void> {
    try {
      this.scanner.cut.show(await listCutSweeps());
    } catch {
      return; // likewise
    }
  }

  private async dropSweep(id: string): Promise<void> {
    try {
      await deleteSweep(id);
      this.frame.say(strings.cut.dropped);
    } catch (error) {
      this.frame.say(strings.failed((error as Error).message));
    }
    await this.refreshCut();
  }

  // An offline copy

  private copy(named: boolean): void {
    this.isCopyNamed = named;
    this.frame.say(strings.copy.making);
    this.tell({ kind: 'record' });
  }

  private recorded(info: ScanInfo, refinements: Uint8Array | null): void {
    const scan = this.scans.scans.find(({ id }) => id === info.id);
    const { shading, overlay } = this.display;
    const view = formatState({ scan: info.id, camera: this.pane.stage.placed, foveae: this.pane.looks.foveae, pins: this.pins.list, beside: null });
    const held: Held = {
      info, view, shading, overlay, made: new Date().toISOString(), swept: scan?.created ?? null, node: this.node,
      about: this.isCopyNamed && scan ? strings.scans.about(scan) : '',
    };
    void saveCopy(held, refinements, (text) => this.frame.say(text));
  }

  // The address

  /** Soon, and once for any number of calls: browsers take it slowly, and not too often. */
  private writeState(): void {
    this.writing ??= setTimeout(() => {
      this.writing = undefined;
      const { info, looks, stage } = this.pane;
      if (!info || this.sweep.isWatched) return;
      const fragment = formatState({ ...this.state, scan: info.id, camera: stage.placed, foveae: looks.foveae, pins: this.pins.list, beside: this.comparison.state });
      history.replaceState(null, '', `#${fragment}`);
    }, WRITE_MS);
  }

  /** fragment: as it was typed; `writeState` may have written over it before we were told. */
  private addressChanged(fragment: string): void {
    this.state = parseState(fragment.slice(1));
    this.isAddressed = true;
    this.pane.open(this.state.scan ?? 'latest');
  }
}
