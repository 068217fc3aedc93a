// What the page and its worker say to each other.

import type { Channel } from './protocol/lattice.ts';
import type { ScanInfo } from './protocol/messages.ts';
import type { Changed } from './protocol/model.ts';

export interface LookOptions {
  window: number;
  textureDb: number;
  rangeMm: number;
  maxWaitS?: number;
  alpha?: number;
  maxBytes?: number;
}

export type ToWorker =
  | { kind: 'start'; origin: string; scan: string | null }
  | { kind: 'open'; scan: string }
  | { kind: 'look'; look: number; u: number; v: number; options: LookOptions }
  | { kind: 'cancel'; look: number }
  | { kind: 'restore' }
  | { kind: 'record' }
  | { kind: 'replay'; info: ScanInfo; refinements: Uint8Array; wasm: ArrayBuffer }
  | { kind: 'retry' }
  | { kind: 'thumbnail'; scan: string };

/** What is begun before the page's own script runs. said: what the worker has said meanwhile. */
export interface Boot {
  worker: Worker;
  said: MessageEvent<FromWorker>[];
  canvas: HTMLCanvasElement;
  context: WebGL2RenderingContext | null;
  /** What is shown of the scan until the model of it stands. */
  poster: HTMLImageElement | null;
  /** One more worker, for a scan of its own. */
  hire(scan: string): Worker;
}

/** Edges are smooth because the picture is drawn larger than shown. It is kept, so that a part of it can be drawn anew. */
export const CONTEXT: WebGLContextAttributes = { antialias: false, preserveDrawingBuffer: true, powerPreference: 'high-performance' };

/** A scan as it is known now; texels that are refined follow as patches. */
export interface Snapshot {
  info: ScanInfo;
  steps: Uint16Array;
  coarseTexels: Uint8Array;
  levels: [range: Uint8Array, texture: Uint8Array];
}

/** What one look brought and cost. */
export interface Answer {
  look: number;
  reason: 'complete' | 'byte limit' | 'superseded';
  bytes: number;
  elapsedMs: number;
  /** Of that, what the node took to make it, by its own account, and what taking it in took here. */
  nodeMs: number;
  applyMs: number;
  errorMaxMm: number | null;
  textureDb: number | null;
}

export type LinkState =
  | { state: 'connecting' }
  | { state: 'ready'; node: string; version: string; role: string }
  | { state: 'lost'; reason: string; retryMs: number }
  /** The node knows this browser no more. */
  | { state: 'out' };

export type FromWorker =
  | { kind: 'link'; link: LinkState }
  | { kind: 'opened'; snapshot: Snapshot; fresh: boolean }
  | { kind: 'restored' }
  | { kind: 'broken' }
  | { kind: 'recorded'; info: ScanInfo; refinements: Uint8Array<ArrayBuffer> | null }
  | { kind: 'patch'; channel: Channel; changed: Changed[]; level: Uint8Array }
  /** What was patched is whole, and shall be seen. */
  | { kind: 'patched' }
  | { kind: 'updated'; answer: Answer }
  | { kind: 'refused'; look: number; code: string; message: string }
  | { kind: 'published'; scan: string }
  | { kind: 'liveStarted'; grid: ScanInfo }
  | { kind: 'livePicture'; steps: Uint16Array; texels: Uint8Array }
  | { kind: 'liveProgress'; percent: number; secondsLeft: number | null }
  | { kind: 'liveEnded'; scan: string | null; why: string }
  | { kind: 'thumbnail'; scan: string; picture: Blob | null }
  | { kind: 'traffic'; received: number; sent: number };
