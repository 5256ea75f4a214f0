/**
 * The three programs. "prepare" runs once for each Gaussian in view and writes its ellipse and its colour into textures; "splat"
 * draws a rectangle around each ellipse, nearest first; "finish" puts the picture over the background and draws the outline
 * of the selection. The numbers are those of kfgs/splat/project.py and kfgs/splat/engines/contract.py.
 */

/** Width of every texture with one texel per Gaussian; a power of two. */
export const WIDTH = 2048;

/** Rectangles drawn as one instance: with one each, drivers that work on the CPU need 30 microseconds for every one. */
export const BATCH = 1024;

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp isampler2D;
`;

export const WHOLE = `${HEAD}
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, DEPTH, 1.0);
}`;

export const PREPARE = `${HEAD}
uniform usampler2D order, splats, dcs, shs, marks;
uniform isampler2D labels, sources;
uniform sampler2D scores, latents, colormap, classes, fars;
uniform int count, rows, degree, mode;          // count: in view; mode: 0 color, 1 labels, 2 score, 3 latents
uniform bool carried, asked, masked, dim;       // carried: labels come from the source; masked: selection is a mask
uniform bool antialiased;                       // what is widened on the screen becomes fainter
uniform vec3 center, spread;                    // of the box of the means
uniform vec2 scaling, dcScale, scoreRange;      // lowest log and step
uniform float shStep, gamma, lambda, mixing, near, share;   // share: of the Gaussians that are drawn
uniform mat4 view;
uniform vec4 pinhole;                           // fx, fy, cx, cy in pixels of the target
uniform vec2 size;
uniform vec3 eye, paper;
layout(location = 0) out uvec4 shape;           // centre x, y; two half-axes as pairs of half floats
layout(location = 1) out uvec4 paint;           // rg, b and opacity as half floats; selected; depth

const float UNKNOWN = -1e38;
const vec3 GREY = vec3(128.0 / 255.0);

ivec2 place(int i) { return ivec2(i & ${WIDTH - 1}, i >> ${Math.log2(WIDTH)}); }

float opened(float whole, float half_) {
  float v = whole * (4.0 / 2097151.0) - 2.0;
  float u = abs(v) <= 1.0 ? v : sign(v) / max(2.0 - abs(v), 1e-6);
  return u * half_;
}

vec3 meanOf(uvec4 s) {
  uvec3 whole = uvec3(s.x & 0x1fffffu, (s.x >> 21) | ((s.y & 1023u) << 11), (s.y >> 10) & 0x1fffffu);
  return center + vec3(opened(float(whole.x), spread.x), opened(float(whole.y), spread.y), opened(float(whole.z), spread.z));
}

mat3 rotationOf(uint word) {
  vec3 s = (vec3(word & 1023u, (word >> 10) & 1023u, (word >> 20) & 1023u) / 1023.0 - 0.5) * sqrt(2.0);
  float r = sqrt(max(0.0, 1.0 - dot(s, s)));
  uint k = word >> 30;
  vec4 q = k == 0u ? vec4(r, s) : k == 1u ? vec4(s.x, r, s.yz) : k == 2u ? vec4(s.xy, r, s.z) : vec4(s, r);
  q = normalize(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec4 bytesOf(uint word) {  // signed
  return vec4(ivec4(int(word) << 24, int(word) << 16, int(word) << 8, int(word)) >> 24);
}

vec4 word(int i, int t) {                       // bytes 4 t to 4 t + 3 of the harmonics of Gaussian i
  ivec2 at = place(i);
  uvec2 two = texelFetch(shs, ivec2(at.x, at.y + (t >> 1) * rows), 0).xy;
  return bytesOf((t & 1) == 0 ? two.x : two.y);
}

vec3 four(vec4 y, vec4 a, vec4 b, vec4 c) {     // the harmonics y times four coefficients, which are twelve bytes
  return y.x * a.xyz + y.y * vec3(a.w, b.xy) + y.z * vec3(b.zw, c.x) + y.w * c.yzw;
}

vec3 harmonics(int i, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec4 first = vec4(0.4886025119 * vec3(-y, z, -x), 1.0925484306 * x * y);
  vec4 third = word(i, 2);
  if (degree == 1) third.yzw = vec3(0.0);
  vec3 sum = four(first, word(i, 0), word(i, 1), third);
  if (degree > 1) {
    vec4 second = vec4(-1.0925484306 * y * z, 0.3153915653 * (2.0 * zz - xx - yy), -1.0925484306 * x * z, 0.5462742153 * (xx - yy));
    sum += four(second, word(i, 3), word(i, 4), word(i, 5));
  }
  if (degree > 2) {
    float ring = 0.4570457995 * (4.0 * zz - xx - yy);
    vec4 next = vec4(-0.5900435899 * y * (3.0 * xx - yy), 2.8906114426 * x * y * z, -ring * y, 0.3731763326 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy));
    sum += four(next, word(i, 6), word(i, 7), word(i, 8));
    vec4 last = vec4(-ring * x, 1.4453057213 * z * (xx - yy), -0.5900435899 * x * (xx - 3.0 * yy), 0.0);
    sum += four(last, word(i, 9), word(i, 10), word(i, 11));
  }
  return sum * shStep;
}

vec3 colorOf(int i, vec3 direction) {
  uint word = texelFetch(dcs, place(i), 0).x;
  vec3 base = vec3(word & 1023u, (word >> 10) & 1023u, (word >> 20) & 1023u) * dcScale.y + dcScale.x;
  if (degree > 0) base += harmonics(i, direction);
  return max(base, 0.0);
}

void main() {
  ivec2 slot = ivec2(gl_FragCoord.xy);
  shape = uvec4(0u);
  paint = uvec4(0u);
  if (slot.y * ${WIDTH} + slot.x >= count) return;
  int i = int(texelFetch(order, slot, 0).x);
  ivec2 at = place(i);

  uvec4 s = texelFetch(splats, at, 0);
  uint mark = texelFetch(marks, at, 0).x;       // selected: 1, removed: 2
  float opacity = float(s.w >> 24) / 255.0;
  vec3 mean = meanOf(s);
  vec3 p = (view * vec4(mean, 1.0)).xyz;
  if (!(p.z > near) || opacity <= 1.0 / 255.0 || (mark & 2u) != 0u) return;

  int source = i;                               // the semantic Gaussian that gives label and score
  if (carried) {
    source = texelFetch(fars, at, 0).x < lambda ? texelFetch(sources, at, 0).x : -1;
  }
  int label = source < 0 ? -1 : texelFetch(labels, place(source), 0).x;
  vec4 group = texelFetch(classes, ivec2(label + 1, 0), 0);
  if (group.a == 0.0) return;                   // hidden
  float score = source < 0 ? -3e38 : texelFetch(scores, place(source), 0).x;
  bool chosen = masked ? (mark & 1u) != 0u : asked && score > UNKNOWN && score > gamma;

  vec3 color = mode == 0 || mixing < 1.0 ? colorOf(i, normalize(mean - eye)) : vec3(0.0);
  if (mode > 0) {
    vec3 other = group.rgb;
    if (mode == 2) {
      float unit = clamp((score - scoreRange.x) / (scoreRange.y - scoreRange.x), 0.0, 1.0);
      other = score > UNKNOWN ? texelFetch(colormap, ivec2(min(int(unit * 256.0), 255), 0), 0).rgb : GREY;
    }
    if (mode == 3) other = source < 0 ? GREY : texelFetch(latents, place(source), 0).rgb;
    color = mix(color, other, mixing);
  }
  if (dim && !chosen && (asked || masked)) {
    float light = dot(color, vec3(0.3, 0.6, 0.1));
    color = mix(paper, mix(vec3(light), color, 0.3), 0.6);
  }

  vec2 focal = pinhole.xy;
  vec2 middle = (size * 0.5 - pinhole.zw) / focal, half_ = 1.3 * size * 0.5 / focal;
  vec2 tangent = clamp(p.xy / p.z, middle - half_, middle + half_);
  mat3 turn = mat3(view) * rotationOf(s.z);
  vec3 scales = exp(scaling.x + scaling.y * vec3(s.w & 255u, (s.w >> 8) & 255u, (s.w >> 16) & 255u));
  // rows of J W R S
  vec3 u = focal.x / p.z * (vec3(turn[0].x, turn[1].x, turn[2].x) - tangent.x * vec3(turn[0].z, turn[1].z, turn[2].z)) * scales;
  vec3 v = focal.y / p.z * (vec3(turn[0].y, turn[1].y, turn[2].y) - tangent.y * vec3(turn[0].z, turn[1].z, turn[2].z)) * scales;
  float a = dot(u, u), c = dot(v, v), b = dot(u, v);
  vec3 area = cross(u, v);
  float det = dot(area, area) + 0.3 * (a + c) + 0.09;  // of the dilated covariance, without a difference of squares
  float mid = 0.5 * (a + c) + 0.3, gap = 0.5 * (a - c);
  float large = mid + sqrt(gap * gap + b * b), small = det / large;
  vec2 axis = gap >= 0.0 ? vec2(gap + sqrt(gap * gap + b * b), b) : vec2(b, sqrt(gap * gap + b * b) - gap);
  axis = dot(axis, axis) > 1e-20 ? normalize(axis) : vec2(1.0, 0.0);
  vec2 xy = focal * p.xy / p.z + pinhole.zw;
  if (!(large < 1e8)) return;
  if (antialiased) opacity *= sqrt(dot(area, area) / det);
  if (share < 1.0) {                            // the others are left out: larger and denser ones fill their places
    large *= inversesqrt(share);
    small *= inversesqrt(share);
    opacity = 1.0 - pow(1.0 - opacity, inversesqrt(share));
  }
  shape = uvec4(floatBitsToUint(xy), packHalf2x16(axis * sqrt(large)), packHalf2x16(vec2(-axis.y, axis.x) * sqrt(small)));
  paint = uvec4(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, opacity)), chosen ? 1u : 0u, floatBitsToUint(p.z));
}`;

export const SPLAT_VERTEX = `${HEAD}
uniform usampler2D shapes, paints;
uniform vec2 size;
uniform float least, near;                      // alpha that is drawn; depth
uniform int first, end;                         // slots
out vec2 at;
flat out vec4 color;
flat out float chosen;

void main() {
  int slot = first + gl_InstanceID * ${BATCH} + (gl_VertexID >> 2);
  gl_Position = vec4(2.0, 2.0, 0.0, 1.0);       // outside
  if (slot >= end) return;
  ivec2 texel = ivec2(slot & ${WIDTH - 1}, slot >> ${Math.log2(WIDTH)});
  uvec4 paint = texelFetch(paints, texel, 0);
  vec2 last = unpackHalf2x16(paint.y);
  if (last.y <= least) return;
  uvec4 shape = texelFetch(shapes, texel, 0);
  color = vec4(unpackHalf2x16(paint.x), last);
  chosen = float(paint.z);
  at = (vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0) * sqrt(2.0 * log(color.a / least));
  vec2 pixel = uintBitsToFloat(shape.xy) + at.x * unpackHalf2x16(shape.z) + at.y * unpackHalf2x16(shape.w);
  float depth = 1.0 - 2.0 * near / uintBitsToFloat(paint.w);  // as SOLID_VERTEX has it
  gl_Position = vec4(pixel.x / size.x * 2.0 - 1.0, 1.0 - pixel.y / size.y * 2.0, depth, 1.0);
}`;

export const SPLAT_FRAGMENT = `${HEAD}
in vec2 at;
flat in vec4 color;
flat in float chosen;
uniform float least;
layout(location = 0) out vec4 picture;
#ifdef OUTLINE
layout(location = 1) out vec4 outline;
#endif

void main() {
  float alpha = min(0.99, color.a * exp(-0.5 * dot(at, at)));
  if (alpha < least) discard;
  picture = vec4(color.rgb * alpha, alpha);
#ifdef OUTLINE
  outline = vec4(chosen * alpha, 0.0, 0.0, alpha);
#endif
}`;

/** Points and meshes: drawn first; their depth hides Gaussians, and what the others leave free shows them. */
export const SOLID_VERTEX = `${HEAD}
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 tone;
uniform mat4 view;
uniform vec4 pinhole;                           // fx, fy, cx, cy in pixels of the target
uniform vec2 size;
uniform float near, dotSize;
out vec3 color, at;
void main() {
  color = tone;
  at = (view * vec4(place, 1.0)).xyz;
  vec2 pixel = (pinhole.xy * at.xy + pinhole.zw * at.z) / size * 2.0 - at.z;
  gl_Position = vec4(pixel.x, -pixel.y, at.z - 2.0 * near, at.z);
  gl_PointSize = dotSize;
}`;

export const SOLID_FRAGMENT = `${HEAD}
in vec3 color, at;                              // at: in the camera's axes
uniform bool meshed;
out vec4 picture;
void main() {
  if (!meshed && length(gl_PointCoord - 0.5) > 0.5) discard;
  vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
  float light = meshed ? 0.35 + 0.65 * abs(dot(normal, normalize(at))) : 1.0;  // of a lamp at the camera
  picture = vec4(color * light, 1.0);
}`;

/** Marks pixels that are covered completely, so that nothing behind is drawn there. */
export const COVERED = `${HEAD}
uniform sampler2D picture;
uniform float enough;                           // alpha
out vec4 nothing;
void main() {
  if (texelFetch(picture, ivec2(gl_FragCoord.xy), 0).a < enough) discard;
  nothing = vec4(0.0);
}`;

export const FINISH = `${HEAD}
uniform sampler2D picture, outline, solids;
uniform vec4 viewport;                          // x, y from below, width, height on the canvas
uniform vec3 paper;
uniform vec3 rim;                               // colour of the outline
uniform float width;                            // of the outline in pixels; 0: none
out vec4 color;

void main() {
  vec2 at = (gl_FragCoord.xy - viewport.xy) / viewport.zw;
  vec4 seen = texture(picture, at);
  vec4 solid = texture(solids, at);
  vec3 rgb = seen.rgb + (1.0 - seen.a) * mix(paper, solid.rgb, solid.a);
  if (width > 0.0) {
    float here = texture(outline, at).r, most = here, least = here;
    for (int k = 0; k < 8; k++) {
      float turn = float(k) * 0.7853981634;
      float near = texture(outline, at + vec2(cos(turn), sin(turn)) * width / viewport.zw).r;
      most = max(most, near);
      least = min(least, near);
    }
    rgb = mix(rgb, rim, smoothstep(0.3, 0.6, most) * (1.0 - smoothstep(0.4, 0.7, least)));
  }
  color = vec4(rgb, 1.0);
}`;
