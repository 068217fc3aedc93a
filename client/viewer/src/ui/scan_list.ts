import type { ScanSummary, Sidecar } from '../api.ts';
import { strings } from '../strings.ts';
import { h, refill, section } from './dom.ts';

/** The scans of the node, newest first, each with a small picture. */
export class ScanList {
  readonly element: HTMLElement;
  private readonly list = h('ul', { class: 'scans' });
  /** Of scans that have been in view: where their picture is, '' until it comes. */
  private readonly pictures = new Map<string, string>();
  private readonly images = new Map<string, HTMLImageElement>();
  private readonly inView = new IntersectionObserver((entries) => this.seen(entries));
  scans: ScanSummary[] = [];
  private current: string | null = null;
  /** To be filled anew, even with the same scans. */
  private isStale = true;

  constructor(private readonly open: (id: string) => void, private readonly wantPicture: (id: string) => void) {
    this.element = section(strings.scans.heading, true, this.list);
  }

  /** Whether it is another list than before. */
  show(scans: ScanSummary[]): boolean {
    const isOther = this.isStale || JSON.stringify(scans) !== JSON.stringify(this.scans);
    this.scans = scans;
    if (isOther) this.fill();
    return isOther;
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

  /** A picture has come; null: ask again when the list is next filled. */
  picture(id: string, picture: Blob | null): void {
    if (!picture) {
      this.pictures.delete(id);
      this.isStale = true;
      return;
    }
    const address = URL.createObjectURL(picture);
    this.pictures.set(id, address);
    this.images.get(id)?.setAttribute('src', address);
  }

  private seen(entries: IntersectionObserverEntry[]): void {
    for (const { target, isIntersecting } of entries) {
      const id = (target as HTMLElement).dataset['scan']!;
      if (!isIntersecting || this.pictures.has(id)) continue;
      this.pictures.set(id, '');
      this.wantPicture(id);
    }
  }

  private fill(): void {
    this.isStale = false;
    this.images.clear();
    this.inView.disconnect();
    const focused = (document.activeElement as HTMLElement | null)?.dataset['scan'];
    refill(this.list, ...(this.scans.length ? this.scans.map((scan) => this.item(scan)) : [h('li', {}, strings.scans.none)]));
    if (focused) this.list.querySelector<HTMLElement>(`[data-scan="${focused}"]`)?.focus();
  }

  private item(scan: ScanSummary): HTMLLIElement {
    const image = h('img', { alt: '', src: this.pictures.get(scan.id) || null });
    this.images.set(scan.id, image);
    const site = strings.scans.site(scan.subject ?? '', scan.bodySite ?? '');
    const text = h('span', {},
      h('strong', {}, scan.name || strings.scans.untitled),
      site ? h('span', {}, site) : null,
      h('small', {}, h('time', { datetime: new Date(1000 * scan.created).toISOString() }, strings.scans.when(scan.created))),
    );
    const current = scan.id === this.current;
    const attributes = { type: 'button', 'data-scan': scan.id, 'aria-current': current ? 'true' : null, click: () => this.open(scan.id) };
    const button = h('button', attributes, image, text);
    this.inView.observe(button);
    return h('li', {}, button);
  }
}
