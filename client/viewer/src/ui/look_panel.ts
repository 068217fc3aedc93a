import type { LookOptions } from '../link.ts';
import { strings } from '../strings.ts';
import { choice, h, section } from './dom.ts';
import { ToolChoice } from './tool_choice.ts';
import type { Tool } from './tool_choice.ts';

const QUALITIES: Record<string, Pick<LookOptions, 'textureDb' | 'rangeMm'>> = {
  preview: { textureDb: 34, rangeMm: 0.3 },
  fine: { textureDb: 40, rangeMm: 0.1 },
  exact: { textureDb: 100, rangeMm: 0 },
};

/** What a click does, and how sharp. */
export class LookPanel {
  readonly element: HTMLElement;
  readonly tools: ToolChoice;
  follow = false;
  options: LookOptions = { window: 0.05, ...QUALITIES['fine']! };

  constructor(sharpenMiddle: () => void, toolChanged: (tool: Tool) => void) {
    const { look } = strings;
    this.tools = new ToolChoice(['sharpen', 'measure', 'path', 'pin'], toolChanged);
    const follow = h('input', { type: 'checkbox', role: 'switch', change: () => (this.follow = follow.checked) });
    this.element = section(look.heading, true,
      this.tools.element,
      h('button', { type: 'button', class: 'secondary', click: sharpenMiddle }, look.here),
      h('label', {}, follow, look.follow),
      choice(look.quality, look.qualities, 'fine', (value) => Object.assign(this.options, QUALITIES[value])),
      choice(look.area, look.areas, '0.05', (value) => (this.options.window = Number(value))),
      choice(look.falloff, look.falloffs, 'auto', (value) => this.set('alpha', value === 'auto' ? 0 : Number(value))),
      choice(look.time, look.times, '0', (value) => this.set('maxWaitS', Number(value))),
    );
  }

  private set(name: 'maxWaitS' | 'alpha', value: number): void {
    const { [name]: _, ...rest } = this.options;
    this.options = value > 0 ? { ...rest, [name]: value } : rest;
  }
}
