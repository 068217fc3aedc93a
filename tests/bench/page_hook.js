// Injected before a page's own scripts: notes in `window.bench` when frames are finished by the renderer, how long
// messages of workers and frames keep the page's thread, and its long tasks. Changes nothing that a page does.
(() => {
  const bench = (window.bench = { frames: [], messages: [], painting: [], tasks: [], clicked: null });
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
  addEventListener('pointerup', () => (bench.clicked = performance.now()), true);

  const ask = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (paint) => ask((now) => {
    const at = performance.now();
    timed((ms) => bench.painting.push([at, ms]), () => paint(now));
  });

  const { get, set } = Object.getOwnPropertyDescriptor(Worker.prototype, 'onmessage');
  Object.defineProperty(Worker.prototype, 'onmessage', {
    get,
    set(hear) {
      set.call(this, (event) => {
        const at = performance.now();
        timed((ms) => bench.messages.push([event.data.kind, at, ms]), () => hear.call(this, event));
      });
    },
  });

  // A frame is finished when a fence behind its last command is.
  const finished = (gl, frame) => {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      if (gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED) frame.end = performance.now();
      else setTimeout(look, 1);
    };
    look();
  };
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    const gl = context.call(this, kind, ...more);
    if (kind !== 'webgl2' || !gl || gl.benched) return gl;
    gl.benched = true;
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
