// Gaussians to pixels, as in render/projection.py and render/constants.py. Pixels are those of the recording, so that
// the blur means the same in a window of any size.

// (x, y, z, opacity) (qw, qx, qy, qz) (sx, sy, sz, r1) (r, g, b, g1) (b1, r2, g2, b2)
const GAUSSIAN_TEXELS = 5;
const GAUSSIANS_PER_ROW = 512;
const ORDER_WIDTH = 1024;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D gaussians, order;
uniform vec4 low[${2 * GAUSSIAN_TEXELS}], stepSize[${2 * GAUSSIAN_TEXELS}];  // of the first block, then of the second
uniform int border;        // index of the first Gaussian of the second block
uniform mat3 toCamera;
uniform vec3 origin;
uniform vec2 focal, center, size;
uniform vec2 depthRange;   // mm; y > x: draw depth
uniform vec4 slopeLimits;  // smallest x/z, y/z, then largest
out vec2 fromCenter;       // standard deviations
flat out vec4 paint;       // color or depth, and opacity
flat out vec3 change1;     // of the color, per standard deviation along each axis of the ellipse
flat out vec3 change2;

const float BLUR = 0.3;
const float NEAR = 0.2;
const float ALPHA_MIN = 1.0 / 255.0;

vec4 part(int i, int k) {
  ivec2 at = ivec2((i % ${GAUSSIANS_PER_ROW}) * ${GAUSSIAN_TEXELS} + k, i / ${GAUSSIANS_PER_ROW});
  int own = i < border ? k : k + ${GAUSSIAN_TEXELS};
  return low[own] + stepSize[own] * vec4(texelFetch(gaussians, at, 0));
}

mat3 rotation(vec4 q) {  // w, x, y, z
  q = normalize(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  fromCenter = vec2(0.0);
  paint = vec4(0.0);
  change1 = change2 = vec3(0.0);
  int turn = gl_VertexID >> 2;
  int i = int(texelFetch(order, ivec2(turn % ${ORDER_WIDTH}, turn / ${ORDER_WIDTH}), 0).r);
  vec4 place = part(i, 0);
  float opacity = place.w;
  vec3 p = toCamera * place.xyz + origin;
  if (opacity < ALPHA_MIN || p.z <= NEAR) return;

  vec4 shape = part(i, 2);
  vec3 scales = exp(shape.xyz);
  mat3 axes = toCamera * rotation(part(i, 1));
  axes = mat3(axes[0] * scales.x, axes[1] * scales.y, axes[2] * scales.z);
  vec2 slope = clamp(p.xy / p.z, slopeLimits.xy, slopeLimits.zw);
  mat3 rows = transpose(axes);
  vec3 alongX = focal.x / p.z * (rows[0] - slope.x * rows[2]);
  vec3 alongY = focal.y / p.z * (rows[1] - slope.y * rows[2]);
  float xx = dot(alongX, alongX) + BLUR, xy = dot(alongX, alongY), yy = dot(alongY, alongY) + BLUR;

  float lean = 0.5 * (xx - yy);
  float apart = length(vec2(lean, xy));
  float angle = apart > 0.0 ? 0.5 * atan(xy, lean) : 0.0;
  vec2 axis = vec2(cos(angle), sin(angle));
  vec2 sigma = sqrt(vec2(0.5 * (xx + yy) + apart, max(0.5 * (xx + yy) - apart, BLUR)));
  float reach = sqrt(2.0 * log(opacity / ALPHA_MIN));
  fromCenter = reach * vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - reach;
  vec2 across = fromCenter * sigma;
  vec2 pixel = focal * p.xy / p.z + center + across.x * axis + across.y * vec2(-axis.y, axis.x);
  gl_Position = vec4(pixel / size * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);

  bool depth = depthRange.y > depthRange.x;
  if (depth) {
    paint = vec4((p.z - depthRange.x) / (depthRange.y - depthRange.x), 0.0, 0.0, opacity);
    return;
  }
  vec4 color = part(i, 3), rest = part(i, 4);
  paint = vec4(color.xyz, opacity);
  // Change of the color per px: through the mean of the local coordinates of what is seen there.
  vec3 normal = cross(alongX, alongY);
  float det = dot(normal, normal) + BLUR * (xx + yy - BLUR);
  vec2 localX = (yy * alongX.xy - xy * alongY.xy) / det, localY = (xx * alongY.xy - xy * alongX.xy) / det;
  vec3 first = vec3(shape.w, color.w, rest.x), second = rest.yzw;
  vec3 perX = localX.x * first + localX.y * second, perY = localY.x * first + localY.y * second;
  change1 = sigma.x * (axis.x * perX + axis.y * perY);
  change2 = sigma.y * (axis.x * perY - axis.y * perX);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 fromCenter;
flat in vec4 paint;
flat in vec3 change1, change2;
out vec4 painted;
void main() {
  float alpha = min(0.99, paint.a * exp(-0.5 * dot(fromCenter, fromCenter)));
  if (alpha < 1.0 / 255.0) discard;
  painted = vec4((paint.rgb + fromCenter.x * change1 + fromCenter.y * change2) * alpha, alpha);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  gl_Position = vec4(corner * 4.0 - 1.0, 0.0, 1.0);
}`;

// Near to far, evenly spaced; the color bar beside the image uses the same.
const DEPTH_COLORS = [[255, 241, 196], [246, 160, 77], [196, 64, 92], [93, 38, 120], [24, 22, 60]];

const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D drawn;
uniform bool depth;
uniform sampler2D smoke;   // gain and veil: see model/photometric.py
uniform bool smoky;
uniform vec3 background;
uniform vec3 ramp[${DEPTH_COLORS.length}];
out vec4 shown;
void main() {
  vec4 sum = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0);
  if (!depth) {
    vec3 color = sum.rgb + (1.0 - sum.a) * background;
    vec2 at = gl_FragCoord.xy / vec2(textureSize(drawn, 0)), veil = texture(smoke, vec2(at.x, 1.0 - at.y)).rg;
    if (smoky) color = sqrt(veil.r * max(color, 0.0) * max(color, 0.0) + veil.g);
    shown = vec4(color, 1.0);
    return;
  }
  float at = clamp(sum.r / max(sum.a, 1e-4), 0.0, 1.0) * float(${DEPTH_COLORS.length - 1});
  vec3 color = ramp[0];
  for (int i = 0; i < ${DEPTH_COLORS.length - 1}; i++) color = mix(color, ramp[i + 1], clamp(at - float(i), 0.0, 1.0));
  shown = vec4(color * smoothstep(0.1, 0.5, sum.a), 1.0);
}`;
