// Range in the vertex shader, normals from the range, colour where it is refined over colour of the first view.
// A sphere's directions are found again at each pixel: near a pole nothing else is the same all over a triangle.
// What only spheres need is compiled only for them (SPHERE): a processor that draws takes all branches at every pixel,
// and half a second to compile those of the normals.

/** What is compiled in. */
export const definesOf = (sphere: boolean, overlaid = false): Record<string, string> =>
  ({ ...(sphere && { SPHERE: '' }), ...(overlaid && { OVERLAY: '' }) });

/** What every stage needs of the grid. */
const GRID = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D uRange;
uniform int uShift; // of the grid's rows and columns every 2^uShift-th is there
uniform ivec2 uSize;
uniform float uStepMm;
uniform float uPitchMm;
const float TURN = 6.283185307179586;
const float HALF_TURN = 3.141592653589793;

/* Any column up to a turn away, and any row, as one of the grid's: past a pole down the other side. */
ivec2 inside(int column, int row) {
#ifdef SPHERE
  if (row < 0 || row >= uSize.y) {
    column += uSize.x / 2;
    row = row < 0 ? -1 - row : 2 * uSize.y - 1 - row;
  }
#endif
  column += column < 0 ? uSize.x : column < uSize.x ? 0 : -uSize.x; // dividing takes a processor far longer
  return ivec2(column, clamp(row, 0, uSize.y - 1));
}

uint stepsAt(int column, int row) {
  return texelFetch(uRange, inside(column, row) >> uShift, 0).r;
}
`;

/**
 * position.xy: vertex of a tile, in strides. tile: its first column and row. edges: strides of the tiles to the left,
 * right, above and below. A vertex on an edge moves to the coarser neighbour's next one, so that no crack opens.
 * A fan closes a tile's first or last row (tile.y 0 or 1) over the pole, where position.z is 1.
 */
export const SURFACE_VERTEX = /* glsl */ `
${GRID}
uniform mat4 projectionMatrix;
uniform mat4 viewMatrix;
uniform float uZMaxMm;
uniform float uTheta0;
uniform int uStride;
uniform int uTile;
uniform bool uFan;
uniform vec2 uPoles;
in vec3 position;
in vec2 tile;
in vec4 edges;
out vec2 vUv;
out vec3 vWorld;

int snapped(int along, float stride) {
  return along & -int(stride);
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
#ifdef SPHERE
  float polar = HALF_TURN * row / float(uSize.y), level = radius * sin(polar), up = radius * cos(polar);
#else
  float level = radius, up = -row * uPitchMm;
#endif
  return vec3(level * cos(angle), uZMaxMm + up, -level * sin(angle));
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
  bool pole = false, below = false;
#ifdef SPHERE
  if (uFan) {
    below = tile.y > 0.5;
    pole = position.z > 0.5;
    column = int(tile.x) + (below ? last - vertex.x : vertex.x) * uStride;
    row = below ? uSize.y - 1 : 0;
  }
#endif
  column = min(column, uSize.x);
  row = min(row, uSize.y - 1);
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
uniform vec3 cameraPosition;
uniform float uZMaxMm;
uniform float uTheta0;
uniform vec3 uKey;
uniform vec3 uFill;
uniform int uMode;
in vec2 vUv;
in vec3 vWorld;
out vec4 colour;
const float TURN = 6.283185307179586;
const float HALF_TURN = 3.141592653589793;

/* What is in a pixel: its place on the scan, and which way is out, round and up there. */
struct Place {
  vec2 uv;
  vec3 outward;
  vec3 round;
  vec3 up;
};

#ifdef SPHERE
/* Lengths along a ring count as on the equator: else the texture would be blurred ever more towards a pole. */
Place place(out vec4 dense) {
  vec3 outward = normalize(vWorld - vec3(0.0, uZMaxMm, 0.0));
  float level = length(outward.xz);
  vec2 across = level > 0.0 ? vec2(outward.x, -outward.z) / level : vec2(1.0, 0.0);
  vec3 round = vec3(-across.y, 0.0, -across.x), up = vec3(-outward.y * across.x, level, outward.y * across.y);
  vec2 uv = vec2(fract((atan(across.y, across.x) - uTheta0) / TURN), atan(level, outward.y) / HALF_TURN);
  vec3 dx = dFdx(outward), dy = dFdy(outward);
  mat2x3 along = mat2x3(round / TURN, up / -HALF_TURN);
  dense = textureGrad(uDense, uv, dx * along, dy * along);
  return Place(uv, outward, round, up);
}
#else
Place place(out vec4 dense) {
  vec2 across = normalize(vWorld.xz);
  dense = texture(uDense, vUv);
  return Place(vUv, vec3(across.x, 0.0, across.y), vec3(across.y, 0.0, -across.x), vec3(0.0, 1.0, 0.0));
}
#endif

/* What a light does to a colour as the screen has it: the power law between them, as a root, which costs little. */
vec3 lit(vec3 texel, vec3 light) {
  return texel * (1.1404 * sqrt(light) - 0.1402 * light);
}

/* Sharp is clear, coarse is warm: spacing 1, 2, 4, 8 and more. */
vec3 spacingColour(float level) {
  float t = clamp(level / 6.0, 0.0, 1.0);
  return mix(vec3(0.05, 0.55, 0.75), mix(vec3(0.98, 0.75, 0.15), vec3(0.75, 0.12, 0.35), smoothstep(0.5, 1.0, t)), smoothstep(0.0, 0.5, t));
}

void main() {
  vec4 dense;
  Place at = place(dense);
  vec4 packed = textureLod(uNormals, at.uv, 0.0);
  if (packed.a < 0.5) discard;
  vec3 along = normalize(packed.rgb / packed.a * 2.0 - 1.0);
  vec3 normal = along.x * at.outward + along.y * at.round + along.z * at.up;
  vec3 view = normalize(cameraPosition - vWorld);
  // Slivers round a pole may face any way while little of it is known: there the normal tells better.
  bool inside = !gl_FrontFacing && dot(normal, view) < 0.0;
  if (inside) normal = -normal;

  vec4 coarse = textureLod(uCoarse, at.uv, 0.0);
  vec3 texel = mix(coarse.rgb / max(coarse.a, 0.01), dense.rgb / max(dense.a, 0.01), step(0.5, dense.a));
  if (coarse.a < 0.01) texel = vec3(0.72);
  if (uMode == 1) texel = vec3(0.785, 0.779, 0.766);
  if (uMode == 2 && !inside) {
    colour = vec4(texel, 1.0);
  } else {
    float wrapLight = uMode == 1 ? 0.05 : 0.25;
    float key = max(0.0, (dot(normal, uKey) + wrapLight) / (1.0 + wrapLight));
    float fill = max(0.0, dot(normal, uFill));
    float sky = 0.5 + 0.5 * normal.y;
    vec3 light = vec3(1.0, 0.975, 0.94) * 0.78 * key + vec3(0.86, 0.92, 1.0) * 0.16 * fill + mix(0.13, 0.27, sky);
    float facing = max(0.0, dot(normal, normalize(uKey + view)));
    float squared = facing * facing, eighth = squared * squared * squared * squared;
    float gloss = (uMode == 1 ? 0.045 : 0.018) * eighth * eighth * eighth;
    colour = vec4(clamp((lit(texel, light) + gloss) * (inside ? 0.65 : 1.0), 0.0, 1.0), 1.0);
  }
#ifdef OVERLAY
  float level = float(texelFetch(uLevel, ivec2(vec2(fract(at.uv.x), min(at.uv.y, 0.99999)) * uLevelScale), 0).r);
  float grey = dot(colour.rgb, vec3(0.3, 0.6, 0.1));
  colour.rgb = mix(colour.rgb, spacingColour(level) * (0.35 + 0.75 * grey), 0.5);
#endif
}
`;

export const QUAD_VERTEX = /* glsl */ `
in vec3 position;

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
  return int(texelFetch(uLevel, inside(column, row) >> 3, 0).r);
}

/* Steps from the middle to a side, or half of what it is from one side to the other. */
float difference(float before, float here, float after) {
  float sides = float(before > 0.0) + float(after > 0.0);
  if (sides == 0.0) return 0.0;
  return ((after > 0.0 ? after : here) - (before > 0.0 ? before : here)) / sides;
}

/* Slopes round and down, in steps for an angle of 1 on the equator and for a row. */
#ifdef SPHERE
/* How much narrower columns are than on the equator. */
float ringAt(int row) {
  return sin(HALF_TURN * (float(row) + 0.5) / float(uSize.y));
}

/* Steps of a sample, of some beside it too where columns are narrow. */
float meanSteps(ivec2 at, int reach) {
  float own = float(texelFetch(uRange, at >> uShift, 0).r);
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
  return levelAt(column, row) > level + 1 ? 0.0 : meanSteps(inside(column, row), reach);
}

vec2 slopes(ivec2 at, int level, int reach) {
  float ring = ringAt(at.y), angle = TURN * float(int(float(reach) / ring + 0.5)) / float(uSize.x) * ring;
  vec2 beside = vec2(int(float(reach) / ring + 0.5), at.y);
  if (ring <= 0.5) {
    float polar = HALF_TURN * (float(at.y) + 0.5) / float(uSize.y);
    angle = HALF_TURN * float(reach) / float(uSize.y);
    vec3 along = vec3(ring * cos(angle), sin(angle), cos(polar) * cos(angle));
    float row = atan(length(along.xy), along.z) / HALF_TURN * float(uSize.y) - 0.5;
    beside = vec2(int(atan(along.y, along.x) / TURN * float(uSize.x) + 0.5), row);
  }
  // One loop, since whatever is called is compiled anew at each call.
  float steps[5];
  for (int k = 0; k < 5; k++) {
    int column = at.x + (k == 0 ? -1 : k == 1 ? 1 : 0) * int(beside.x);
    float row = k < 2 ? beside.y : float(at.y + (k == 2 ? -1 : k == 3 ? 1 : 0) * reach), above = floor(row);
    float two[2];
    for (int j = 0; j < 2; j++) two[j] = known(column, int(above) + j, level, k < 2 && ring > 0.5 ? 0 : reach);
    float lower = row == above ? 0.0 : two[1];
    steps[k] = two[0] > 0.0 && lower > 0.0 ? mix(two[0], lower, row - above) : max(two[0], lower);
  }
  return vec2(difference(steps[0], steps[4], steps[1]) / angle, difference(steps[2], steps[4], steps[3]) / float(reach));
}
#else
/* Steps at a neighbour, or 0 where none is, or only a coarser guess: that would draw a scar round what is sharp. */
float known(int column, int row, int level) {
  return row < 0 || row >= uSize.y || levelAt(column, row) > level + 1 ? 0.0 : float(stepsAt(column, row));
}

vec2 slopes(ivec2 at, int level, int reach) {
  float here = float(stepsAt(at.x, at.y)), angle = TURN * float(reach) / float(uSize.x);
  float round = difference(known(at.x - reach, at.y, level), here, known(at.x + reach, at.y, level));
  float down = difference(known(at.x, at.y - reach, level), here, known(at.x, at.y + reach, level));
  return vec2(round / angle, down / float(reach));
}
#endif

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy * uCell);
  float here = float(stepsAt(at.x, at.y));
  if (here == 0.0) {
    packed = vec4(0.0);
    return;
  }
  int level = levelAt(at.x, at.y);
  int reach = int(exp2(0.5 * float(level)) + 0.5) >> uShift << uShift;
  vec2 slope = slopes(at, level, max(1 << uShift, reach));
#ifdef SPHERE
  float rowMm = HALF_TURN * here * uStepMm / float(uSize.y);
#else
  float rowMm = uPitchMm;
#endif
  vec3 normal = normalize(vec3(1.0, -slope.x / here, slope.y * uStepMm / rowMm));
  packed = vec4(normal * 0.5 + 0.5, 1.0);
}
`;

/** A texture, stretched over a larger one. */
export const COPY_FRAGMENT = /* glsl */ `
precision highp float;
uniform sampler2D uFrom;
uniform vec2 uTo;
out vec4 copied;

void main() {
  copied = texture(uFrom, gl_FragCoord.xy / uTo);
}
`;
