// Normals of the range as a texture, drawn by a pass over the rectangles that changed.

import {
  BufferAttribute, BufferGeometry, Camera, ClampToEdgeWrapping, GLSL3, LinearFilter, Mesh, NoBlending, RawShaderMaterial, RepeatWrapping,
  Scene, Vector2, WebGLRenderTarget,
} from 'three';
import type { DataTexture, WebGLRenderer } from 'three';
import type { Changed } from '../protocol/model.ts';
import { compile } from './compile.ts';
import type { Uniforms } from './grid_mesh.ts';
import { COPY_FRAGMENT, definesOf, NORMALS_FRAGMENT, QUAD_VERTEX } from './shaders.ts';

type Rectangle = Omit<Changed, 'cells'>;

export class Normals {
  /** So far from samples that change, normals may. */
  readonly reach: number;
  private target: WebGLRenderTarget;
  private due: 'all' | Rectangle[] = 'all';
  private readonly pass: Pass;
  private readonly copy: Pass;

  /**
   * uniforms: of the surface; `uNormals` among them is kept up to date. level: of range, by 8 x 8 blocks.
   * spacing: between the samples held, at least and at most: a texture as coarse as half the least shows as much, and is
   * drawn sooner.
   * thinned: every how many-th sample is there to be drawn.
   */
  constructor(
    private readonly renderer: WebGLRenderer, private readonly width: number, private readonly height: number, private readonly thinned: number,
    private readonly uniforms: Uniforms, private readonly sphere: boolean, level: DataTexture, spacing: readonly [least: number, most: number],
  ) {
    const stride = Math.max(thinned, spacing[0] / 2);
    // A sphere's samples are means of those beside them, as far again.
    this.reach = Math.ceil(Math.max(thinned, spacing[1])) * (sphere ? 2 : 1) + 1;
    this.pass = new Pass(NORMALS_FRAGMENT, sphere, { ...uniforms, uLevel: { value: level }, uCell: { value: new Vector2(1, 1) } });
    this.copy = new Pass(COPY_FRAGMENT, false, { uFrom: { value: null }, uTo: { value: this.whole } });
    this.target = targetOf(Math.ceil(width / stride), Math.ceil(height / stride));
    uniforms['uNormals']!.value = this.target.texture;
  }

  /** Have the program compiled that the first picture takes. */
  compile(): Promise<void> {
    return this.pass.compile(this.renderer, this.target);
  }

  /** Have the other one compiled, that `fill` takes. */
  compileFill(): Promise<void> {
    return this.copy.compile(this.renderer, this.target);
  }

  /** As large as there are samples to be drawn. */
  private get whole(): Vector2 {
    return new Vector2(this.width, this.height).divideScalar(this.thinned).ceil();
  }

  /** Whether there is a normal for every sample. */
  get isFull(): boolean {
    return this.target.width === this.whole.x;
  }

  /** Have one for every sample from here on. */
  fill(): void {
    if (this.isFull) return;
    this.drawDue();
    const coarse = this.target;
    this.target = targetOf(this.whole.x, this.whole.y);
    this.copy.uniforms['uFrom']!.value = coarse.texture;
    this.render(this.copy, 0, 0, this.width, this.height);
    coarse.dispose();
    this.uniforms['uNormals']!.value = this.target.texture;
  }

  /** All samples have changed. */
  changeAll(): void {
    this.due = 'all';
  }

  /** These samples have changed. */
  change(rectangle: Rectangle): void {
    this.fill();
    if (this.due !== 'all') this.due.push(rectangle);
  }

  /** Draw the normals of what has changed. */
  drawDue(): void {
    if (this.due === 'all') this.render(this.pass, 0, 0, this.width, this.height);
    else for (const rectangle of this.due) this.draw(rectangle);
    this.due = [];
  }

  private draw({ x, y, width, height }: Rectangle): void {
    const [top, bottom] = [Math.max(0, y - this.reach), Math.min(this.height, y + height + this.reach)];
    const reach = this.reachRound(top, bottom);
    const [left, right] = [Math.max(0, x - reach), Math.min(this.width, x + width + reach)];
    this.render(this.pass, left, top, right, bottom);
    if (left === 0) this.render(this.pass, Math.max(right, this.width + x - reach), top, this.width, bottom);
    if (right === this.width) this.render(this.pass, 0, top, Math.min(left, x + width + reach - this.width), bottom);
  }

  /** The same round: on a sphere, columns of these rows are as narrow as the ring next to a pole is short. */
  private reachRound(top: number, bottom: number): number {
    if (!this.sphere) return this.reach;
    const ring = Math.min(Math.sin((Math.PI * top) / this.height), Math.sin((Math.PI * bottom) / this.height));
    return Math.min(Math.ceil(this.reach / Math.max(ring, 1e-6)), this.width);
  }

  dispose(): void {
    this.target.dispose();
    this.pass.dispose();
    this.copy.dispose();
  }

  /** Have a pass draw where these samples are. */
  private render(pass: Pass, left: number, top: number, right: number, bottom: number): void {
    if (right <= left) return;
    const before = this.renderer.getRenderTarget();
    const [across, down] = [this.width / this.target.width, this.height / this.target.height];
    (pass.uniforms['uCell']?.value as Vector2 | undefined)?.set(across, down);
    const [x, y] = [Math.floor(left / across), Math.floor(top / down)];
    this.target.scissorTest = true;
    this.target.scissor.set(x, y, Math.ceil(right / across) - x, Math.ceil(bottom / down) - y);
    this.renderer.setRenderTarget(this.target);
    pass.render(this.renderer);
    this.renderer.setRenderTarget(before);
  }
}

function targetOf(width: number, height: number): WebGLRenderTarget {
  return new WebGLRenderTarget(width, height, {
    depthBuffer: false, wrapS: RepeatWrapping, wrapT: ClampToEdgeWrapping, minFilter: LinearFilter, magFilter: LinearFilter,
    generateMipmaps: false,
  });
}

/** A fragment shader over all of a target. */
class Pass {
  private readonly scene = new Scene();
  private readonly camera = new Camera();
  private readonly quad: Mesh<BufferGeometry, RawShaderMaterial>;

  constructor(fragmentShader: string, sphere: boolean, readonly uniforms: Uniforms) {
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    const material = new RawShaderMaterial({
      vertexShader: QUAD_VERTEX, fragmentShader, glslVersion: GLSL3, blending: NoBlending, depthTest: false, depthWrite: false, uniforms,
      defines: definesOf(sphere),
    });
    this.quad = new Mesh(geometry, material);
    this.quad.frustumCulled = false;
    this.scene.add(this.quad);
  }

  async compile(renderer: WebGLRenderer, target: WebGLRenderTarget): Promise<void> {
    renderer.setRenderTarget(target); // the program depends on it
    const compiled = compile(renderer, this.scene, this.camera);
    renderer.setRenderTarget(null);
    await compiled;
  }

  render(renderer: WebGLRenderer): void {
    renderer.render(this.scene, this.camera);
  }

  dispose(): void {
    this.quad.geometry.dispose();
    this.quad.material.dispose();
  }
}
