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
  private shading: Shading = 'lit';
  private overlay: Channel | null = null;

  constructor(changed: (shading: Shading, overlay: Channel | null) => void) {
    const { show } = strings;
    const tell = () => {
      this.legend.hidden = this.overlay === null;
      changed(this.shading, this.overlay);
    };
    const scale = h('span', { class: 'scale', 'aria-hidden': 'true' });
    this.legend = h('figure', { class: 'legend', hidden: true }, scale,
      h('span', { class: 'ticks', 'aria-hidden': 'true' }, ...['1', '2', '4', '8+'].map((tick) => h('span', {}, tick))),
      h('figcaption', {}, show.legend));
    this.element = section(show.heading, false,
      choice(show.shading, show.shadings, 'lit', (value) => {
        this.shading = value as Shading;
        tell();
      }),
      choice(show.overlay, show.overlays, 'none', (value) => {
        this.overlay = OVERLAYS[value] ?? null;
        tell();
      }),
    );
  }
}
