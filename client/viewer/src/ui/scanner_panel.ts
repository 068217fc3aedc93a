import type { Capture } from '../api.ts';
import { strings } from '../strings.ts';
import { CutSweeps } from './cut_sweeps.ts';
import type { CutSweepEvents } from './cut_sweeps.ts';
import { h, section } from './dom.ts';

/** What the scanner does, and the button that makes it sweep. */
export class ScannerPanel {
  readonly element: HTMLElement;
  readonly cut: CutSweeps;
  private readonly phase = h('p', { class: 'quiet' });
  private readonly progress = h('progress', { max: 100, 'aria-label': strings.scanner.progress, hidden: true });
  private readonly button: HTMLButtonElement;
  private readonly watch: HTMLButtonElement;
  private readonly mayNot = h('p', { class: 'quiet', hidden: true }, strings.role);

  constructor(start: () => void, watch: () => void, cut: CutSweepEvents) {
    this.cut = new CutSweeps(cut);
    this.watch = h('button', { type: 'button', class: 'secondary', hidden: true, click: watch }, strings.scanner.watch);
    this.button = h('button', { type: 'button', click: start }, strings.scanner.start);
    this.element = section(strings.scanner.heading, true, this.phase, this.progress, this.watch, this.button,
      this.cut.element, this.mayNot);
  }

  /** Whether who looks at the page may start sweeps. */
  allow(allowed: boolean): void {
    this.button.hidden = !allowed;
    this.mayNot.hidden = allowed;
    this.cut.allow(allowed);
  }

  show(capture: Capture): void {
    const text = strings.scanner.phases[capture.phase] ?? capture.phase;
    const isReady = capture.phase === 'ready';
    this.phase.textContent = !capture.why || capture.phase === 'sweeping' ? text
      : isReady ? strings.scanner.trouble(text, capture.why) : `${text}: ${capture.why}`;
    this.button.disabled = !isReady;
    this.cut.ready(isReady);
    if (capture.phase !== 'sweeping') this.progress.hidden = true;
  }

  sweeping(percent: number, secondsLeft: number | null): void {
    this.button.disabled = true;
    this.cut.ready(false);
    this.progress.hidden = false;
    this.progress.value = percent;
    this.phase.textContent = strings.view.live(percent, secondsLeft);
  }

  /** A sweep runs that the picture does not show. */
  offer(offered: boolean): void {
    this.watch.hidden = !offered;
  }

  ended(): void {
    this.watch.hidden = this.progress.hidden = true;
  }
}
