// Control messages on the LAN, as the page needs them: mirrors protocol/messages.py (PROTOCOL.md, "Stream").

import { RemoteWireError } from './errors.ts';
import { RANGE, TEXTURE } from './lattice.ts';
import type { ChannelShape } from './lattice.ts';
import type { Run } from './holdings.ts';

export const PROTOCOL = 'foveascan.v1';
const TEXT_MAX = 4 << 20;
const SIDE_MAX = 16384;

export interface ScanInfo {
  id: string;
  width: number;
  height: number;
  textureWidth: number;
  textureHeight: number;
  coarseWidth: number;
  coarseHeight: number;
  coarseTextureWidth: number;
  coarseTextureHeight: number;
  stepMm: number;
  pitchMm: number;
  zMaxMm: number;
  theta0Rad: number;
  created?: string;
  geometry?: 'cylinder' | 'sphere';
}

export interface Statement {
  range: Run[];
  texture: Run[];
}

export type FromNode =
  | { type: 'serverInfo'; protocol: string; id: string; name: string; version: string; login?: boolean }
  | { type: 'welcome'; role: 'view' | 'operate' | 'admin' }
  | { type: 'opened'; request: number; epoch: number; scan: ScanInfo }
  | Updated
  | { type: 'resync'; epoch: number; reason: string }
  | { type: 'published'; scan: string }
  | { type: 'refused'; request: number; code: string; message: string }
  | { type: 'goodbye'; reason: string }
  | { type: 'liveStarted'; sweep: number; grid: ScanInfo }
  | { type: 'liveProgress'; sweep: number; percent: number; secondsLeft?: number | null }
  | { type: 'liveEnded'; sweep: number; reason: 'published' | 'interrupted'; scan?: string; why?: string };

export interface Updated {
  type: 'updated';
  request: number;
  nextSeq: number;
  reason: 'complete' | 'byte limit' | 'superseded';
  errorMaxMm?: number | null;
  textureDb?: number | null;
  encodes?: number;
  nodeMs?: number;
}

export interface Look {
  type: 'look';
  request: number;
  u: number;
  v: number;
  window?: number;
  textureDb?: number;
  rangeMm?: number;
  maxWaitS?: number;
  alpha?: number;
  maxBytes?: number;
  fill?: boolean;
}

export type FromClient =
  | { type: 'hello'; protocol: string; client: string; codecs: string[]; geometries: string[] }
  | { type: 'open'; request: number; scan: string; holdings?: Statement }
  | Look
  | { type: 'ack'; epoch: number; nextSeq: number; digest: string; applyMs: number }
  | { type: 'state'; epoch: number; nextSeq: number; holdings: Statement }
  | { type: 'cancel'; request: number }
  | { type: 'watch'; live: boolean };

type Check = (value: unknown) => boolean;

const isText: Check = (value) => typeof value === 'string' && value.length <= 500;
const isCount: Check = (value) => Number.isInteger(value) && (value as number) >= 0 && (value as number) <= 0xffffffff;
const isNumber: Check = (value) => typeof value === 'number' && Number.isFinite(value);
const isSide: Check = (value) => Number.isInteger(value) && (value as number) >= 1 && (value as number) <= SIDE_MAX;
const optional = (check: Check): Check => (value) => value === undefined || value === null || check(value);
const oneOf = (...words: string[]): Check => (value) => words.includes(value as string);

const SCAN: Record<string, Check> = {
  id: isText, width: isSide, height: isSide, textureWidth: isSide, textureHeight: isSide,
  coarseWidth: isSide, coarseHeight: isSide, coarseTextureWidth: isSide, coarseTextureHeight: isSide,
  stepMm: isNumber, pitchMm: isNumber, zMaxMm: isNumber, theta0Rad: isNumber, created: optional(isText),
  geometry: optional(oneOf('cylinder', 'sphere')),
};
const isScan: Check = (value) => typeof value === 'object' && value !== null && fits(value, SCAN) && isOrdered(value as ScanInfo);

const FIELDS: Record<FromNode['type'], Record<string, Check>> = {
  serverInfo: { protocol: isText, id: isText, name: isText, version: isText },
  welcome: { role: oneOf('view', 'operate', 'admin') },
  opened: { request: isCount, epoch: isCount, scan: isScan },
  updated: {
    request: isCount, nextSeq: isCount, reason: oneOf('complete', 'byte limit', 'superseded'),
    errorMaxMm: optional(isNumber), textureDb: optional(isNumber), encodes: optional(isCount), nodeMs: optional(isNumber),
  },
  resync: { epoch: isCount, reason: isText },
  published: { scan: isText },
  refused: { request: isCount, code: isText, message: isText },
  goodbye: { reason: isText },
  liveStarted: { sweep: isCount, grid: isScan },
  liveProgress: { sweep: isCount, percent: isNumber, secondsLeft: optional(isNumber) },
  liveEnded: { sweep: isCount, reason: oneOf('published', 'interrupted'), scan: optional(isText), why: optional(isText) },
};

/** Read what the node says. Throws RemoteWireError for what no node of this version says. */
export function parseMessage(text: string): FromNode {
  if (text.length > TEXT_MAX) throw new RemoteWireError('message is too long');
  let said: unknown;
  try {
    said = JSON.parse(text);
  } catch {
    throw new RemoteWireError('message is no JSON');
  }
  const type = (said as { type?: unknown } | null)?.type;
  const fields = typeof type === 'string' && Object.hasOwn(FIELDS, type) ? FIELDS[type as FromNode['type']] : null;
  if (!fields || !fits(said as object, fields)) throw new RemoteWireError(`bad message: ${text.slice(0, 200)}`);
  return said as FromNode;
}

function fits(record: object, fields: Record<string, Check>): boolean {
  return Object.entries(fields).every(([name, check]) => check((record as Record<string, unknown>)[name]));
}

function isOrdered(s: ScanInfo): boolean {
  return (
    s.coarseWidth <= s.width && s.coarseHeight <= s.height && s.coarseTextureWidth <= s.textureWidth &&
    s.coarseTextureHeight <= s.textureHeight && s.stepMm > 0 && s.pitchMm > 0
  );
}

/** Shapes of both channels of a scan. */
export function channelShapes(s: ScanInfo): { [RANGE]: ChannelShape; [TEXTURE]: ChannelShape } {
  const sphere = s.geometry === 'sphere';
  return {
    [RANGE]: {
      channel: RANGE, width: s.width, height: s.height, coarseWidth: s.coarseWidth, coarseHeight: s.coarseHeight,
      sphere,
    },
    [TEXTURE]: {
      channel: TEXTURE, width: s.textureWidth, height: s.textureHeight,
      coarseWidth: s.coarseTextureWidth, coarseHeight: s.coarseTextureHeight, sphere,
    },
  };
}
