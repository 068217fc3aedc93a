import { RANGE, TEXTURE } from '../protocol/lattice.ts';
import type { Channel } from '../protocol/lattice.ts';
import { strings } from '../strings.ts';
import type { Shading } from '../view/surface.ts';
import { choice, h, section } from './dom.ts';

const OVERLAYS: Record<string, Channel | null> = { none: null, range: RANGE, texture: TEXTURE };

/** How the surface is shown, and what lies over it. */
export class DisplayPanel {
  readonly element: HTMLElement;
  readonly legend: HTMLElement;

  constructor(changed: () => void, public shading: Shading = 'lit', public overlay: Channel | null = null) {
    const { show } = strings;
    const tell = () => {
      this.legend.hidden = this.overlay === null;
      changed();
    };
    const scale = h('span', { class: 'scale', 'aria-hidden': 'true' });
    this.legend = h('figure', { class: 'legend', hidden: overlay === null }, scale,
      h('span', { class: 'ticks', 'aria-hidden': 'true' }, ...['1', '2', '4', '8+'].map((tick) => h('span', {}, tick))),
      h('figcaption', {}, show.legend));
    this.element = section(show.heading, false,
      choice(show.shading, show.shadings, shading, (value) => {
        this.shading = value as Shading;
        tell();
      }),
      choice(show.overlay, show.overlays, Object.keys(OVERLAYS).find((name) => OVERLAYS[name] === overlay)!, (value) => {
        this.overlay = OVERLAYS[value] ?? null;
        tell();
      }),
    );
  }
}
