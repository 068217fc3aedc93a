// What a surface is drawn from: squares of cells, and the fans that close a sphere over its poles, many at a time.

import {
  BufferAttribute, DoubleSide, DynamicDrawUsage, GLSL3, InstancedBufferAttribute, InstancedBufferGeometry, Mesh, NoBlending,
  RawShaderMaterial,
} from 'three';
import type { IUniform } from 'three';
import { definesOf, SURFACE_FRAGMENT, SURFACE_VERTEX } from './shaders.ts';

export type Uniforms = Record<string, IUniform>;
export type GridMesh = Mesh<InstancedBufferGeometry, RawShaderMaterial>;

/** Instances of a part, at one stride, of a surface whose textures are shared. */
export function gridMesh(
  { position, index }: Part, stride: number, instances: number, shared: Uniforms, sphere: boolean, isFan = false,
): GridMesh {
  const geometry = new InstancedBufferGeometry();
  geometry.setAttribute('position', position);
  geometry.setIndex(index);
  // Room for all tiles at once: three.js never takes notice of a larger buffer.
  for (const [name, each] of [['tile', 2], ['edges', 4]] as const) {
    geometry.setAttribute(name, new InstancedBufferAttribute(new Float32Array(instances * each), each).setUsage(DynamicDrawUsage));
  }
  geometry.instanceCount = 0;
  const material = new RawShaderMaterial({
    vertexShader: SURFACE_VERTEX, fragmentShader: SURFACE_FRAGMENT, glslVersion: GLSL3, side: DoubleSide, blending: NoBlending,
    uniforms: { ...shared, uStride: { value: stride }, uFan: { value: isFan } }, defines: definesOf(sphere),
  });
  const mesh = new Mesh(geometry, material);
  mesh.frustumCulled = false;
  return mesh;
}

/** Draw a surface with what it holds laid over it, or without: by a program of its own, since a processor would take that way for nothing. */
export function overlay({ material }: GridMesh, sphere: boolean, overlaid: boolean): void {
  material.defines = definesOf(sphere, overlaid);
  material.needsUpdate = true;
}

/** What is drawn again and again. */
interface Part {
  position: BufferAttribute;
  index: BufferAttribute;
}

/** A tile's first row, closed over the upper pole, where z is 1. */
export function fan(cells: number): Part {
  const position = new Float32Array(3 * (cells + 2)).map((_, at) => (at % 3 ? 0 : at / 3));
  const index = new Uint16Array(3 * cells).map((_, at) => [cells + 1, Math.floor(at / 3), Math.floor(at / 3) + 1][at % 3]!);
  position[3 * cells + 5] = 1;
  return { position: new BufferAttribute(position, 3), index: new BufferAttribute(index, 1) };
}

/** A square of cells. */
export function tileGrid(cells: number): Part {
  const side = cells + 1;
  const position = new Float32Array(3 * side * side);
  const index = new Uint16Array(6 * cells * cells);
  for (let y = 0, at = 0; y < side; y++) for (let x = 0; x < side; x++, at += 3) [position[at], position[at + 1]] = [x, y];
  for (let y = 0, at = 0; y < cells; y++) {
    for (let x = 0; x < cells; x++, at += 6) {
      const a = y * side + x;
      index.set([a, a + side, a + 1, a + 1, a + side, a + side + 1], at);
    }
  }
  return { position: new BufferAttribute(position, 3), index: new BufferAttribute(index, 1) };
}

/** Which instances are drawn. */
export function fill(geometry: InstancedBufferGeometry, corners: number[], edges: number[]): void {
  geometry.instanceCount = corners.length / 2;
  for (const [name, values] of [['tile', corners], ['edges', edges]] as const) {
    const attribute = geometry.getAttribute(name) as InstancedBufferAttribute;
    (attribute.array as Float32Array).set(values);
    attribute.needsUpdate = values.length > 0;
  }
}
