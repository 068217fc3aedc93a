// What the node answers over plain HTTP.

import type { Pin } from './url_state.ts';

export interface ScanSummary {
  id: string;
  created: number;
  name?: string | null;
  width: number;
  height: number;
  textureWidth: number;
  textureHeight: number;
  subject?: string;
  bodySite?: string;
}

/** How a sweep went, as far as the node can tell; lengths in mm. More of it is in PROTOCOL.md. */
export interface Quality {
  coverage: number;
  holes: number;
  passes: number;
  noiseMm: number | null;
  slipDeg: number | null;
  spikes: number;
  filled: number;
  requestedColumns: number;
  /** Where the scanner's axis is, if the scan was corrected for that. */
  axis: { lateralMm: number; radialMm: number } | null;
  /** What of this a person should know, in words. */
  complaints: string[];
}

/** Where a scan comes from. quality: null of one that was not swept here; note: how it was made, then. */
export interface Account {
  quality: Quality | null;
  note: string;
}

/** What people say of a scan. */
export interface Sidecar {
  revision: number;
  name: string | null;
  subject: string;
  body_site: string;
  pins: Pin[];
}

export type Changes = Partial<Omit<Sidecar, 'revision'>>;

export interface Capture {
  phase: string;
  progress?: number;
  why?: string;
  [more: string]: unknown;
}

/** A sweep that was cut, and is no scan. ended: seconds since 1970; held, expected: pieces of columns. */
export interface CutSweep {
  id: string;
  ended: number;
  why: string;
  held: number;
  expected: number;
}

/** What is left out of a quality stands for. */
const UNSAID: Quality = {
  coverage: 0, holes: 0, passes: 1, noiseMm: null, slipDeg: null, spikes: 0, filled: 0, requestedColumns: 0, axis: null,
  complaints: [],
};

/** The node said no; the message is for people. */
export class Refused extends Error {
  constructor(readonly status: number, message: string) {
    super(message);
  }
}

export const listScans = (): Promise<ScanSummary[]> => ask('GET', '/v1/scans');
export const startSweep = (): Promise<unknown> => ask('POST', '/v1/sweeps');
export const listCutSweeps = (): Promise<CutSweep[]> => ask('GET', '/v1/sweeps');
export const resumeSweep = (id: string): Promise<unknown> => ask('POST', `/v1/sweeps/${id}/resume`);
export const deleteSweep = (id: string): Promise<unknown> => ask('DELETE', `/v1/sweeps/${id}`);
export const deleteScan = (id: string): Promise<unknown> => ask('DELETE', `/v1/scans/${id}`);
export const readCapture = async (): Promise<Capture> => (await ask<{ capture: Capture }>('GET', '/v1/node')).capture;
export const readAccount = async (id: string): Promise<Account> => {
  const { quality, note } = await ask<{ quality?: Partial<Quality> | null; note?: string }>('GET', `/v1/scans/${id}`);
  return { quality: quality ? { ...UNSAID, ...quality } : null, note: note ?? '' };
};
export const downloadPath = (id: string, format: string): string => `/v1/scans/${id}.${format}`;

/** What is said of a scan; null where the node keeps no such thing. */
export async function readSidecar(id: string): Promise<Sidecar | null> {
  try {
    return await ask<Sidecar>('GET', `/v1/scans/${id}/sidecar`);
  } catch (error) {
    if (error instanceof Refused && (error.status === 404 || error.status === 405)) return null;
    throw error;
  }
}

/** Change some of it, if nobody else has in the meantime. */
export function changeSidecar(id: string, revision: number, changes: Changes): Promise<Sidecar> {
  return ask('PATCH', `/v1/scans/${id}/sidecar`, changes, { 'If-Match': `"${revision}"` });
}

/** Ask the node for something, or to do it. Rejects with Refused. */
export async function ask<T>(method: string, path: string, body?: unknown, headers: Record<string, string> = {}): Promise<T> {
  const init: RequestInit = { method, headers, cache: 'no-store' };
  if (body !== undefined) Object.assign(init, { body: JSON.stringify(body), headers: { ...headers, 'Content-Type': 'application/json' } });
  const answer = await fetch(path, init);
  if (answer.ok) return (answer.status === 204 ? null : await answer.json()) as T;
  const said = (await answer.json().catch(() => ({}))) as { message?: string };
  throw new Refused(answer.status, said.message ?? `${answer.status} ${answer.statusText}`);
}
