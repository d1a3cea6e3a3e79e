// GLSL. The skinning matrix of a joint is three texels of uBones (rows); its place is the fourth,
// with how much its segment is marked (0 to 1): as guessed, or as far from where another result has it.
const SKIN_VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp isampler2D;
layout(location=0) in vec3 aPosition; layout(location=1) in vec3 aNormal;
layout(location=2) in uvec4 aJoints; layout(location=3) in vec4 aWeights; layout(location=4) in vec3 aColor;
uniform mat4 uViewProjection; uniform highp sampler2D uBones; uniform isampler2D uMorphs;
uniform float uMorphWeights[16]; uniform int uMorphCount; uniform int uVertexCount;
out vec3 vWorld; out vec3 vNormal; out vec3 vColor; out float vGuess;
void main() {
  vColor = aColor;
  vec3 p = aPosition;
  for (int k = 0; k < uMorphCount; k++) {
    int i = k * uVertexCount + gl_VertexID;
    p += uMorphWeights[k] * vec3(texelFetch(uMorphs, ivec2(i & 2047, i >> 11), 0).xyz);
  }
  vec4 x = vec4(0), y = vec4(0), z = vec4(0);
  vGuess = 0.;
  for (int c = 0; c < 4; c++) {
    int j = int(aJoints[c]);
    x += aWeights[c] * texelFetch(uBones, ivec2(0, j), 0);
    y += aWeights[c] * texelFetch(uBones, ivec2(1, j), 0);
    z += aWeights[c] * texelFetch(uBones, ivec2(2, j), 0);
    vGuess += aWeights[c] * texelFetch(uBones, ivec2(3, j), 0).w;
  }
  vec4 h = vec4(p, 1);
  vWorld = vec3(dot(x, h), dot(y, h), dot(z, h));
  vNormal = vec3(dot(x.xyz, aNormal), dot(y.xyz, aNormal), dot(z.xyz, aNormal));
  gl_Position = uViewProjection * vec4(vWorld, 1);
}`;

const SHADOW_FRAGMENT = `#version 300 es
precision highp float;
in vec3 vWorld; in vec3 vNormal; in vec3 vColor; in float vGuess;
void main() {}`;

// Soft shadow: sixteen taps on a disc, turned from pixel to pixel.
const SHADOW_LOOKUP = `
uniform highp sampler2DShadow uShadow; uniform mat4 uShadowMatrix;
float lit(vec3 world, float spread) {
  vec3 s = (uShadowMatrix * vec4(world, 1)).xyz * .5 + .5;
  if (any(lessThan(s, vec3(.01))) || any(greaterThan(s, vec3(.99)))) return 1.;
  float turn = 6.2832 * fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(.06711056, .00583715)))), sum = 0.;
  for (int k = 0; k < 16; k++) {
    float r = sqrt((float(k) + .5) / 16.), a = 2.399963 * float(k) + turn;
    sum += texture(uShadow, vec3(s.xy + spread * r * vec2(cos(a), sin(a)), s.z));
  }
  return sum / 16.;
}`;

const BODY_FRAGMENT = `#version 300 es
precision highp float;
in vec3 vWorld; in vec3 vNormal; in vec3 vColor; in float vGuess;
uniform vec3 uEye, uLight, uAlbedo, uSky, uGround, uGuess; uniform float uAlpha, uFloor, uKey, uStripes, uPainted;
out vec4 color;
${SHADOW_LOOKUP}
void main() {
  vec3 n = normalize(vNormal), v = normalize(uEye - vWorld);
  float facing = dot(n, uLight), shade = lit(vWorld + .008 * n + .006 * uLight, .0045);
  float key = max((facing + .18) / 1.18, 0.) * mix(1., shade, smoothstep(-.05, .2, facing));
  float near = smoothstep(-.05, .45, vWorld.y - uFloor);
  vec3 ambient = mix(uGround, uSky, .5 + .5 * n.y) * mix(.72, 1., near);
  float rim = pow(1. - max(dot(n, v), 0.), 3.5);
  float gloss = pow(max(dot(n, normalize(uLight + v)), 0.), 28.) * shade * step(0., facing);
  float fill = max(dot(n, normalize(v + vec3(0, .3, 0))), 0.);
  float band = smoothstep(.42, .58, abs(fract((gl_FragCoord.x + gl_FragCoord.y) / 14.) - .5) * 2.);
  vec3 own = mix(mix(uAlbedo, pow(vColor, vec3(2.2)), uPainted), uGuess, vGuess * mix(1., .25 + .75 * band, uStripes));
  vec3 c = own * (ambient + uKey * key * vec3(1., .965, .92) + .20 * fill) + .055 * gloss + rim * .16 * uSky;
  color = vec4(pow(c / (1. + .18 * c), vec3(1. / 2.2)), mix(uAlpha, 1., rim * .6 * step(uAlpha, .99)));
}`;

const FLOOR_VERTEX = `#version 300 es
precision highp float;
layout(location=0) in vec2 aCorner;
uniform mat4 uViewProjection; uniform vec3 uFocus; uniform float uFloor, uReach;
out vec3 vWorld;
void main() {
  vWorld = vec3(uFocus.x + uReach * aCorner.x, uFloor, uFocus.z + uReach * aCorner.y);
  gl_Position = uViewProjection * vec4(vWorld, 1);
}`;

// Grid, shadow of the key light, and the shade that each joint, taken for a ball, casts around its foot point.
const FLOOR_FRAGMENT = `#version 300 es
precision highp float;
in vec3 vWorld;
uniform highp sampler2D uBones; uniform int uJointCount;
uniform vec3 uFocus, uBackground, uFloorColor, uLine; uniform float uReach, uShadowDepth;
out vec4 color;
${SHADOW_LOOKUP}
float grid(vec2 p, float width) {
  vec2 wide = fwidth(p) + 1e-6, d = abs(fract(p - .5) - .5) / wide;
  vec2 fade = clamp(.7 / wide - 1., 0., 1.);
  vec2 line = (1. - clamp(d / width, 0., 1.)) * min(fade, 1.);
  return max(line.x, line.y);
}
void main() {
  float away = length(vWorld.xz - uFocus.xz), fade = 1. - smoothstep(.22 * uReach, uReach, away);
  float lines = max(.45 * grid(vWorld.xz * 2., 1.1), grid(vWorld.xz, 1.4));
  vec3 c = mix(uFloorColor, uLine, lines * .85);
  float shade = 1., dark = 0.;
  if (away < 3.5) {
    shade = lit(vWorld, .011);
    for (int j = 0; j < uJointCount; j++) {
      vec3 to = texelFetch(uBones, ivec2(3, j), 0).xyz - vWorld;
      float square = dot(to, to);
      dark += .0075 * max(to.y, .02) * inversesqrt(square) / max(square, .006);
    }
  }
  c *= (1. - uShadowDepth * (1. - shade)) * (1. - .55 * (1. - exp(-.85 * dark)));
  color = vec4(mix(uBackground, c, fade), 1);
}`;

const MARKER_VERTEX = `#version 300 es
precision highp float;
layout(location=0) in vec2 aCorner; layout(location=1) in vec4 aCenter; layout(location=2) in vec4 aColor;
layout(location=3) in float aStyle;
uniform mat4 uViewProjection; uniform vec3 uEye; uniform vec2 uViewport; uniform float uScale, uSmallest;
out vec2 vCorner; out vec4 vColor; flat out float vStyle; flat out float vPixels;
void main() {
  vec3 center = aCenter.xyz + aCenter.w * normalize(uEye - aCenter.xyz);
  vec4 clip = uViewProjection * vec4(center, 1);
  vPixels = max(aCenter.w * uScale / clip.w, uSmallest * (aStyle < .5 ? 1. : 1.6));
  vCorner = aCorner; vColor = aColor; vStyle = aStyle;
  clip.xy += aCorner * (vPixels + 1.) * 2. / uViewport * clip.w;
  gl_Position = clip;
}`;

const MARKER_FRAGMENT = `#version 300 es
precision highp float;
in vec2 vCorner; in vec4 vColor; flat in float vStyle; flat in float vPixels;
uniform float uFade;
out vec4 color;
void main() {
  float r = length(vCorner) * (vPixels + 1.), edge = clamp(vPixels + .5 - r, 0., 1.);
  float s = r / vPixels;
  vec3 n = vec3(vCorner, sqrt(max(1. - s * s, 0.)));
  float light = .62 + .38 * max(dot(n, normalize(vec3(-.35, .6, .7))), 0.);
  float ring = clamp(r - .66 * vPixels + .5, 0., 1.);
  vec3 c = vStyle < .5 ? vColor.rgb * light + .25 * pow(max(dot(n, normalize(vec3(-.3, .5, .8))), 0.), 20.) : vColor.rgb;
  float alpha = vColor.a * edge * (vStyle < .5 ? 1. : ring) * uFade;
  if (alpha < .02) discard;
  color = vec4(c, alpha);
}`;

const LINE_VERTEX = `#version 300 es
precision highp float;
layout(location=0) in vec2 aCorner; layout(location=1) in vec3 aFrom; layout(location=2) in vec3 aTo;
layout(location=3) in vec4 aColor; layout(location=4) in float aWidth;
uniform mat4 uViewProjection; uniform vec2 uViewport;
out vec4 vColor; out float vAcross; flat out float vWidth;
void main() {
  vec4 a = uViewProjection * vec4(aFrom, 1), b = uViewProjection * vec4(aTo, 1);
  vec2 along = (b.xy / b.w - a.xy / a.w) * uViewport;
  along = length(along) > 1e-4 ? normalize(along) : vec2(1, 0);
  vec4 clip = aCorner.x < 0. ? a : b;
  vWidth = aWidth; vAcross = aCorner.y * (aWidth + 1.); vColor = aColor;
  clip.xy += (vec2(-along.y, along.x) * vAcross + along * aCorner.x * aWidth * .5) / uViewport * clip.w;
  clip.z -= 2e-4 * clip.w;
  gl_Position = clip;
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec4 vColor; in float vAcross; flat in float vWidth;
uniform float uFade;
out vec4 color;
void main() {
  float alpha = vColor.a * uFade * clamp(vWidth + .5 - abs(vAcross), 0., 1.);
  if (alpha < .01) discard;
  color = vec4(vColor.rgb, alpha);
}`;
