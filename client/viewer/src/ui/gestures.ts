// What pointer and keys mean on the picture; turning, zooming and moving by pointer is the stage's.

const CLICK_MS = 500;
const CLICK_PX = 6;
const HOVER_MS = 200;
const ARROWS: Record<string, [across: number, up: number]> = {
  ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1],
};

export interface Meanings {
  /** A click or tap, at a point of the page. */
  click(x: number, y: number): void;
  /** The pointer rests or moves there, a few times a second. */
  hover(x: number, y: number): void;
  turn(across: number, up: number): void;
  pan(right: number, up: number): void;
  zoom(steps: number): void;
  home(): void;
  /** What a click does, in the middle of the picture. */
  act(): void;
  /** Take the last point back. */
  undo(): void;
  /** What is on its way is not wanted any more. */
  cancel(): void;
}

/** Hear what people do on the picture. */
export function listen(canvas: HTMLCanvasElement, to: Meanings): void {
  let down: PointerEvent | null = null;
  let hovered = 0;
  canvas.addEventListener('pointerdown', (event) => (down = event.isPrimary ? event : null));
  canvas.addEventListener('pointerup', (event) => {
    const still = down && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < CLICK_PX;
    if (still && event.button === 0 && event.timeStamp - down!.timeStamp < CLICK_MS) to.click(event.clientX, event.clientY);
    down = null;
  });
  canvas.addEventListener('pointermove', (event) => {
    if (down || event.timeStamp - hovered <= HOVER_MS) return;
    hovered = event.timeStamp;
    to.hover(event.clientX, event.clientY);
  });
  canvas.addEventListener('keydown', (event) => {
    if (!event.ctrlKey && !event.metaKey && !event.altKey && keyed(event, to)) event.preventDefault();
  });
}

function keyed({ key, shiftKey }: KeyboardEvent, to: Meanings): boolean {
  const arrow = ARROWS[key];
  if (arrow && shiftKey) to.pan(-arrow[0], -arrow[1]);
  else if (arrow) to.turn(...arrow);
  else if (key === '+' || key === '=') to.zoom(1);
  else if (key === '-') to.zoom(-1);
  else if (key === 'Home') to.home();
  else if (key === 'Enter') to.act();
  else if (key === 'Backspace') to.undo();
  else if (key === 'Escape') to.cancel();
  else return false;
  return true;
}
