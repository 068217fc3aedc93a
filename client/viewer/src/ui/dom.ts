// Elements in few words. No markup as text, ever: a strict policy and no injection.

type Attributes = Record<string, string | number | boolean | null | ((event: Event) => void)>;
type Child = Node | string | null;

/** An element. Attributes that are functions are listeners; true is an empty attribute, false and null none. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K, attributes: Attributes = {}, ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  assign(element, attributes);
  element.append(...children.filter((child): child is Node | string => child !== null));
  return element;
}

/** Give an element attributes. */
export function assign(element: Element, attributes: Attributes): void {
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === 'function') element.addEventListener(name, value);
    else if (value !== null && value !== false) element.setAttribute(name, value === true ? '' : String(value));
  }
}

let choices = 0;

/** What can be chosen, in order; an object would put names that are numbers first. */
export type Options = readonly (readonly [value: string, text: string])[];

/** A labelled choice of one of several. */
export function choice(
  label: string, options: Options, chosen: string, changed: (value: string) => void,
): HTMLDivElement {
  const id = `choice-${++choices}`;
  const select = h('select', { id, change: () => changed(select.value) });
  for (const [value, text] of options) select.append(h('option', { value, selected: value === chosen }, text));
  return h('div', {}, h('label', { for: id }, label), select);
}

/** A part of the side panel that folds. */
export function section(heading: string, open: boolean, ...children: Child[]): HTMLDetailsElement {
  return h('details', { open }, h('summary', {}, heading), h('div', { class: 'fold' }, ...children));
}

/** Put these children in place of all others. */
export function refill(element: Element, ...children: Child[]): void {
  element.replaceChildren(...children.filter((child): child is Node | string => child !== null));
}
