// What the node tells those who look after it, and does for them.

import { ask } from '../api.ts';
import type { Capture } from '../api.ts';

/** Times are in seconds since 1970, by the node's clock. */
export interface Upkeep {
  version: string;
  started: number;
  status: string;
  reasons: string[];
  capture: Capture;
  disk: { freeBytes: number; sizeBytes: number };
  certificate: { fingerprint: string; ends: number; own: boolean } | null;
  retention: { maxAgeDays: number | null; maxGb: number | null };
  scans: number;
  interrupted: number;
  streams: number;
}

export interface Login {
  name: string;
  role: string;
  created: number;
  lastUsed: number | null;
  /** What this browser itself comes in by. */
  own: boolean;
}

export interface Waiting {
  name: string;
  role: string;
  expires: number;
}

export interface Offered {
  code: string;
  fingerprint: string;
  expires: number;
}

/** A line of the audit log; what is empty is left out. */
export interface Entry {
  at: string;
  event: string;
  by: string;
  role?: string;
  address?: string;
  scan?: string;
  sweep?: string;
  what?: string;
  left_out?: number;
}

export interface AuditQuery {
  scan: string;
  by: string;
  since: string;
  refused: boolean;
  limit: number;
}

export const readUpkeep = (): Promise<Upkeep> => ask('GET', '/v1/upkeep');
export const listLogins = (): Promise<Login[]> => ask('GET', '/v1/tokens');
export const listWaiting = (): Promise<Waiting[]> => ask('GET', '/v1/codes');
export const offerCode = (name: string, role: string, minutes: number): Promise<Offered> => ask('POST', '/v1/codes', { name, role, minutes });
export const revoke = (name: string): Promise<unknown> => ask('DELETE', `/v1/tokens/${encodeURIComponent(name)}`);
export const readAudit = ({ refused, limit, ...narrowed }: AuditQuery): Promise<Entry[]> => {
  const query = new URLSearchParams({ limit: String(limit) });
  for (const [name, value] of Object.entries(narrowed)) if (value) query.set(name, value);
  if (refused) query.set('refused', '1');
  return ask('GET', `/v1/audit?${query}`);
};
