// What the page's address holds, so that a link reproduces a view: scan, camera, foveae, pins.

import type { CameraPlace } from './view/stage.ts';
import type { Place } from './view/room.ts';

export interface Pin extends Place {
  label: string;
}

/** A scan beside the one that is open, and the view of it. */
export interface Beside {
  scan: string;
  camera: CameraPlace | null;
  foveae: Place[];
}

export interface ViewState {
  scan: string | null;
  camera: CameraPlace | null;
  foveae: Place[];
  pins: Pin[];
  beside: Beside | null;
}

const FOVEAE_MAX = 24;
const PINS_MAX = 100;
const LABEL_MAX = 200;
const ID_MAX = 200;

/** The fragment of an address, without '#'. */
export function formatState({ scan, camera, foveae, pins, beside }: ViewState): string {
  const fields = new URLSearchParams();
  if (scan) fields.set('scan', scan);
  const add = (prefix: string, camera: CameraPlace | null, foveae: Place[]) => {
    if (camera) fields.set(`${prefix}camera`, formatCamera(camera));
    for (const { u, v } of foveae.slice(-FOVEAE_MAX)) fields.append(`${prefix}fovea`, `${u.toFixed(5)},${v.toFixed(5)}`);
  };
  add('', camera, foveae);
  for (const { u, v, label } of pins.slice(0, PINS_MAX)) fields.append('pin', `${u.toFixed(5)},${v.toFixed(5)},${label}`);
  if (beside) {
    fields.set('beside', beside.scan);
    add('beside-', beside.camera, beside.foveae);
  }
  return fields.toString();
}

/** Inverse of formatState; what makes no sense is left out. */
export function parseState(fragment: string): ViewState {
  const fields = new URLSearchParams(fragment);
  const view = (prefix: string) => ({
    camera: parseCamera(fields.get(`${prefix}camera`)),
    foveae: fields.getAll(`${prefix}fovea`).slice(-FOVEAE_MAX).flatMap((text) => parsePlace(text) ?? []),
  });
  const beside = parseId(fields.get('beside'));
  return {
    scan: parseScan(fields.get('scan')),
    ...view(''),
    pins: fields.getAll('pin').slice(0, PINS_MAX).flatMap((text) => parsePin(text) ?? []),
    beside: beside === null ? null : { scan: beside, ...view('beside-') },
  };
}

/** An id that makes no sense stays one that no scan has: not the newest scan, but none is to be shown then. */
const parseScan = (text: string | null): string | null => text?.slice(0, ID_MAX).replace(/[^\w-]/g, '-') || null;
const parseId = (text: string | null): string | null => (text && /^[\w-]{1,200}$/.test(text) ? text : null);

function formatCamera({ azimuth, elevation, distance, target }: CameraPlace): string {
  return [azimuth.toFixed(4), elevation.toFixed(4), ...[distance, ...target].map((mm) => mm.toFixed(2))].join(',');
}

function parseCamera(text: string | null): CameraPlace | null {
  const numbers = text?.split(',').map(Number) ?? [];
  if (numbers.length !== 6 || !numbers.every(Number.isFinite) || numbers[2]! <= 0) return null;
  const [azimuth, elevation, distance, ...target] = numbers as [number, number, number, number, number, number];
  return { azimuth, elevation, distance, target };
}

function parsePlace(text: string): Place | null {
  const [u, v, ...rest] = text.split(',').map(Number);
  return rest.length === 0 && isShare(u) && isShare(v) ? { u, v } : null;
}

function parsePin(text: string): Pin | null {
  const [u, v, ...label] = text.split(',');
  const place = parsePlace(`${u},${v}`);
  return place && { ...place, label: label.join(',').slice(0, LABEL_MAX) };
}

const isShare = (value: number | undefined): value is number => value !== undefined && value >= 0 && value < 1;
