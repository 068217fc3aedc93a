import uPlot from 'uplot';
import type { Answer } from '../link.ts';
import { strings } from '../strings.ts';
import { h, section } from './dom.ts';

const SECONDS = 60;
const ANSWERS_MAX = 200;
const CHART_HEIGHT = 110;

/** Bytes, bandwidth and quality over time. */
export class CostPanel {
  readonly element: HTMLDetailsElement;
  private readonly received = h('dd', { id: 'received' }, strings.bytes(0));
  private readonly last = h('dd', { id: 'last-update' }, strings.cost.none);
  private readonly reached = h('dd', { id: 'reached' }, strings.cost.none);
  private readonly perSecond = new Array<number>(SECONDS).fill(0);
  private readonly qualities: [number, number][] = [];
  private readonly charts: [HTMLElement, HTMLElement] = [h('div', {}), h('div', {})];
  private plots: [uPlot, uPlot] | null = null;
  private total = 0;
  private counted = 0;
  private inView = false;
  private ticked = false;

  constructor() {
    const { cost } = strings;
    this.element = section(cost.heading, true,
      h('dl', {}, h('dt', {}, cost.received), this.received, h('dt', {}, cost.last), this.last, h('dt', {}, cost.reached), this.reached),
      h('figure', {}, h('figcaption', {}, cost.bandwidth), this.charts[0]),
      h('figure', {}, h('figcaption', {}, cost.chartQuality), this.charts[1]),
    );
    setInterval(() => this.tick(), 1000);
    new IntersectionObserver(([entry]) => this.seen(entry!.isIntersecting)).observe(this.charts[0]);
    new ResizeObserver(() => this.resize()).observe(this.charts[0]);
  }

  /** So many bytes more have come. */
  traffic(bytes: number): void {
    this.total += bytes;
    this.received.textContent = strings.bytes(this.total);
  }

  answered({ bytes, elapsedMs, reason, textureDb, errorMaxMm }: Answer): void {
    const limited = reason === 'byte limit' ? `, ${strings.cost.limited}` : '';
    this.last.textContent = strings.cost.answer(strings.bytes(bytes), elapsedMs) + limited;
    this.reached.textContent = strings.cost.quality(textureDb, errorMaxMm);
    if (textureDb === null) return;
    this.qualities.push([performance.now() / 1000, Math.min(textureDb, 99)]);
    if (this.qualities.length > ANSWERS_MAX) this.qualities.shift();
  }

  /** Charts are drawn while they are in view; not before the first second is over, which belongs to the picture. */
  private seen(inView: boolean): void {
    this.inView = inView;
    if (inView && this.ticked) this.draw();
  }

  private tick(): void {
    this.ticked = true;
    this.perSecond.shift();
    this.perSecond.push((this.total - this.counted) / 1000);
    this.counted = this.total;
    if (this.inView) this.draw();
  }

  /** The charts; made when they are first seen, since that takes a while. */
  private plot(): [uPlot, uPlot] {
    const { cost } = strings;
    const colour = getComputedStyle(this.element).getPropertyValue('--pico-primary').trim() || '#06c';
    const ink = getComputedStyle(this.element).getPropertyValue('--quiet').trim() || '#777';
    const axes = [{ stroke: ink, grid: { show: false }, size: 26 }, { stroke: ink, size: 44, grid: { stroke: ink, width: 0.2 } }];
    const options = (label: string, series: Partial<uPlot.Series>): uPlot.Options => ({
      width: this.charts[0].clientWidth, height: CHART_HEIGHT, legend: { show: false }, cursor: { show: false },
      scales: { x: { time: false } }, axes: [axes[0]!, { ...axes[1]!, label: '' }], series: [{}, { label, stroke: colour, width: 1.5, ...series }],
    });
    return [
      new uPlot({ ...options(cost.kilobytes, { fill: `${colour}33`, points: { show: false } }), scales: { x: { time: false }, y: { range: (_u, _min, max) => [0, Math.max(max, 10)] } } }, [[], []], this.charts[0]),
      new uPlot({ ...options(cost.decibel, { points: { show: true, size: 6 } }), scales: { x: { time: false, range: () => [1 - SECONDS, 0] }, y: { range: [20, 60] } } }, [[], []], this.charts[1]),
    ];
  }

  private draw(): void {
    this.plots ??= this.plot();
    this.plots[0].setData([this.perSecond.map((_, index) => index - SECONDS + 1), this.perSecond]);
    this.plots[1].setData([this.qualities.map(([at]) => at - performance.now() / 1000), this.qualities.map(([, db]) => Math.min(db, 60))]);
  }

  private resize(): void {
    const width = this.charts[0].clientWidth;
    if (width) this.plots?.forEach((plot) => plot.setSize({ width, height: CHART_HEIGHT }));
  }
}
