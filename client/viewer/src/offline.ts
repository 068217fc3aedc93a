// What an offline copy of a view does: shows what it holds, measures on it, and says what it is.

import { bytesOf, HELD, REFINEMENTS, WASM, WORKER } from './copy.ts';
import type { Held } from './copy.ts';
import { CONTEXT } from './link.ts';
import type { ToWorker } from './link.ts';
import type { Measured } from './measuring.ts';
import { Pane } from './pane.ts';
import type { OfScan } from './pane.ts';
import { strings } from './strings.ts';
import { DisplayPanel } from './ui/display_panel.ts';
import { h, section } from './ui/dom.ts';
import { Frame } from './ui/frame.ts';
import { MeasurePanel } from './ui/measure_panel.ts';
import { PinsPanel } from './ui/pins_panel.ts';
import { kindOf, ToolChoice } from './ui/tool_choice.ts';
import { parseState } from './url_state.ts';
import type { ViewState } from './url_state.ts';
import { rendererOf } from './view/renderer.ts';

export class OfflineCopy {
  private readonly held = JSON.parse(textOf(HELD)) as Held;
  private readonly view: ViewState = parseState(this.held.view);
  private readonly frame: Frame;
  private readonly pane: Pane;
  private readonly tools = new ToolChoice(['turn', 'measure', 'path'], () => this.toolChanged());
  private readonly measurePanel = new MeasurePanel(() => this.pane.measuring.undo(), () => this.pane.measuring.clear());
  private readonly display: DisplayPanel;

  constructor(root: HTMLElement, canvas: HTMLCanvasElement, context: WebGL2RenderingContext) {
    const { held, view } = this;
    const script = new Blob([textOf(WORKER)], { type: 'text/javascript' });
    const worker = new Worker(URL.createObjectURL(script)); // a module could not be had from a file
    worker.onerror = () => this.frame.say(strings.copy.broken);
    const tell = (message: ToWorker, transfer: Transferable[] = []) => worker.postMessage(message, transfer);
    const nothing = () => undefined;
    this.frame = new Frame(root, { retry: nothing, zoom: (steps) => this.pane.stage.zoom(steps), home: () => this.pane.stage.frame() });
    this.frame.offline(strings.copy.said(held));
    this.frame.hintAt('turn');
    canvas.id = 'view';
    this.pane = new Pane(tell, rendererOf(canvas, context), {
      say: (text) => this.frame.say(text),
      clicked: (place) => {
        if (place && kindOf(this.tools.tool)) this.pane.measuring.add(place);
      },
      opened: (_info, fresh) => {
        if (!fresh) return;
        if (view.camera) this.pane.stage.place(view.camera);
        this.pane.marks.setPins(view.pins);
      },
      home: () => this.pane.stage.frame(),
      measured: (measured) => this.measured(measured),
      undone: () => this.pane.measuring.undo(),
      options: () => ({ window: 0, textureDb: 0, rangeMm: 0 }), // nobody is asked
      pressed: nothing, dropped: nothing, hovered: nothing, moved: nothing, changed: nothing, updated: nothing, received: nothing, missing: nothing,
    }, document.documentElement);
    this.display = new DisplayPanel(() => this.pane.stage.setLook(this.display.shading, this.display.overlay), held.shading, held.overlay);
    this.pane.stage.setLook(held.shading, held.overlay);
    const pins = new PinsPanel(nothing, nothing, (pin) => this.pane.stage.face(pin));
    pins.allow(false);
    pins.show(view.pins, true);
    this.frame.pictures.append(this.pane.element);
    this.frame.stage.append(this.display.legend);
    this.frame.add(section(strings.copy.heading, true, h('p', {}, strings.copy.explain),
      h('dl', {}, ...strings.copy.figures(held, view.foveae.length).flatMap(([name, figure]) => [h('dt', {}, name), h('dd', {}, figure)]))),
      section(strings.copy.tools, true, this.tools.element), this.measurePanel.element, this.display.element, pins.element);
    worker.onmessage = ({ data }: MessageEvent<OfScan>) => this.pane.hear(data);
    const wasm = bytesOf(textOf(WASM)).buffer;
    const refinements = bytesOf(textOf(REFINEMENTS));
    tell({ kind: 'replay', info: held.info, refinements, wasm }, [wasm, refinements.buffer]);
  }

  private toolChanged(): void {
    const { tool } = this.tools;
    this.frame.hintAt(tool);
    this.pane.measuring.choose(kindOf(tool));
  }

  private measured(measured: Measured): void {
    const isAsked = kindOf(this.tools.tool) !== null;
    this.measurePanel.show(measured, isAsked);
    if (isAsked && measured.alongMm !== null) this.frame.say(strings.measure.said(measured));
  }
}

/** Whether this page is a copy. */
export const isCopy = (): boolean => document.getElementById(HELD) !== null;

/** Show the copy that this page is. */
export function showCopy(root: HTMLElement): void {
  const canvas = document.createElement('canvas');
  const context = canvas.getContext('webgl2', CONTEXT);
  root.replaceChildren(); // what it says if a part of it is missing, this script among it
  if (context) new OfflineCopy(root, canvas, context);
  else root.replaceChildren(h('main', { class: 'sorry' }, h('p', {}, strings.noWebgl)));
}

const textOf = (id: string): string => document.getElementById(id)!.textContent!;
