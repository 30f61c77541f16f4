// What the graphics card holds and draws: splats, and lines and points over them.
//
// A splat is three texels of four 32-bit words: mean and RGBA; covariance xx xy xz yy; covariance yz zz, scene, unused.
// Projection and cuts are those of gsmap.render: EWA with 0.3 px^2 added, opacity cut at 1/255 and held below 0.99.

const ROW = 1024; // splats in one row of the texture
const PADDING = 65535;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D splats;
uniform mat4 view;        // map to camera: x right, y down, z forward
uniform vec2 focal;       // px
uniform vec2 size;        // px
uniform float near;
uniform float byScene;
uniform vec3 palette[64];
in vec2 corner;
in uint index;
out vec2 at;
out vec4 colour;
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  int row = int(index) / ${ROW};
  int column = 3 * (int(index) % ${ROW});
  uvec4 a = texelFetch(splats, ivec2(column, row), 0);
  vec3 mean = (view * vec4(uintBitsToFloat(a.xyz), 1.0)).xyz;
  if (mean.z < near) return;
  vec2 centre = focal * mean.xy / mean.z + 0.5 * size;
  vec4 b = uintBitsToFloat(texelFetch(splats, ivec2(column + 1, row), 0));
  uvec4 c = texelFetch(splats, ivec2(column + 2, row), 0);
  vec2 d = uintBitsToFloat(c.xy);
  mat3 covariance = mat3(b.x, b.y, b.z, b.y, b.w, d.x, b.z, d.x, d.y);
  vec2 bound = 1.3 * 0.5 * size / focal;
  vec2 ray = clamp(mean.xy / mean.z, -bound, bound);
  mat3 J = mat3(focal.x, 0.0, 0.0, 0.0, focal.y, 0.0, -focal.x * ray.x, -focal.y * ray.y, 0.0) * (1.0 / mean.z);
  mat3 T = J * mat3(view);
  mat3 S = T * covariance * transpose(T);
  float xx = S[0][0] + 0.3, yy = S[1][1] + 0.3, xy = S[0][1];
  float middle = 0.5 * (xx + yy);
  float radius = length(vec2(0.5 * (xx - yy), xy));
  float major = middle + radius;
  float minor = max(middle - radius, 0.1);
  vec2 axis = radius > 1e-6 * middle ? normalize(abs(xy) > 1e-9 ? vec2(xy, major - xx) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0))) : vec2(1.0, 0.0);
  vec4 rgba = vec4(uvec4(a.w, a.w >> 8, a.w >> 16, a.w >> 24) & 255u) / 255.0;
  float reach = sqrt(2.0 * log(255.0 * max(rgba.a, 1.0 / 255.0)));
  at = corner * reach;
  vec2 offset = sqrt(major) * at.x * axis + sqrt(minor) * at.y * vec2(-axis.y, axis.x);
  if (any(greaterThan(abs(centre - 0.5 * size), 0.5 * size + reach * sqrt(major)))) return;
  vec2 ndc = 2.0 * (centre + offset) / size - 1.0;
  gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);
  colour = vec4(mix(rgba.rgb, palette[c.z % 64u] * (0.4 + 0.6 * dot(rgba.rgb, vec3(0.3, 0.6, 0.1))), byScene), rgba.a);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
in vec4 colour;
out vec4 pixel;
void main() {
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(at, at)));
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(colour.rgb * alpha, alpha);
}`;

const LINE_VERTEX = `#version 300 es
precision highp float;
uniform mat4 view;
uniform vec2 focal;
uniform vec2 size;
uniform float near;
uniform float width;
in vec3 place;
in vec4 tint;
out vec4 colour;
void main() {
  vec3 p = (view * vec4(place, 1.0)).xyz;
  vec2 slope = 2.0 * focal / size;
  gl_Position = vec4(p.x * slope.x, -p.y * slope.y, p.z - 2.0 * near, p.z);
  gl_PointSize = width;
  colour = tint;
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec4 colour;
out vec4 pixel;
void main() { pixel = vec4(colour.rgb * colour.a, colour.a); }`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(made).map((s) => gl.getShaderInfoLog(s));
    throw new Error(`shaders do not compile: ${logs.join(" ")} ${gl.getProgramInfoLog(made)}`);
  }
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(made, i).name.replace("[0]", "");
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms, attribute: (name) => gl.getAttribLocation(made, name) };
}

export class Renderer {
  constructor(canvas, palette) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    this.palette = new Float32Array(palette.flat());
    this.splat = program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.line = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.texels = new Uint32Array(0);
    this.positions = new Float32Array(0);
    this.scenes = new Uint16Array(0);
    this.rows = 0;
    this.drawn = 0;
    this.texture = gl.createTexture();
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    this.#buffer(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    this.#attribute(this.splat, "corner", 2);
    this.order = this.#buffer(new Uint32Array(0));
    const index = this.splat.attribute("index");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
    this.lineArray = gl.createVertexArray();
    gl.bindVertexArray(this.lineArray);
    this.lineBuffer = this.#buffer(new Float32Array(0));
    this.#attribute(this.line, "place", 3, 28, 0);
    this.#attribute(this.line, "tint", 4, 28, 12);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    // Integer textures cannot be filtered.
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }

  #buffer(data) {
    const gl = this.gl;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    return buffer;
  }

  #attribute(of, name, width, stride = 0, offset = 0) {
    const at = of.attribute(name);
    this.gl.enableVertexAttribArray(at);
    this.gl.vertexAttribPointer(at, width, this.gl.FLOAT, false, stride, offset);
  }

  // Adds a scene's rows of ten words (mean, covariance, RGBA); returns how many splats there were room for.
  add(scene, bytes) {
    const gl = this.gl;
    const words = new Uint32Array(bytes);
    const limit = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const room = Math.max(0, limit - this.rows) * ROW;
    const count = Math.min(words.length / 10, room);
    const rows = Math.ceil(count / ROW);
    if (!rows) return 0;
    const first = this.rows * ROW;
    this.#grow(this.rows + rows);
    const floats = new Float32Array(words.buffer);
    for (let i = 0; i < count; i++) {
      const from = 10 * i;
      const to = 12 * (first + i);
      for (let k = 0; k < 3; k++) {
        this.texels[to + k] = words[from + k];
        this.positions[3 * (first + i) + k] = floats[from + k];
      }
      this.texels[to + 3] = words[from + 9];
      for (let k = 0; k < 6; k++) this.texels[to + 4 + k] = words[from + 3 + k];
      this.texels[to + 10] = scene;
    }
    this.scenes.fill(scene, first, first + count);
    this.rows += rows;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, 3 * ROW, this.rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT,
      this.texels.subarray(0, 12 * ROW * this.rows));
    return count;
  }

  #grow(rows) {
    const capacity = this.scenes.length / ROW;
    if (rows <= capacity) return;
    const wanted = Math.max(rows, 2 * capacity) * ROW;
    const grown = (Kind, width, old) => {
      const out = new Kind(width * wanted);
      out.set(old);
      return out;
    };
    this.texels = grown(Uint32Array, 12, this.texels);
    this.positions = grown(Float32Array, 3, this.positions);
    const before = this.scenes.length;
    this.scenes = grown(Uint16Array, 1, this.scenes).fill(PADDING, before);
  }

  setOrder(order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.drawn = order.length;
  }

  // camera: {view: column-major mat4, focal: [fx, fy] px, near}; overlays: [{mode, width, vertices: Float32Array of 7}].
  draw(camera, { splats, byScene, background, overlays }) {
    const gl = this.gl;
    const { width, height } = gl.canvas;
    gl.viewport(0, 0, width, height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const use = ({ made, uniforms }) => {
      gl.useProgram(made);
      gl.uniformMatrix4fv(uniforms.view, false, camera.view);
      gl.uniform2f(uniforms.focal, ...camera.focal);
      gl.uniform2f(uniforms.size, width, height);
      gl.uniform1f(uniforms.near, camera.near);
    };
    if (splats && this.drawn) {
      use(this.splat);
      gl.uniform1f(this.splat.uniforms.byScene, byScene ? 0.85 : 0);
      gl.uniform3fv(this.splat.uniforms.palette, this.palette);
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.bindVertexArray(this.quads);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
    }
    use(this.line);
    gl.bindVertexArray(this.lineArray);
    for (const overlay of overlays) {
      if (!overlay.vertices.length) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
      gl.bufferData(gl.ARRAY_BUFFER, overlay.vertices, gl.DYNAMIC_DRAW);
      gl.uniform1f(this.line.uniforms.width, overlay.width);
      gl.drawArrays(gl[overlay.mode], 0, overlay.vertices.length / 7);
    }
  }
}
