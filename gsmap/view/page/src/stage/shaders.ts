// How a splat is drawn: the projection, the cuts and the blending of gsmap.render, so that the page shows what the
// pipeline sees. Spark sorts the splats and keeps them as world-space centre, scales, quaternion and colour; its chunk
// `splatDefines` unpacks them.
//
// Conventions (gsmap/native/rasteriser_project.h): 0.3 px^2 are added to the 2D covariance, opacity is not lowered for
// it, the Jacobian is taken within 30 % of the field of view outside the picture, alpha is cut at 1/255 and held below
// 0.99. What is not to be drawn on one side of a split has the sign of its red (not left) or green (not right) turned.

/** Added to a colour whose sign says something, so that black has one. */
export const SIGN_OFFSET = 1 / 1024;

export const SPLAT_VERTEX = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2DArray;
#include <splatDefines>

uniform vec2 renderSize;        // px
uniform vec4 renderToViewQuat;  // of the world
uniform vec3 renderToViewPos;
uniform usampler2D ordering;
uniform usampler2DArray extSplats;
uniform usampler2DArray extSplats2;
uniform float nearest;          // depth from which on splats are drawn
uniform vec4 field;             // lowest x/z, y/z and highest where the Jacobian is taken
uniform vec3 clipLow;
uniform vec3 clipHigh;
uniform vec4 ceiling;           // what has dot(xyz, centre) > w is not drawn

out vec4 colour;
out vec2 at;                    // standard deviations from the centre
flat out uvec2 hidden;          // left and right of the split
flat out float depth;
flat out uint splat;

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  uint index = texelFetch(ordering, ivec2((gl_InstanceID >> 2) & 4095, gl_InstanceID >> 14), 0)[gl_InstanceID & 3];
  if (index == 0xffffffffu) return;
  ivec3 texel = splatTexCoord(int(index));
  vec3 centre, scales;
  vec4 quaternion, rgba;
  unpackSplatExt(texelFetch(extSplats, texel, 0), texelFetch(extSplats2, texel, 0), centre, scales, quaternion, rgba);
  if (rgba.a * 255.0 < 1.0) return;
  if (any(lessThan(centre, clipLow)) || any(greaterThan(centre, clipHigh)) || dot(ceiling.xyz, centre) > ceiling.w) return;
  hidden = uvec2(rgba.r < 0.0, rgba.g < 0.0);
  rgba.rg = mix(rgba.rg, -rgba.rg - ${SIGN_OFFSET}, vec2(hidden));

  vec3 p = quatVec(renderToViewQuat, centre) + renderToViewPos;
  float z = -p.z;
  if (z < nearest) return;
  vec2 ray = clamp(p.xy / z, field.xy, field.zw);
  vec2 focal = 0.5 * renderSize * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  mat3 axes = scaleQuaternionToMatrix(scales, quatQuat(renderToViewQuat, quaternion));
  vec3 t = focal.x / z * (vec3(axes[0].x, axes[1].x, axes[2].x) + ray.x * vec3(axes[0].z, axes[1].z, axes[2].z));
  vec3 u = focal.y / z * (vec3(axes[0].y, axes[1].y, axes[2].y) + ray.y * vec3(axes[0].z, axes[1].z, axes[2].z));
  float xx = dot(t, t) + 0.3, yy = dot(u, u) + 0.3, xy = dot(t, u);
  vec3 minors = cross(t, u);  // a difference of products would cancel for thin Gaussians
  float det = dot(minors, minors) + 0.3 * (xx + yy) - 0.09;
  float middle = 0.5 * (xx + yy);
  float major = middle + length(vec2(0.5 * (xx - yy), xy));
  float minor = det / major;
  vec2 axis = abs(xy) > 1e-6 * middle ? normalize(xx >= yy ? vec2(major - yy, xy) : vec2(xy, major - xx))
                                      : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(255.0 * rgba.a));
  at = position.xy * reach;
  vec2 offset = sqrt(major) * at.x * axis + sqrt(minor) * at.y * vec2(-axis.y, axis.x);
  vec4 clip = projectionMatrix * vec4(p, 1.0);
  gl_Position = vec4(clip.xy + 2.0 / renderSize * offset * clip.w, 0.0, clip.w);
  colour = vec4(max(rgba.rgb, vec3(0.0)), rgba.a);
  depth = z;
  splat = index;
}`;

export const SPLAT_FRAGMENT = /* glsl */ `
precision highp float;
precision highp int;
uniform float splitAt;  // px; what is hidden left is not drawn left of it
in vec4 colour;
in vec2 at;
flat in uvec2 hidden;
out vec4 pixel;
void main() {
  if (hidden[gl_FragCoord.x < splitAt ? 0 : 1] == 1u) discard;
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(at, at)));
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(colour.rgb * alpha, alpha);
}`;

/** Depth and number of the nearest splat that covers a pixel by at least `least`. */
export const PICK_FRAGMENT = /* glsl */ `
precision highp float;
precision highp int;
uniform float leftOfSplit;
uniform float leastAlpha;
in vec4 colour;
in vec2 at;
flat in uvec2 hidden;
flat in float depth;
flat in uint splat;
out vec4 pixel;
void main() {
  if (hidden[leftOfSplit > 0.5 ? 0 : 1] == 1u) discard;
  if (colour.a * exp(-0.5 * dot(at, at)) < leastAlpha) discard;
  pixel = vec4(depth, float(splat & 0xffffu), float(splat >> 16u), 1.0);
  gl_FragDepth = depth / (1.0 + depth);
}`;
