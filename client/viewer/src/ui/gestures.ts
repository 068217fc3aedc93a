// What pointer and keys mean on the picture; turning, zooming and moving by pointer is the stage's.

const CLICK_MS = 500;
const CLICK_PX = 6;
const HOVER_MS = 200;
const ARROWS: Record<string, [across: number, up: number]> = {
  ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1],
};

export interface Meanings {
  /** The pointer is down at a point of the page: a click or tap, perhaps. */
  press(x: number, y: number): void;
  /** That was one. */
  click(): void;
  /** That is none, or hardly: it moves, is held, is joined by another, is called off. */
  drop(): void;
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
  let pressed: PointerEvent | null = null;
  let patience: ReturnType<typeof setTimeout> | undefined;
  let hovered = 0;
  const isNear = ({ clientX, clientY }: PointerEvent): boolean =>
    pressed !== null && Math.hypot(clientX - pressed.clientX, clientY - pressed.clientY) < CLICK_PX;
  const end = (isClick: boolean): void => {
    if (!pressed) return;
    pressed = null;
    clearTimeout(patience);
    if (isClick) to.click();
    else to.drop();
  };
  canvas.addEventListener('pointerdown', (event) => {
    end(false);
    if (!event.isPrimary || event.button !== 0 || event.ctrlKey || event.metaKey || event.shiftKey) return; // that moves the picture
    pressed = event;
    patience = setTimeout(to.drop, CLICK_MS); // if this thread was kept, it may have been a click all the same
    to.press(event.clientX, event.clientY);
  });
  canvas.addEventListener('pointerup', (event) => end(isNear(event) && event.timeStamp - pressed!.timeStamp < CLICK_MS));
  canvas.addEventListener('pointercancel', () => end(false));
  canvas.addEventListener('pointermove', (event) => {
    if (isNear(event)) event.stopPropagation(); // a hand that shakes moves no camera: that would be drawn before what is clicked
    else end(false);
    if (event.buttons || event.timeStamp - hovered <= HOVER_MS) return;
    hovered = event.timeStamp;
    to.hover(event.clientX, event.clientY);
  });
  canvas.addEventListener('keydown', (event) => {
    if (event.key === 'Escape') end(false);
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
