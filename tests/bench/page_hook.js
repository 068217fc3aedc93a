// Injected before a page's own scripts: notes in `window.bench` when frames are finished by the renderer, how long
// messages of workers and frames keep the page's thread, its long tasks, when the picture of the scan was painted that
// stands there before, and when what a frame needs was there first. Says on the console when a frame is finished, and
// changes nothing that a page does.
(() => {
  const bench = (window.bench = { frames: [], messages: [], painting: [], tasks: [], first: {}, pressed: null, clicked: null, looked: null, answer: null, poster: null });
  const first = (name) => (bench.first[name] ??= performance.now());
  const timed = (note, work) => {
    const begin = performance.now();
    try {
      return work();
    } finally {
      note(performance.now() - begin);
    }
  };

  new PerformanceObserver((list) => {
    for (const { startTime, duration } of list.getEntries()) bench.tasks.push([startTime, duration]);
  }).observe({ type: 'longtask', buffered: true });
  new PerformanceObserver((list) => {
    for (const { identifier, renderTime } of list.getEntries()) if (identifier === 'poster') bench.poster ??= renderTime;
  }).observe({ type: 'element', buffered: true });
  addEventListener('pointerdown', () => (bench.pressed = performance.now()), true);
  addEventListener('pointerup', () => (bench.clicked = performance.now()), true);

  const ask = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (paint) => ask((now) => {
    const at = performance.now();
    timed((ms) => bench.painting.push([at, ms]), () => paint(now));
  });

  const say = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (message, ...more) {
    first('worker');
    if (message.kind === 'look') bench.looked = performance.now();
    return say.call(this, message, ...more);
  };
  const { get, set } = Object.getOwnPropertyDescriptor(Worker.prototype, 'onmessage');
  Object.defineProperty(Worker.prototype, 'onmessage', {
    get,
    set(hear) {
      set.call(this, (event) => {
        const [at, { kind, link, answer }] = [performance.now(), event.data];
        if (link?.state === 'ready') first('stream');
        if (kind === 'opened') first('view');
        if (answer) bench.answer = answer;
        timed((ms) => bench.messages.push([kind, at, ms]), () => hear.call(this, event));
      });
    },
  });

  // A frame is finished when a fence behind its last command is.
  const finished = (gl, frame) => {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return setTimeout(look, 1);
      frame.end = performance.now();
      console.debug(frame.scan ? 'frame of a scan' : 'frame');
    };
    look();
  };
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    const gl = context.call(this, kind, ...more);
    if (kind !== 'webgl2' || !gl || gl.benched) return gl;
    gl.benched = true;
    first('context');
    const link = gl.linkProgram;
    gl.linkProgram = function (program) {
      first('program');
      return link.call(this, program);
    };
    let frame = null;
    const note = (work) => {
      if (!frame) {
        frame = { begin: performance.now(), scan: document.documentElement.dataset.scan ?? '', triangles: 0, end: null };
        queueMicrotask(() => {
          bench.frames.push(frame);
          finished(gl, frame);
          frame = null;
        });
      }
      frame.triangles += work;
    };
    const [draw, clear] = [gl.drawElementsInstanced, gl.clear];
    gl.drawElementsInstanced = function (mode, count, type, offset, instances) {
      note((count / 3) * instances);
      return draw.call(this, mode, count, type, offset, instances);
    };
    gl.clear = function (mask) {
      note(0);
      return clear.call(this, mask);
    };
    return gl;
  };
})();
