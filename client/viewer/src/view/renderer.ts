// What draws: three.js on a graphics context, and whether a graphics card is behind that.

import { WebGLRenderer } from 'three';

/** A renderer of a canvas. It asks the card a lot, and waits for each answer: so it is made apart from what else a page begins with. */
export function rendererOf(canvas: HTMLCanvasElement, context: WebGL2RenderingContext): WebGLRenderer {
  const renderer = new WebGLRenderer({ canvas, context, alpha: true });
  renderer.debug.checkShaderErrors = false; // asking waits for the compiler
  renderer.sortObjects = false; // it would measure every vertex
  renderer.setClearColor(0, 0);
  return renderer;
}

/** Whether the processor draws, because there is no graphics card. */
export function drawsInSoftware(renderer: WebGLRenderer): boolean {
  const context = renderer.getContext();
  const named = context.getExtension('WEBGL_debug_renderer_info');
  const name = String(context.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : context.RENDERER));
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
