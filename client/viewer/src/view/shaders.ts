// Range in the vertex shader, normals from the range, colour where it is refined over colour of the first view.
// A sphere's directions are found again at each pixel: near a pole nothing else is the same all over a triangle.

/** What every stage needs of the grid. */
const GRID = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D uRange;
uniform ivec2 uSize;
uniform float uStepMm;
uniform float uPitchMm;
uniform bool uSphere;
const float TURN = 6.283185307179586;
const float HALF_TURN = 3.141592653589793;

/* Any column and row as one of the grid's: past a pole down the other side. */
ivec2 inside(int column, int row) {
  if (uSphere && (row < 0 || row >= uSize.y)) {
    column += uSize.x / 2;
    row = row < 0 ? -1 - row : 2 * uSize.y - 1 - row;
  }
  return ivec2((column % uSize.x + uSize.x) % uSize.x, clamp(row, 0, uSize.y - 1));
}

uint stepsAt(int column, int row) {
  return texelFetch(uRange, inside(column, row), 0).r;
}
`;

/**
 * position.xy: vertex of a tile, in strides. tile: its first column and row. edges: strides of the tiles to the left,
 * right, above and below. A vertex on an edge moves to the coarser neighbour's next one, so that no crack opens.
 * A fan closes a tile's first or last row (tile.y 0 or 1) over the pole, where position.z is 1.
 */
export const SURFACE_VERTEX = /* glsl */ `
${GRID}
uniform float uZMaxMm;
uniform float uTheta0;
uniform int uStride;
uniform int uTile;
uniform bool uFan;
uniform vec2 uPoles;
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

vec3 placed(float radius, float angle, float row) {
  float polar = HALF_TURN * row / float(uSize.y);
  float level = uSphere ? radius * sin(polar) : radius;
  float up = uSphere ? radius * cos(polar) : -row * uPitchMm;
  return vec3(level * cos(angle), uZMaxMm + up, -level * sin(angle));
}

void main() {
  int last = uTile / uStride;
  ivec2 vertex = ivec2(position.xy);
  bool below = uFan && tile.y > 0.5;
  int column = int(tile.x) + vertex.x * uStride;
  int row = int(tile.y) + vertex.y * uStride;
  if (uFan) {
    column = int(tile.x) + (below ? last - vertex.x : vertex.x) * uStride;
    row = below ? uSize.y - 1 : 0;
  } else {
    if (vertex.x == 0) row = snapped(row, edges.x);
    if (vertex.x == last) row = snapped(row, edges.y);
    if (vertex.y == 0) column = snapped(column, edges.z);
    if (vertex.y == last) column = snapped(column, edges.w);
  }
  column = min(column, uSize.x);
  row = min(row, uSize.y - 1);
  bool pole = position.z > 0.5;
  float steps = pole ? (below ? uPoles.y : uPoles.x) : radiusSteps(column, row);
  float angle = uTheta0 + TURN * (float(column) + 0.5) / float(uSize.x);
  vec3 local = placed(steps * uStepMm, angle, pole ? (below ? float(uSize.y) : 0.0) : float(row) + 0.5);
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
uniform bool uSphere;
uniform float uZMaxMm;
uniform float uTheta0;
uniform vec3 uKey;
uniform vec3 uFill;
uniform int uMode;
uniform float uOverlay;
in vec2 vUv;
in vec3 vWorld;
out vec4 colour;
const float TURN = 6.283185307179586;
const float HALF_TURN = 3.141592653589793;

/* What is in a pixel: its place on the scan, how that changes across it, and which way is out, round and up there. */
struct Place {
  vec2 uv;
  vec2 dx;
  vec2 dy;
  vec3 outward;
  vec3 round;
  vec3 up;
};

Place onCylinder() {
  float angle = uTheta0 + TURN * vUv.x;
  vec3 outward = vec3(cos(angle), 0.0, -sin(angle)), round = vec3(-sin(angle), 0.0, -cos(angle));
  return Place(vUv, dFdx(vUv), dFdy(vUv), outward, round, vec3(0.0, 1.0, 0.0));
}

/* Lengths along a ring count as on the equator: else the texture would be blurred ever more towards a pole. */
Place onSphere() {
  vec3 outward = normalize(vWorld - vec3(0.0, uZMaxMm, 0.0));
  float level = length(outward.xz);
  vec2 across = level > 0.0 ? vec2(outward.x, -outward.z) / level : vec2(1.0, 0.0);
  vec3 round = vec3(-across.y, 0.0, -across.x), up = vec3(-outward.y * across.x, level, outward.y * across.y);
  vec2 uv = vec2(fract((atan(across.y, across.x) - uTheta0) / TURN), atan(level, outward.y) / HALF_TURN);
  vec3 dx = dFdx(outward), dy = dFdy(outward);
  mat2x3 along = mat2x3(round / TURN, up / -HALF_TURN);
  return Place(uv, dx * along, dy * along, outward, round, up);
}

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
  Place at;
  if (uSphere) at = onSphere();
  else at = onCylinder();
  vec4 packed = textureLod(uNormals, at.uv, 0.0);
  if (packed.a < 0.5) discard;
  vec3 along = normalize(packed.rgb / packed.a * 2.0 - 1.0);
  vec3 normal = normalize(along.x * at.outward + along.y * at.round + along.z * at.up);
  vec3 view = normalize(cameraPosition - vWorld);
  bool inside = !gl_FrontFacing;
  if (inside) normal = -normal;

  vec4 dense = textureGrad(uDense, at.uv, at.dx, at.dy);
  vec4 coarse = textureLod(uCoarse, at.uv, 0.0);
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
    float level = float(texelFetch(uLevel, ivec2(vec2(fract(at.uv.x), min(at.uv.y, 0.99999)) * uLevelScale), 0).r);
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
 * the spacing held, so that what was interpolated between coarse samples looks as smooth as it is. Towards a sphere's
 * poles columns draw together. There samples beside one are sought along great circles, and each is the mean of those
 * that lie as close on its ring: they have errors of their own, which would draw a star. uCell: samples that one normal
 * stands for.
 */
export const NORMALS_FRAGMENT = /* glsl */ `
${GRID}
uniform usampler2D uLevel;
uniform vec2 uCell;
out vec4 packed;
const int TAPS = 4;

int levelAt(int column, int row) {
  return int(texelFetch(uLevel, inside(column, row) / 8, 0).r);
}

/* How much narrower columns are than on the equator. */
float ringAt(int row) {
  return uSphere ? sin(HALF_TURN * (float(row) + 0.5) / float(uSize.y)) : 1.0;
}

/* Steps of a sample, of some beside it too where columns are narrow. */
float meanSteps(ivec2 at, int reach) {
  float own = float(texelFetch(uRange, at, 0).r);
  int apart = min(int(float(reach) / ringAt(at.y)), uSize.x / 8) / (2 * TAPS);
  if (apart == 0 || own == 0.0) return own;
  float sum = 0.0, count = 0.0;
  for (int k = -TAPS; k <= TAPS; k++) {
    float near = float(stepsAt(at.x + k * apart, at.y));
    sum += near;
    count += float(near > 0.0);
  }
  return sum / count;
}

/* Steps at a neighbour, or 0 where none is, or only a coarser guess: that would draw a scar round what is sharp. */
float known(int column, int row, int level, int reach) {
  if (!uSphere && (row < 0 || row >= uSize.y) || levelAt(column, row) > level + 1) return 0.0;
  return meanSteps(inside(column, row), reach);
}

/* The same between two rows. */
float knownBetween(int column, float row, int level, int reach) {
  int above = int(floor(row));
  float upper = known(column, above, level, reach), lower = known(column, above + 1, level, reach);
  return upper > 0.0 && lower > 0.0 ? mix(upper, lower, row - float(above)) : max(upper, lower);
}

/* Steps from the middle to a side, or half of what it is from one side to the other. */
float difference(float before, float here, float after) {
  float sides = float(before > 0.0) + float(after > 0.0);
  if (sides == 0.0) return 0.0;
  return ((after > 0.0 ? after : here) - (before > 0.0 ? before : here)) / sides;
}

/* Slope along the ring, in steps for an angle of 1 on the equator. */
float roundSlope(ivec2 at, int level, int reach, float here) {
  float ring = ringAt(at.y);
  if (ring > 0.5) {
    int across = int(float(reach) / ring + 0.5);
    float turn = TURN * float(across) / float(uSize.x) * ring;
    return difference(known(at.x - across, at.y, level, 0), here, known(at.x + across, at.y, level, 0)) / turn;
  }
  float polar = HALF_TURN * (float(at.y) + 0.5) / float(uSize.y), arc = HALF_TURN * float(reach) / float(uSize.y);
  vec3 beside = vec3(ring * cos(arc), sin(arc), cos(polar) * cos(arc));
  float row = atan(length(beside.xy), beside.z) / HALF_TURN * float(uSize.y) - 0.5;
  int across = int(atan(beside.y, beside.x) / TURN * float(uSize.x) + 0.5);
  return difference(knownBetween(at.x - across, row, level, reach), here, knownBetween(at.x + across, row, level, reach)) / arc;
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
  float rowMm = uSphere ? HALF_TURN * here * uStepMm / float(uSize.y) : uPitchMm;
  float mean = meanSteps(at, reach);
  float down = difference(known(at.x, at.y - reach, level, reach), mean, known(at.x, at.y + reach, level, reach));
  vec3 normal = normalize(vec3(1.0, -roundSlope(at, level, reach, mean) / here, down * uStepMm / (rowMm * float(reach))));
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
