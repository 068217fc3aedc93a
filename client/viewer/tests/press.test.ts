import assert from 'node:assert/strict';
import { mock, test } from 'node:test';
import type { Answer } from '../src/link.ts';
import { Looks } from '../src/looks.ts';
import { listen } from '../src/ui/gestures.ts';

const [HERE, THERE] = [{ u: 0.25, v: 0.5 }, { u: 0.5, v: 0.5 }];
const answerTo = (look: number, reason: Answer['reason'] = 'complete'): Answer =>
  ({ look, reason, bytes: 1, elapsedMs: 1, nodeMs: 1, applyMs: 1, errorMaxMm: null, textureDb: null });

function watched(): { looks: Looks; told: string[] } {
  const told: string[] = [];
  const looks = new Looks({
    ask: (look, { u }) => told.push(`ask ${look} ${u}`),
    cancel: (look) => told.push(`cancel ${look}`),
    awaited: (place) => told.push(place ? `awaited ${place.u}` : 'awaited nothing'),
    answered: ({ look }) => told.push(`answered ${look}`),
    ended: () => told.push('ended'),
  });
  return { looks, told };
}

test('a press asks, and a click there asks no more, whether it was answered before or after', () => {
  for (const isEarly of [true, false]) {
    const { looks, told } = watched();
    looks.ahead(HERE);
    if (isEarly) looks.answered(answerTo(1));
    assert.deepEqual([told, looks.foveae], [['ask 1 0.25'], []], 'nobody is told before it is a click');
    looks.at(HERE);
    if (!isEarly) looks.answered(answerTo(1));
    assert.deepEqual(told.filter((one) => !one.startsWith('awaited')), ['ask 1 0.25', 'answered 1', 'ended']);
    assert.deepEqual([looks.foveae, told.includes('awaited 0.25')], [[HERE], !isEarly]);
  }
});

test('a press that is no click is taken back, and leaves nothing', () => {
  for (const isEarly of [true, false]) {
    const { looks, told } = watched();
    looks.ahead(HERE);
    if (isEarly) looks.answered(answerTo(1));
    looks.takeBack(HERE);
    if (!isEarly) looks.answered(answerTo(1)); // it was on its way
    assert.deepEqual(told, isEarly ? ['ask 1 0.25'] : ['ask 1 0.25', 'cancel 1']);
    assert.deepEqual(looks.foveae, []);
    looks.at(HERE);
    assert.equal(told.filter((one) => one === 'ask 2 0.25').length, 1, 'a click is one anew');
  }
});

test('a press ends nothing that is on its way; a click does', () => {
  const { looks, told } = watched();
  looks.all([HERE, THERE]);
  looks.ahead(THERE);
  looks.takeBack(THERE);
  assert.deepEqual(told, ['ask 1 0.25', 'awaited 0.25']);
  looks.answered(answerTo(1));
  const place = { ...HERE };
  looks.ahead(place);
  looks.at(place);
  looks.answered(answerTo(2)); // overtaken
  looks.answered(answerTo(3));
  assert.deepEqual(told.filter((one) => one.startsWith('ask')), ['ask 1 0.25', 'ask 2 0.5', 'ask 3 0.25']);
  assert.deepEqual(looks.foveae, [HERE, place]);
});

test('a look ahead that something else has overtaken, or the node has ended, is asked for again by the click', () => {
  const overtake: ((looks: Looks) => void)[] = [
    (looks) => looks.at(THERE), (looks) => looks.answered(answerTo(1, 'superseded')), (looks) => looks.refused(1), (looks) => looks.clear(),
  ];
  for (const overtaken of overtake) {
    const { looks, told } = watched();
    looks.ahead(HERE);
    overtaken(looks);
    looks.at(HERE);
    const asked = told.filter((one) => one.startsWith('ask'));
    assert.deepEqual([asked[0], asked.at(-1)], ['ask 1 0.25', `ask ${asked.length} 0.25`]);
    assert.ok(asked.length > 1);
    looks.answered(answerTo(asked.length));
    assert.deepEqual(looks.foveae, [HERE]);
  }
});

/** What is heard of the pointer when it does that, one after the other. */
function heard(...events: [type: string, what?: Partial<PointerEvent> | { key: string } | { heldMs: number }][]): string[] {
  const [canvas, told] = [new EventTarget(), [] as string[]];
  const note = (name: string) => () => told.push(name);
  listen(canvas as HTMLCanvasElement, {
    press: (x) => told.push(`press ${x}`), click: note('click'), drop: note('drop'), hover: note('hover'), turn: note('turn'), pan: note('pan'),
    zoom: note('zoom'), home: note('home'), act: note('act'), undo: note('undo'), cancel: note('cancel'),
  });
  for (const [type, what] of events) {
    if (what && 'heldMs' in what) mock.timers.tick(what.heldMs);
    const event = new Event(type);
    const all = { clientX: 10, clientY: 10, isPrimary: true, button: 0, buttons: type === 'pointerup' ? 0 : 1, timeStamp: 1000, ...what };
    for (const [name, value] of Object.entries(all)) Object.defineProperty(event, name, { value });
    canvas.dispatchEvent(event);
    if (event.cancelBubble) told.push('kept');
  }
  return told;
}

test('a press is a click if it ends soon and where it began', () => {
  const [down, up]: [string][] = [['pointerdown'], ['pointerup']];
  assert.deepEqual(heard(down!, ['pointermove', { clientX: 13 }], ['pointerup', { clientX: 14, timeStamp: 1400 }]), ['press 10', 'kept', 'click'], 'and no camera hears that it shook');
  assert.deepEqual(heard(down!, ['pointermove', { clientX: 17 }], up!), ['press 10', 'drop'], 'it was a drag, though it came back');
  assert.deepEqual(heard(down!, ['pointerup', { clientX: 17 }]), ['press 10', 'drop']);
  assert.deepEqual(heard(down!, ['pointerup', { timeStamp: 1600 }]), ['press 10', 'drop'], 'it was held');
  assert.deepEqual(heard(down!, ['pointerdown', { isPrimary: false }], up!), ['press 10', 'drop'], 'two fingers');
  assert.deepEqual(heard(down!, ['pointercancel'], up!), ['press 10', 'drop']);
  assert.deepEqual(heard(down!, ['keydown', { key: 'Escape' }], up!), ['press 10', 'drop', 'cancel']);
});

test('what is held is taken back meanwhile, though if it was only heard late it is a click', () => {
  mock.timers.enable({ apis: ['setTimeout'] });
  assert.deepEqual(heard(['pointerdown'], ['pointermove', { heldMs: 600 }]), ['press 10', 'drop', 'kept']);
  assert.deepEqual(heard(['pointerdown'], ['pointermove', { heldMs: 600 }], ['pointerup', { timeStamp: 1100 }]), ['press 10', 'drop', 'kept', 'click']);
  assert.deepEqual(heard(['pointerdown'], ['pointerup'], ['pointermove', { heldMs: 600, buttons: 0 }]), ['press 10', 'click', 'hover']);
  mock.timers.reset();
});

test('other buttons and keys that move the picture press nothing, and nothing hovers that is pressed', () => {
  for (const other of [{ button: 2 }, { shiftKey: true }, { ctrlKey: true }, { metaKey: true }, { isPrimary: false }]) {
    assert.deepEqual(heard(['pointerdown', other], ['pointermove', { buttons: 2 }], ['pointerup']), []);
  }
  assert.deepEqual(heard(['pointermove', { buttons: 0 }], ['pointermove', { buttons: 0, timeStamp: 1100 }]), ['hover']);
});
