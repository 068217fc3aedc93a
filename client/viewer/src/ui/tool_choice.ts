import type { Kind } from '../measuring.ts';
import { strings } from '../strings.ts';
import { h } from './dom.ts';

/** What a click on the picture does; in an offline copy nothing can be sharpened, so it may do nothing. */
export type Tool = keyof typeof strings.look.tools;

const KINDS: Partial<Record<Tool, Kind>> = { measure: 'distance', path: 'path' };

/** What a tool measures, if it does. */
export const kindOf = (tool: Tool): Kind | null => KINDS[tool] ?? null;

/** One of several tools. */
export class ToolChoice {
  readonly element: HTMLElement;
  private readonly radios = new Map<Tool, HTMLInputElement>();

  tool: Tool;

  /** The first of the tools is chosen. */
  constructor(tools: [Tool, ...Tool[]], changed: (tool: Tool) => void) {
    const { look } = strings;
    this.tool = tools[0];
    const labels = tools.map((value) => {
      const change = () => changed((this.tool = value));
      const radio = h('input', { type: 'radio', name: 'tool', value, checked: value === this.tool, change });
      this.radios.set(value, radio);
      return h('label', {}, radio, look.tools[value]);
    });
    this.element = h('fieldset', { class: 'row' }, h('legend', {}, look.tool), ...labels);
  }

  /** Whether a tool can be chosen; where it was, another one is now. */
  allow(tool: Tool, allowed: boolean): void {
    this.radios.get(tool)!.parentElement!.hidden = !allowed;
    if (!allowed && this.tool === tool) [...this.radios.values()][0]!.click();
  }
}
