import type { ScanSummary, Sidecar } from '../api.ts';
import { strings } from '../strings.ts';
import { h, refill, section } from './dom.ts';

type Picture = { side: number; pixels: Uint8ClampedArray<ArrayBuffer> };

/** The scans of the node, newest first, each with a small picture. */
export class ScanList {
  readonly element: HTMLElement;
  private readonly list = h('ul', { class: 'scans' });
  private readonly pictures = new Map<string, Picture>();
  private readonly canvases = new Map<string, HTMLCanvasElement>();
  private scans: ScanSummary[] = [];
  private current: string | null = null;

  constructor(private readonly open: (id: string) => void, private readonly wantPicture: (id: string) => void) {
    this.element = section(strings.scans.heading, true, this.list);
  }

  show(scans: ScanSummary[]): void {
    this.scans = scans;
    for (const { id } of scans) if (!this.pictures.has(id)) this.wantPicture(id);
    this.fill();
  }

  mark(id: string | null): void {
    this.current = id;
    this.fill();
  }

  /** Something is said of a scan now. */
  said(id: string, { name, subject, body_site: bodySite }: Sidecar): void {
    this.scans = this.scans.map((scan) => (scan.id === id ? { ...scan, name: name ?? scan.name ?? null, subject, bodySite } : scan));
    this.fill();
  }

  picture(id: string, picture: Picture): void {
    this.pictures.set(id, picture);
    const canvas = this.canvases.get(id);
    if (canvas) paint(canvas, picture);
  }

  private fill(): void {
    this.canvases.clear();
    const focused = (document.activeElement as HTMLElement | null)?.dataset['scan'];
    refill(this.list, ...(this.scans.length ? this.scans.map((scan) => this.item(scan)) : [h('li', {}, strings.scans.none)]));
    if (focused) this.list.querySelector<HTMLElement>(`[data-scan="${focused}"]`)?.focus();
  }

  private item(scan: ScanSummary): HTMLLIElement {
    const canvas = h('canvas', { width: 96, height: 96, 'aria-hidden': 'true' });
    this.canvases.set(scan.id, canvas);
    const picture = this.pictures.get(scan.id);
    if (picture) paint(canvas, picture);
    const site = strings.scans.site(scan.subject ?? '', scan.bodySite ?? '');
    const text = h('span', {},
      h('strong', {}, scan.name || strings.scans.untitled),
      site ? h('span', {}, site) : null,
      h('small', {}, h('time', { datetime: new Date(1000 * scan.created).toISOString() }, when(scan.created))),
    );
    const current = scan.id === this.current;
    const attributes = { type: 'button', 'data-scan': scan.id, 'aria-current': current ? 'true' : null, click: () => this.open(scan.id) };
    return h('li', {}, h('button', attributes, canvas, text));
  }
}

/** By the processor: a small picture is not worth a context on the graphics card. */
function paint(canvas: HTMLCanvasElement, { side, pixels }: Picture): void {
  canvas.getContext('2d', { willReadFrequently: true })!.putImageData(new ImageData(pixels, side, side), 0, 0);
}

function when(unixS: number): string {
  return new Date(1000 * unixS).toLocaleString(undefined, { dateStyle: 'medium', timeStyle: 'short' });
}
