// Every word the page says, in one place.

import type { Quality, ScanSummary } from './api.ts';
import type { Held } from './copy.ts';
import type { Measured } from './measuring.ts';

const millimetres = (mm: number): string => `${mm < 100 ? mm.toFixed(2) : mm.toFixed(1)} mm`;

const moment = (iso: string): string => when(Date.parse(iso) / 1000);
const when = (unixS: number): string => new Date(1000 * unixS).toLocaleString(undefined, { dateStyle: 'medium', timeStyle: 'short' });

export const strings = {
  title: 'foveascan',
  noWebgl: 'This browser draws no WebGL 2, which the page needs. Any current Firefox, Chrome, Edge or Safari does.',
  tooLarge: 'This graphics card cannot draw a scan of this size.',
  shrunk: (by: number) => `Colour is shown at 1/${by} of its resolution: this graphics card takes no larger picture.`,
  link: {
    connecting: 'Connecting…',
    ready: (node: string) => `Connected to ${node}`,
    lost: (reason: string, seconds: number) => `No connection: ${reason}. Next try in ${seconds} s.`,
    again: 'Try now',
    cut: 'the connection was cut',
    unreachable: 'the node does not answer; is it switched on, and are you on its network?',
    needsToken: 'the node wants a login',
    graphicsLost: 'The graphics card was reset; drawing again…',
  },
  view: {
    label: '3D view of the scan. Arrow keys turn it, plus and minus zoom, Shift and arrows move it, Enter sharpens the middle or sets a point there, Backspace takes a point back, Escape stops what is coming, Home shows everything.',
    empty: 'No scan yet. Start a sweep, and watch it appear here.',
    gone: 'That scan is not there any more. Choose another one, if there is any.',
    hints: {
      turn: 'Drag to turn · wheel to zoom',
      sharpen: 'Click to sharpen · drag to turn · wheel to zoom',
      measure: 'Click two points to measure · drag to turn · wheel to zoom',
      path: 'Click along the path, point by point · drag to turn · wheel to zoom',
      pin: 'Click where the pin goes · drag to turn · wheel to zoom',
    },
    live: (percent: number, seconds: number | null) =>
      `Sweep ${percent.toFixed(0)} %${seconds === null ? '' : `, ${Math.ceil(seconds)} s left`}`,
    home: 'Whole object',
    zoomIn: 'Nearer',
    zoomOut: 'Farther',
    missed: 'Nothing was measured there.',
  },
  scans: {
    heading: 'Scans',
    none: 'None yet.',
    untitled: 'Scan',
    when,
    about: ({ name, subject, bodySite }: ScanSummary) => [name, subject, bodySite].filter(Boolean).join(' · '),
    title: ({ name, created }: ScanSummary) => `${name || 'Scan'} · ${when(created)}`,
    site: (subject: string, site: string) => [subject, site].filter(Boolean).join(' · '),
  },
  scanner: {
    heading: 'Scanner',
    start: 'Start a sweep',
    watch: 'Watch the sweep',
    started: 'The sweep has been started.',
    phases: {
      ready: 'Ready', starting: 'Starting', sweeping: 'Sweeping', connecting: 'Looking for the scanner', 'no scanner': 'No scanner at this node',
      stopped: 'Stopped',
    } as Record<string, string>,
    progress: 'Progress of the sweep',
    interrupted: (why: string) => `The sweep was interrupted: ${why}`,
    done: 'The sweep is complete.',
  },
  look: {
    heading: 'Sharpness',
    tool: 'A click',
    tools: { turn: 'turns only', sharpen: 'sharpens', measure: 'measures', path: 'traces a path', pin: 'sets a pin' },
    here: 'Sharpen the middle',
    follow: 'Follow my pointer',
    time: 'Time limit',
    times: [['0', 'none'], ['0.25', '¼ second'], ['0.5', '½ second'], ['1', '1 second'], ['3', '3 seconds']],
    area: 'Area round the click',
    areas: [['0.02', 'spot (2 %)'], ['0.05', 'normal (5 %)'], ['0.15', 'wide (15 %)'], ['0.4', 'very wide (40 %)'], ['1', 'all of it']],
    falloff: 'Around it, detail falls off',
    falloffs: [['auto', 'as the node sees fit'], ['2', 'at once (α 2)'], ['0.5', 'quickly (α 0.5)'], ['0.1', 'slowly (α 0.1)']],
    quality: 'Quality',
    qualities: [['preview', 'quick look'], ['fine', 'fine (40 dB, 0.1 mm)'], ['exact', 'exact']],
  },
  show: {
    heading: 'Display',
    shading: 'Surface',
    shadings: [['lit', 'skin, lit'], ['relief', 'relief only'], ['flat', 'colour only']],
    overlay: 'Overlay',
    overlays: [['none', 'none'], ['range', 'spacing of the shape'], ['texture', 'spacing of the colour']],
    legend: 'Spacing held, in samples: 1 is everything there is',
  },
  measure: {
    heading: 'Measured',
    result: millimetres,
    along: (mm: number) => `${millimetres(mm)} along the surface`,
    said: ({ straightMm, alongMm, kind }: Measured) =>
      `${kind === 'distance' ? `${millimetres(straightMm!)} straight, ` : ''}${millimetres(alongMm!)} along the surface`,
    figures: ({ count, kind, straightMm, alongMm, gapsMm }: Measured): [string, string][] => [
      ['Straight, end to end', straightMm === null ? '–' : millimetres(straightMm)],
      ['Along the surface', alongMm === null ? '–' : millimetres(alongMm)],
      ...(gapsMm > 0 ? [['of it over gaps', millimetres(gapsMm)] as [string, string]] : []),
      ...(kind === 'path' ? [['Points', String(count)] as [string, string]] : []),
    ],
    /** isAsked: a click adds a point. */
    advice: ({ kind, count, isSharp }: Measured, isAsked: boolean) => {
      if (count > 1 && !isSharp) return 'Not all of these points are sharp yet: sharpen there, and the figures will follow.';
      if (!isAsked) return '';
      if (count === 0) return 'Click the first point.';
      if (count === 1) return kind === 'path' ? 'Click the next point.' : 'Click the second point.';
      return kind === 'path' ? 'Click on for a longer path.' : 'Click for another distance.';
    },
    undo: 'Take a point back',
    anew: 'Start anew',
  },
  compare: {
    heading: 'Compare',
    beside: 'Beside the open scan',
    none: 'nothing',
    same: (subject: string) => `Also of ${subject}`,
    others: 'Others',
    together: 'Move both together',
    both: 'Sharpen both',
    how: 'If they do not stand alike: let go of “Move both together”, turn one, and take it up again. Together both have one scale.',
    align: 'Same view of both',
    close: 'Close the comparison',
    missing: 'The scan beside is not there any more.',
    noPicture: 'This browser draws no second picture.',
    pins: 'Pins are set on the open scan, the one at the left.',
  },
  pins: {
    heading: 'Pins',
    none: 'No pins yet. Choose “a click sets a pin”.',
    noneYet: 'No pins yet.',
    label: 'Label of the new pin',
    add: 'Set the pin',
    cancel: 'Cancel',
    remove: (label: string) => `Remove pin ${label}`,
    go: (label: string) => `Show pin ${label}`,
    unsaved: 'Kept in this page’s address only: the node does not store pins.',
    conflict: 'Somebody else changed this scan meanwhile; their pins are shown now. Set yours again.',
  },
  about: {
    heading: 'This scan',
    name: 'Name',
    subject: 'Subject code',
    site: 'Body site',
    save: 'Save',
    saved: 'Saved.',
    remove: 'Delete the scan…',
    sure: 'Delete this scan for good? It cannot be brought back.',
    yes: 'Delete it',
    no: 'Keep it',
    download: 'Download',
    formats: { glb: 'GLB', ply: 'PLY', 'obj.zip': 'OBJ', stl: 'STL' } as Record<string, string>,
    copy: 'Copy a link to this view',
    copied: 'The link is in the clipboard.',
    address: 'The page’s address is the link to this view.',
    samples: (width: number, height: number, tw: number, th: number) => `${width} × ${height} points, ${tw} × ${th} texels`,
  },
  copy: {
    make: 'Offline copy of this view…',
    heading: 'Offline copy',
    what: 'One file that shows this view: shape and colour as sharp as you hold them now, with the pins. Any current browser opens it, without the node.',
    beware: 'It is patient data: whoever has the file sees it, without a login, for good.',
    named: 'Say in it whose scan it is: name, subject code, body site',
    no: 'Cancel',
    yes: 'Save the file',
    making: 'The copy is being made…',
    saved: (size: number) => `The copy is among your downloads, ${(size / 1e6).toFixed(1)} MB.`,
    tooMuch: 'So much detail is held that a file of it would be too large. Load the page anew, sharpen what matters, and try again.',
    broken: 'This file is damaged: what it holds cannot be shown. Ask for another copy.',
    said: ({ made }: Held) => `Offline copy, made ${moment(made)}`,
    tools: 'Tools',
    explain: 'What somebody held of a scan. Nothing is fetched and nothing is sent: what is coarse here stays coarse.',
    figures: ({ about, swept, made, node }: Held, places: number): [string, string][] => [
      ...(about ? [['Scan', about] as [string, string]] : []),
      ...(swept === null ? [] : [['Scanned', when(swept)] as [string, string]]),
      ['Copied', moment(made)],
      ['From', node],
      ['Places sharpened', String(places)],
    ],
    file: ({ about, made }: Held) => `${about ? about.replaceAll(' · ', ' ') : 'scan'}, copy of ${made.slice(0, 10)}.html`,
  },
  worth: {
    heading: 'What it is worth',
    sound: 'Nothing speaks against this scan.',
    unknown: 'It was not swept here, so nothing is known of how it was measured.',
    figures: (q: Quality): [string, string][] => [
      ['Measured', `${(100 * q.coverage).toFixed(1)} % of all points`],
      ['Points missing in holes', q.holes.toLocaleString()],
      ['Noise of a point', q.noiseMm === null ? 'unknown: nothing was seen twice' : `${q.noiseMm.toPrecision(2)} mm`],
      ['Moved meanwhile', q.slipDeg === null ? 'unknown: nothing was seen twice' : `${q.slipDeg.toFixed(2)}°`],
      ['Turns averaged', String(q.passes)],
      ['Spikes taken out, holes filled', `${q.spikes}, ${q.filled}`],
      ['Columns asked for again', String(q.requestedColumns)],
      ['Scanner’s axis', q.axis === null ? 'taken as the scanner has it'
        : `corrected by ${q.axis.lateralMm.toFixed(2)} mm sideways, ${q.axis.radialMm.toFixed(2)} mm in range`],
    ],
  },
  role: 'You may look, measure and download here. To sweep, to set pins, to name or delete scans, have this browser paired with the role “operate”.',
  cost: {
    heading: 'What it cost',
    received: 'Received',
    last: 'Last update',
    none: 'nothing yet',
    answer: (bytes: string, ms: number) => `${bytes} in ${ms.toFixed(0)} ms`,
    reached: 'Reached there',
    quality: (db: number | null, mm: number | null) =>
      [db === null ? '' : `colour ${db >= 99 ? 'exact' : `${db.toFixed(1)} dB`}`, mm === null ? '' : `shape within ${mm.toPrecision(2)} mm`]
        .filter(Boolean).join(', ') || 'already as sharp as asked for',
    limited: 'stopped at the limit',
    bandwidth: 'Received, KB/s over the last minute',
    chartQuality: 'Quality of each update, dB',
    kilobytes: 'KB/s',
    decibel: 'dB',
  },
  bytes: (count: number) =>
    count < 1000 ? `${count} B` : count < 1e6 ? `${(count / 1000).toFixed(1)} KB` : `${(count / 1e6).toFixed(2)} MB`,
  failed: (what: string) => `That did not work: ${what}`,
} as const;
