// A sweep that runs, and whether the picture shows it.

import { startSweep } from './api.ts';
import type { Capture } from './api.ts';
import type { Snapshot } from './link.ts';
import { thinned } from './live_picture.ts';
import { blocksAcross, blocksDown, RANGE, TEXTURE } from './protocol/lattice.ts';
import { channelShapes } from './protocol/messages.ts';
import type { ScanInfo } from './protocol/messages.ts';
import { strings } from './strings.ts';
import type { ScannerPanel } from './ui/scanner_panel.ts';
import type { Stage } from './view/stage.ts';

const RADIUS_SHARE = 0.42;

export interface SweepEvents {
  say(text: string): void;
  /** The picture is the sweep's from now on. */
  watched(): void;
  /** It became a scan, or not, while the picture showed it. */
  ended(scan: string | null): void;
  /** The scanner does something else now. */
  changed(): void;
}

export class Sweep {
  /** The one that runs; the same in `watched` while the picture shows it. */
  private running: ScanInfo | null = null;
  private watched: ScanInfo | null = null;
  private startedHere = false;
  /** We asked for one, were not refused, and have heard nothing of it yet. */
  isAwaited = false;

  constructor(private readonly stage: Stage, private readonly panel: ScannerPanel, private readonly events: SweepEvents) {}

  /** Whether the picture shows it. */
  get isWatched(): boolean {
    return this.watched !== null;
  }

  /** Have the scanner sweep; we shall want to see it. ask: the request, unless it is for a new one. */
  async start(ask: () => Promise<unknown> = startSweep): Promise<void> {
    this.startedHere = true;
    try {
      await ask();
      this.isAwaited = true;
      this.events.say(strings.scanner.started);
    } catch (error) {
      this.startedHere = false;
      this.events.say(strings.failed((error as Error).message));
    }
    this.events.changed();
  }

  /** What the scanner did after the sweep that is awaited was asked for: it may not even have begun. */
  heard({ phase, why }: Capture): void {
    if (!this.isAwaited || phase === 'starting' || phase === 'sweeping') return;
    this.isAwaited = false;
    if (!why) return;
    this.startedHere = false;
    this.events.say(strings.scanner.failed(why));
  }

  /** A sweep runs. It takes the picture of whoever started it, or sees nothing else; others are asked. */
  started(grid: ScanInfo, nothingElse: boolean): void {
    this.running = grid;
    this.isAwaited = false;
    document.documentElement.dataset['live'] = 'offered';
    if (this.startedHere || nothingElse) this.watch();
    else this.panel.offer(true);
  }

  /** Show it. */
  watch(): void {
    const grid = this.running;
    if (!grid) return;
    this.watched = grid;
    this.panel.offer(false);
    this.stage.show(emptyPicture(thinned(grid)), false);
    this.stage.frameEmpty(grid.height * grid.pitchMm * RADIUS_SHARE);
    this.events.watched();
    document.documentElement.dataset['live'] = 'yes';
  }

  /** Let go of the picture: a scan is shown. */
  leave(): void {
    if (this.watched) this.panel.offer(true);
    this.watched = null;
  }

  progress(percent: number, secondsLeft: number | null): void {
    this.panel.sweeping(percent, secondsLeft);
    if (this.watched) this.events.say(strings.view.live(percent, secondsLeft));
  }

  picture(steps: Uint16Array, texels: Uint8Array): void {
    if (this.watched) this.stage.replace(steps, texels);
  }

  /** scan: what it became, or null; then `why` says what was in its way. */
  ended(scan: string | null, why: string): void {
    document.documentElement.dataset['live'] = 'no';
    const showing = this.isWatched;
    this.running = this.watched = null;
    this.startedHere = this.isAwaited = false;
    this.panel.ended();
    this.events.changed();
    this.events.say(scan ? strings.scanner.done : strings.scanner.interrupted(why));
    if (showing) this.events.ended(scan);
  }
}

function emptyPicture(info: ScanInfo): Snapshot {
  const levels = Object.values(channelShapes(info)).map((shape) => new Uint8Array(blocksAcross(shape) * blocksDown(shape)));
  return {
    info, steps: new Uint16Array(info.width * info.height),
    coarseTexels: new Uint8Array(4 * info.coarseTextureWidth * info.coarseTextureHeight), levels: [levels[RANGE]!, levels[TEXTURE]!],
  };
}
