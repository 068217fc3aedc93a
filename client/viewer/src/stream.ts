// The conversation with the node: connects, goes on after a cut, applies what comes in order, and tells the page.

import { backoffMs } from './backoff.ts';
import type { Answer, LinkState, LookOptions } from './link.ts';
import { LivePicture } from './live_picture.ts';
import type { Codecs } from './protocol/codec.ts';
import { HoldingsDiffer, RemoteWireError } from './protocol/errors.ts';
import { TEXTURE } from './protocol/lattice.ts';
import type { Channel } from './protocol/lattice.ts';
import { isLive, parseLive } from './protocol/live.ts';
import { parseMessage, PROTOCOL } from './protocol/messages.ts';
import type { FromClient, FromNode, Look, ScanInfo, Updated } from './protocol/messages.ts';
import { Model } from './protocol/model.ts';
import type { Changed } from './protocol/model.ts';
import { COARSE, parseRefinement } from './protocol/refinement.ts';
import type { Refinement } from './protocol/refinement.ts';
import { Recording } from './recording.ts';
import { rehearse } from './rehearsal.ts';
import { inParts, tellAll } from './telling.ts';
import type { Tell } from './telling.ts';

const CLIENT = 'foveascan viewer';
const VIOLATION = 4002;
const PICTURE_MS = 100;
const TOGETHER_MS = 80;
const TRAFFIC_MS = 500;
/** After the first view: by then it is drawn. */
const REHEARSAL_MS = 600;

interface Looking {
  look: Look;
  began: number;
  bytes: number;
  applyMs: number;
}

/** Why there is no connection, in words for people; null: the node wants a login. */
export type Explain = () => Promise<string | null>;

export class Stream {
  private socket: WebSocket | null = null;
  private work: Promise<void> = Promise.resolve();
  private attempt = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private node: { name: string; version: string } | null = null;
  private model: Model | null = null;
  private recording: Recording | null = null;
  /** The scan that the page wants to see. */
  private wanted: string | null = null;
  /** Asked for by the page, and not told it yet. */
  private unseen = false;
  /** Messages that have come and are not taken yet. */
  private waiting = 0;
  /** The channel patched last of what the page has and does not show yet. */
  private patched: Channel | null = null;
  private patchedTimer: ReturnType<typeof setTimeout> | undefined;
  private isRehearsed = false;
  private request = 0;
  private opening = 0;
  /** Whether that opening said what we hold: else a first view comes again. */
  private hasStated = false;
  private looking: Looking | null = null;
  private applyMs = 0;
  private received = 0;
  private trafficTimer: ReturnType<typeof setTimeout> | undefined;
  private sent = 0;
  private picture: LivePicture | null = null;
  private pictureTimer: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly url: string, private readonly codecs: Codecs, private readonly tell: Tell,
    private readonly explain: Explain,
  ) {}

  /** Connect, and stay connected. */
  connect(): void {
    clearTimeout(this.timer);
    if (this.socket) return;
    this.link({ state: 'connecting' });
    const socket = new WebSocket(this.url, [PROTOCOL]);
    this.socket = socket;
    socket.binaryType = 'arraybuffer';
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      this.count(data);
      this.waiting++;
      this.work = this.work.then(() => this.take(socket, data)).catch((error: unknown) => this.fail(socket, error)).then(() => this.taken());
    };
    socket.onclose = ({ reason }) => void this.lost(socket, reason);
  }

  /** Show a scan: its first view, or all that we hold of it already. */
  open(scan: string): void {
    this.wanted = scan;
    if (this.looking) this.answer(this.looking, 'superseded', null);
    this.looking = null;
    this.unseen = true;
    if (this.node) this.sendOpen();
  }

  /** Get detail; a look that is still in the air is superseded by a newer one. */
  look(number: number, u: number, v: number, options: LookOptions): void {
    const look: Look = { type: 'look', request: number, u, v, ...options };
    if (this.looking) this.answer(this.looking, 'superseded', null);
    this.looking = { look, began: performance.now(), bytes: 0, applyMs: 0 };
    if (this.node && this.model?.complete) this.sendLook();
  }

  /** Forget a look. */
  cancel(number: number): void {
    if (this.looking?.look.request !== number) return;
    this.say({ type: 'cancel', request: this.request });
    this.answer(this.looking, 'superseded', null);
    this.looking = null;
  }

  /** Tell the page all over what we hold: its graphics memory was lost. */
  restore(): void {
    this.work = this.work.then(() => {
      if (!this.model?.complete) return;
      this.tellAll();
      this.tell({ kind: 'restored' });
    });
  }

  /** Tell the page what was received of the open scan. */
  record(): void {
    this.work = this.work.then(() => {
      if (!this.model?.complete || !this.recording) return;
      this.tell({ kind: 'recorded', info: this.model.info, refinements: this.recording.toBytes() });
    });
  }

  private async take(socket: WebSocket, data: string | ArrayBuffer): Promise<void> {
    if (socket !== this.socket) return;
    if (typeof data === 'string') return this.hear(parseMessage(data), data.length);
    const bytes = new Uint8Array(data);
    if (isLive(bytes)) return this.showLive(bytes);
    await this.refine(parseRefinement(bytes), bytes);
  }

  private hear(said: FromNode, size: number): void {
    switch (said.type) {
      case 'serverInfo':
        if (said.protocol !== PROTOCOL) throw new RemoteWireError(`the node speaks ${said.protocol}, this page ${PROTOCOL}`);
        this.node = { name: said.name, version: said.version };
        this.say({ type: 'hello', protocol: PROTOCOL, client: CLIENT, codecs: ['htj2k', 'jpeg'], geometries: ['cylinder', 'sphere'] });
        break;
      case 'welcome':
        this.attempt = 0;
        this.link({ state: 'ready', node: this.node!.name, version: this.node!.version, role: said.role });
        this.say({ type: 'watch', live: true });
        if (this.wanted) this.sendOpen();
        break;
      case 'opened':
        if (said.request === this.opening) this.bind(said);
        break;
      case 'updated':
        this.close(said, size);
        break;
      case 'resync':
        if (said.epoch === this.model?.epoch) this.say(this.model.state());
        break;
      case 'refused':
        this.refuse(said);
        break;
      case 'published':
        this.tell({ kind: 'published', scan: said.scan });
        break;
      case 'goodbye':
        this.socket?.close();
        break;
      case 'liveStarted':
        this.picture = new LivePicture(said.sweep, said.grid);
        this.tell({ kind: 'liveStarted', grid: said.grid });
        break;
      case 'liveProgress':
        this.tell({ kind: 'liveProgress', percent: said.percent, secondsLeft: said.secondsLeft ?? null });
        break;
      case 'liveEnded':
        this.picture = null;
        this.tell({ kind: 'liveEnded', scan: said.reason === 'published' ? (said.scan ?? null) : null, why: said.why ?? '' });
        break;
    }
  }

  private bind({ epoch, scan }: Extract<FromNode, { type: 'opened' }>): void {
    if (this.hasStated && this.model?.info.id === scan.id) {
      this.model.resume(epoch);
      this.wanted = scan.id;
      if (this.unseen) this.tellAll();
      if (this.looking) this.sendLook();
      return;
    }
    this.wanted = scan.id;
    this.model = new Model(scan, epoch);
    this.recording = new Recording(scan);
  }

  private async refine(refinement: Refinement, message: Uint8Array): Promise<void> {
    const model = this.model;
    if (!model || refinement.epoch !== model.epoch) return; // of an opening that a newer one has overtaken
    const began = performance.now();
    let changed: Changed[];
    try {
      if (!model.isNext(refinement)) throw new HoldingsDiffer('a refinement is missing');
      changed = await model.apply(refinement, this.codecs);
    } catch (error) {
      if (!(error instanceof HoldingsDiffer)) throw error;
      this.say(model.object());
      return;
    }
    this.recording?.add(message);
    const applyMs = performance.now() - began;
    this.applyMs += applyMs;
    if (refinement.generator === COARSE) return this.firstView(model, refinement);
    if (this.looking && refinement.look === this.request) {
      this.looking.bytes += message.length;
      this.looking.applyMs += applyMs;
    }
    const { channel } = refinement;
    const level = model.holdings.channels[channel].level.slice();
    for (const part of inParts(changed)) {
      this.tell({ kind: 'patch', channel, changed: part, level }, part.map(({ cells }) => cells.buffer as ArrayBuffer));
    }
    this.patched = channel;
  }

  /**
   * A message is done with. What belongs together is drawn at once, not one after the other: range, which the page has got
   * by then, waits a moment for its texture, or for the end of the update.
   */
  private taken(): void {
    if (--this.waiting > 0 || this.patched === null) return;
    if (this.patched === TEXTURE) this.tellPatched();
    else this.patchedTimer ??= setTimeout(() => this.tellPatched(), TOGETHER_MS);
  }

  private tellPatched(): void {
    clearTimeout(this.patchedTimer);
    this.patchedTimer = undefined;
    if (this.patched !== null) this.tell({ kind: 'patched' });
    this.patched = null;
  }

  private firstView(model: Model, last: Refinement): void {
    if (!model.complete) return;
    if (last.channel === TEXTURE) this.rehearse(model.info, last);
    this.tellAll();
    this.acknowledge(model);
    if (this.looking) this.sendLook();
  }

  /** Once, when the first view is drawn. */
  private rehearse(info: ScanInfo, texture: Refinement): void {
    if (this.isRehearsed) return;
    this.isRehearsed = true;
    const isOver = () => this.looking !== null;
    setTimeout(() => rehearse(info, texture, this.codecs, isOver).catch(console.warn), REHEARSAL_MS);
  }

  private close(said: Updated, size: number): void {
    if (said.request === this.request && this.looking) {
      this.looking.bytes += size;
      this.answer(this.looking, said.reason, said);
      this.looking = null;
    }
    const model = this.model;
    if (!model || said.reason === 'superseded') return;
    if (said.nextSeq > model.nextSeq) this.say(model.object());
    else this.acknowledge(model);
  }

  private refuse({ request, code, message }: Extract<FromNode, { type: 'refused' }>): void {
    if (request === this.opening) {
      if (code === 'not found') this.model = this.recording = null; // nor is shown again what was open before
      this.wanted = this.model?.info.id ?? null;
    }
    const look = (request === this.request && this.looking?.look.request) || 0;
    if (look) this.looking = null;
    this.tell({ kind: 'refused', look, code, message });
  }

  private showLive(bytes: Uint8Array): void {
    const columns = parseLive(bytes);
    if (!this.picture || columns.sweep !== this.picture.sweep) return;
    this.picture.take(columns);
    this.pictureTimer ??= setTimeout(() => {
      this.pictureTimer = undefined;
      if (this.picture) {
        const [steps, texels] = [this.picture.steps.slice(), this.picture.texels.slice()];
        this.tell({ kind: 'livePicture', steps, texels }, [steps.buffer, texels.buffer]);
      }
    }, PICTURE_MS);
  }

  private acknowledge(model: Model): void {
    this.say(model.acknowledge(this.applyMs));
    this.applyMs = 0;
  }

  private answer({ look, began, bytes, applyMs }: Looking, reason: Answer['reason'], said: Updated | null): void {
    const [errorMaxMm, textureDb] = [said?.errorMaxMm ?? null, said?.textureDb ?? null];
    const elapsedMs = performance.now() - began;
    this.tellPatched();
    this.tellTraffic();
    this.tell({ kind: 'updated', answer: { look: look.request, reason, bytes, elapsedMs, nodeMs: said?.nodeMs ?? 0, applyMs, errorMaxMm, textureDb } });
  }

  private sendOpen(): void {
    this.opening = ++this.request;
    const held = this.model?.complete && this.model.info.id === this.wanted ? this.model : null;
    this.hasStated = held !== null;
    if (held) this.say({ type: 'open', request: this.opening, scan: held.info.id, holdings: held.statement() });
    else this.say({ type: 'open', request: this.opening, scan: this.wanted! });
  }

  private sendLook(): void {
    this.say({ ...this.looking!.look, request: ++this.request });
  }

  private say(message: FromClient | null): void {
    if (!message || this.socket?.readyState !== WebSocket.OPEN) return;
    const text = JSON.stringify(message);
    this.sent += text.length;
    this.socket.send(text);
  }

  private count(data: string | ArrayBuffer): void {
    this.received += typeof data === 'string' ? data.length : data.byteLength;
    this.trafficTimer ??= setTimeout(() => this.tellTraffic(), TRAFFIC_MS);
  }

  /** With what it brought, or now and then: for each new number the browser puts the whole page together once more. */
  private tellTraffic(): void {
    clearTimeout(this.trafficTimer);
    this.trafficTimer = undefined;
    this.tell({ kind: 'traffic', received: this.received, sent: this.sent });
  }

  private fail(socket: WebSocket, error: unknown): void {
    console.error(error);
    socket.close(VIOLATION, String(error).slice(0, 100));
    void this.lost(socket, error instanceof RemoteWireError ? error.message : 'an error in this page');
  }

  private async lost(socket: WebSocket, reason: string): Promise<void> {
    if (socket !== this.socket) return;
    this.socket = this.node = null;
    if (this.looking) Object.assign(this.looking, { bytes: 0, applyMs: 0 });
    const why = reason || (await this.explain());
    if (why === null) return this.link({ state: 'out' });
    const retryMs = backoffMs(this.attempt++, Math.random());
    this.link({ state: 'lost', reason: why, retryMs });
    this.timer = setTimeout(() => this.connect(), retryMs);
  }

  private link(link: LinkState): void {
    this.tell({ kind: 'link', link });
  }

  /** All that we hold of a scan whose first view is in. */
  private tellAll(): void {
    tellAll(this.model!, this.unseen, this.tell);
    this.tellTraffic();
    this.unseen = false;
  }
}
