// Waiting for the graphics card without keeping the page's thread.

import { Mesh } from 'three';
import type { Camera, Object3D, WebGLRenderer } from 'three';

const LOOK_MS = 4;

/** Once the card has done all that it was told so far. */
export async function cardIsDone(gl: WebGL2RenderingContext): Promise<void> {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  while (fence && !gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
    await aMoment();
  }
  gl.deleteSync(fence);
}

/**
 * Compile what an object is drawn with, for the render target that is set, and ask for what the programs want to be told:
 * three.js would ask at the first picture, and wait for all that the card was given until then.
 */
export async function compile(renderer: WebGLRenderer, object: Object3D, camera: Camera): Promise<void> {
  renderer.compile(object, camera);
  const gl = renderer.getContext() as WebGL2RenderingContext;
  while (!gl.isContextLost() && programsOf(renderer, object).some((program) => !program.isReady())) await aMoment();
  await cardIsDone(gl);
  for (const program of programsOf(renderer, object)) program.getUniforms();
}

interface Program {
  isReady(): boolean;
  getUniforms(): unknown;
}

/** Of an object that is still there. */
function programsOf(renderer: WebGLRenderer, object: Object3D): Program[] {
  const programs: Program[] = [];
  object.traverse((each) => {
    const { currentProgram } = (each instanceof Mesh ? renderer.properties.get(each.material) : {}) as { currentProgram?: Program };
    if (currentProgram) programs.push(currentProgram);
  });
  return programs;
}

const aMoment = (): Promise<void> => new Promise((look) => setTimeout(look, LOOK_MS));
