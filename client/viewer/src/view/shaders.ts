// Range in the vertex shader, normals from the range, colour where it is refined over colour of the first view.

/** What every stage needs of the grid. */
const GRID = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D uRange;
uniform ivec2 uSize;
uniform float uStepMm;
uniform float uPitchMm;
const float TURN = 6.283185307179586;

int wrap(int column) {
  return (column % uSize.x + uSize.x) % uSize.x;
}

uint stepsAt(int column, int row) {
  return texelFetch(uRange, ivec2(wrap(column), clamp(row, 0, uSize.y - 1)), 0).r;
}
`;

/**
 * position.xy: vertex of a tile, in strides. tile: its first column and row. edges: strides of the tiles to the left,
 * right, above and below. A vertex on an edge moves to the coarser neighbour's next one, so that no crack opens.
 */
export const SURFACE_VERTEX = /* glsl */ `
${GRID}
uniform float uZMaxMm;
uniform float uTheta0;
uniform int uStride;
uniform int uTile;
in vec2 tile;
in vec4 edges;
out vec2 vUv;
out vec3 vWorld;

int snapped(int along, float stride) {
  int step = int(stride);
  return along - along % step;
}

float radiusSteps(int column, int row) {
  uint own = stepsAt(column, row);
  if (own != 0u) return float(own);
  float sum = 0.0, count = 0.0;
  for (int y = -1; y <= 1; y++) {
    for (int x = -1; x <= 1; x++) {
      float near = float(stepsAt(column + x * uStride, row + y * uStride));
      sum += near;
      count += float(near > 0.0);
    }
  }
  return count > 0.0 ? sum / count : -1.0;
}

void main() {
  int last = uTile / uStride;
  ivec2 vertex = ivec2(position.xy);
  int column = int(tile.x) + vertex.x * uStride;
  int row = int(tile.y) + vertex.y * uStride;
  if (vertex.x == 0) row = snapped(row, edges.x);
  if (vertex.x == last) row = snapped(row, edges.y);
  if (vertex.y == 0) column = snapped(column, edges.z);
  if (vertex.y == last) column = snapped(column, edges.w);
  column = min(column, uSize.x);
  row = min(row, uSize.y - 1);
  float steps = radiusSteps(column, row);
  float angle = uTheta0 + TURN * (float(column) + 0.5) / float(uSize.x);
  float radius = steps * uStepMm;
  vec3 local = vec3(radius * cos(angle), uZMaxMm - (float(row) + 0.5) * uPitchMm, -radius * sin(angle));
  vUv = (vec2(column, row) + 0.5) / vec2(uSize);
  vWorld = local;
  // Nothing was measured near here: a vertex behind the far plane takes its triangles with it.
  gl_Position = steps > 0.0 ? projectionMatrix * viewMatrix * vec4(local, 1.0) : vec4(0.0, 0.0, 2.0, 1.0);
}
`;

export const SURFACE_FRAGMENT = /* glsl */ `
precision highp float;
precision highp usampler2D;
uniform sampler2D uNormals;
uniform sampler2D uCoarse;
uniform sampler2D uDense;
uniform usampler2D uLevel;
uniform vec2 uLevelScale;
uniform float uTheta0;
uniform vec3 uKey;
uniform vec3 uFill;
uniform int uMode;
uniform float uOverlay;
in vec2 vUv;
in vec3 vWorld;
out vec4 colour;
const float TURN = 6.283185307179586;

vec3 toLinear(vec3 c) {
  return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c));
}

vec3 toSrgb(vec3 c) {
  return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}

/* Sharp is clear, coarse is warm: spacing 1, 2, 4, 8 and more. */
vec3 spacingColour(float level) {
  float t = clamp(level / 6.0, 0.0, 1.0);
  return mix(vec3(0.05, 0.55, 0.75), mix(vec3(0.98, 0.75, 0.15), vec3(0.75, 0.12, 0.35), smoothstep(0.5, 1.0, t)), smoothstep(0.0, 0.5, t));
}

void main() {
  vec4 packed = texture(uNormals, vUv);
  if (packed.a < 0.5) discard;
  vec3 along = normalize(packed.rgb / packed.a * 2.0 - 1.0);
  float angle = uTheta0 + TURN * vUv.x;
  vec3 outward = vec3(cos(angle), 0.0, -sin(angle));
  vec3 round = vec3(-sin(angle), 0.0, -cos(angle));
  vec3 normal = normalize(along.x * outward + along.y * round + along.z * vec3(0.0, 1.0, 0.0));
  vec3 view = normalize(cameraPosition - vWorld);
  bool inside = !gl_FrontFacing;
  if (inside) normal = -normal;

  vec4 dense = texture(uDense, vUv);
  vec4 coarse = texture(uCoarse, vUv);
  vec3 texel = mix(coarse.rgb / max(coarse.a, 0.01), dense.rgb / max(dense.a, 0.01), step(0.5, dense.a));
  if (coarse.a < 0.01) texel = vec3(0.72);
  vec3 albedo = uMode == 1 ? vec3(0.58, 0.57, 0.55) : toLinear(texel);
  if (uMode == 2 && !inside) {
    colour = vec4(texel, 1.0);
  } else {
    float wrapLight = uMode == 1 ? 0.05 : 0.25;
    float key = max(0.0, (dot(normal, uKey) + wrapLight) / (1.0 + wrapLight));
    float fill = max(0.0, dot(normal, uFill));
    float sky = 0.5 + 0.5 * normal.y;
    vec3 light = vec3(1.0, 0.975, 0.94) * 0.78 * key + vec3(0.86, 0.92, 1.0) * 0.16 * fill + mix(0.13, 0.27, sky);
    vec3 halfway = normalize(uKey + view);
    float gloss = (uMode == 1 ? 0.06 : 0.025) * pow(max(0.0, dot(normal, halfway)), 24.0);
    vec3 lit = albedo * light + gloss;
    if (inside) lit *= 0.35;
    colour = vec4(toSrgb(clamp(lit, 0.0, 1.0)), 1.0);
  }
  if (uOverlay > 0.0) {
    float level = float(texelFetch(uLevel, ivec2(fract(vUv.x) * uLevelScale.x, min(vUv.y, 0.99999) * uLevelScale.y), 0).r);
    float grey = dot(colour.rgb, vec3(0.3, 0.6, 0.1));
    colour.rgb = mix(colour.rgb, spacingColour(level) * (0.35 + 0.75 * grey), uOverlay);
  }
}
`;

export const QUAD_VERTEX = /* glsl */ `
void main() {
  gl_Position = vec4(position.xy, 0.0, 1.0);
}
`;

/**
 * Normals of range samples, (outward, round, up) and whether there is one, both times that. Differences are taken over
 * the spacing held, so that what was interpolated between coarse samples looks as smooth as it is. uCell: samples that
 * one normal stands for.
 */
export const NORMALS_FRAGMENT = /* glsl */ `
${GRID}
uniform usampler2D uLevel;
uniform vec2 uCell;
out vec4 packed;

int levelAt(int column, int row) {
  return int(texelFetch(uLevel, ivec2(wrap(column), clamp(row, 0, uSize.y - 1)) / 8, 0).r);
}

/* Steps at a neighbour, or 0 where none is, or only a coarser guess: that would draw a scar round what is sharp. */
float known(int column, int row, int level) {
  if (row < 0 || row >= uSize.y || levelAt(column, row) > level + 1) return 0.0;
  return float(stepsAt(column, row));
}

float slope(int column, int row, int dx, int dy, int level, float here) {
  float before = known(column - dx, row - dy, level), after = known(column + dx, row + dy, level);
  float sides = float(before > 0.0) + float(after > 0.0);
  if (sides == 0.0) return 0.0;
  return ((after > 0.0 ? after : here) - (before > 0.0 ? before : here)) / (sides * float(dx + dy));
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy * uCell);
  float here = float(stepsAt(at.x, at.y));
  if (here == 0.0) {
    packed = vec4(0.0);
    return;
  }
  int level = levelAt(at.x, at.y);
  int reach = max(1, int(exp2(0.5 * float(level)) + 0.5));
  float roundSlope = slope(at.x, at.y, reach, 0, level, here) * float(uSize.x) / (TURN * here);
  float downSlope = slope(at.x, at.y, 0, reach, level, here) * uStepMm / uPitchMm;
  vec3 normal = normalize(vec3(1.0, -roundSlope, downSlope));
  packed = vec4(normal * 0.5 + 0.5, 1.0);
}
`;

/** A texture, stretched over a larger one. */
export const COPY_FRAGMENT = /* glsl */ `
precision highp float;
uniform sampler2D uFrom;
uniform ivec2 uSize;
out vec4 copied;

void main() {
  copied = texture(uFrom, gl_FragCoord.xy / vec2(uSize));
}
`;
