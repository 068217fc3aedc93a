import type { LinkState } from '../link.ts';
import { strings } from '../strings.ts';
import { AdminButton } from './admin_button.ts';
import { h, refill } from './dom.ts';

const NOTICE_MS = 6000;

export interface FrameActions {
  retry(): void;
  zoom(steps: number): void;
  home(): void;
}

/** What stands round the picture: title and state of the connection above, notices and zoom buttons on it, panels beside. */
export class Frame {
  readonly stage: HTMLElement;
  /** Where the pictures stand beside each other. */
  readonly pictures = h('div', { id: 'pictures' });
  private readonly captions = h('div', { id: 'captions', hidden: true });
  private readonly link = h('p', { id: 'link', role: 'status' }, strings.link.connecting);
  private readonly admin = new AdminButton();
  private readonly retry: HTMLButtonElement;
  private readonly notice = h('p', { id: 'notice', role: 'status' });
  private readonly hint = h('p', { id: 'hint' }, strings.view.hints.sharpen);
  private readonly empty = h('p', { id: 'empty', role: 'status', hidden: true });
  private readonly panel = h('aside', { id: 'panel' });
  /** What is said where there is no scan. */
  private none: string = strings.view.empty;
  private retryTimer: ReturnType<typeof setInterval> | undefined;
  private noticeTimer: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly root: HTMLElement, actions: FrameActions) {
    const button = (text: string, label: string, act: () => void) =>
      h('button', { type: 'button', class: 'secondary', 'aria-label': label, title: label, click: act }, text);
    const zoom = h('div', { id: 'zoom' },
      button('+', strings.view.zoomIn, () => actions.zoom(1)), button('−', strings.view.zoomOut, () => actions.zoom(-1)),
      button('⌂', strings.view.home, () => actions.home()));
    this.retry = h('button', { type: 'button', class: 'secondary', hidden: true, click: () => actions.retry() }, strings.link.again);
    this.stage = h('div', { id: 'stage' }, this.pictures, this.empty, this.notice, this.hint, zoom);
    root.append(
      h('header', {}, h('h1', {}, strings.title), h('div', {}, this.link, this.retry, this.admin.element)),
      h('main', {}, h('section', { id: 'views', 'aria-label': strings.view.label.split('.')[0]! }, this.captions, this.stage), this.panel),
    );
  }

  /** Show nothing but the picture until it stands: each time the browser puts more of the page together it would wait. */
  showAfter(pictured: Promise<void>): void {
    this.root.classList.add('early');
    void pictured.then(() => this.root.classList.remove('early'));
  }

  /** Put panels beside the picture. */
  add(...panels: HTMLElement[]): void {
    this.panel.append(...panels);
  }

  /** There is no connection, and never will be: what stands in its place. */
  offline(text: string): void {
    this.link.textContent = text;
    document.documentElement.dataset['link'] = 'none';
  }

  /** What the pictures beside each other show; nothing is written over a single one. */
  caption(open: string, beside: string | null, close: () => void): void {
    this.captions.hidden = beside === null;
    if (beside === null) return this.captions.replaceChildren();
    const { compare } = strings;
    const button = h('button', { type: 'button', class: 'secondary', 'aria-label': compare.close, title: compare.close, click: close }, '×');
    refill(this.captions, h('p', {}, open), h('p', {}, beside), button);
  }

  /** Say something for a few seconds. */
  say(text: string): void {
    this.notice.textContent = text;
    clearTimeout(this.noticeTimer);
    this.noticeTimer = setTimeout(() => (this.notice.textContent = ''), NOTICE_MS);
  }

  /** What a click does now. */
  hintAt(tool: keyof typeof strings.view.hints): void {
    this.hint.textContent = strings.view.hints[tool];
  }

  /** Whether a sweep may be started here: then it is proposed where there is nothing to see. */
  allow(sweeps: boolean): void {
    const none = sweeps ? strings.view.empty : strings.scans.none;
    if (this.empty.textContent === this.none) this.empty.textContent = none;
    this.none = none;
  }

  /** Say that there is nothing to see: none yet, or not any more; null: there is. */
  showEmpty(why: 'none' | 'gone' | null): void {
    this.empty.hidden = why === null;
    if (why) this.empty.textContent = why === 'gone' ? strings.view.gone : this.none;
  }

  /** How the connection stands; while there is none, counts down to the next attempt. */
  linked(link: LinkState): void {
    clearInterval(this.retryTimer);
    if (link.state === 'out') return location.replace('/pair'); // and no way back to what is shown here
    document.documentElement.dataset['link'] = link.state;
    this.retry.hidden = link.state !== 'lost';
    this.admin.allow(link.state === 'ready' ? link.role : null);
    if (link.state === 'connecting') this.link.textContent = strings.link.connecting;
    if (link.state === 'ready') this.link.textContent = strings.link.ready(link.node);
    if (link.state !== 'lost') return;
    const due = performance.now() + link.retryMs;
    const count = () => {
      this.link.textContent = strings.link.lost(link.reason, Math.max(0, Math.ceil((due - performance.now()) / 1000)));
    };
    count();
    this.retryTimer = setInterval(count, 1000);
  }
}
