// The splats on the graphics card: each tile's numbers are uploaded once, as they came; where a scene lies and on which
// side of a split it is drawn stands in one small table, so that moving or hiding a scene uploads nothing else.
import { SparkRenderer, SplatAccumulator, SplatGenerator, dyno } from "@sparkjsdev/spark";
import {
  DataTexture,
  DoubleSide,
  FloatType,
  GLSL3,
  Matrix4,
  NearestFilter,
  NoBlending,
  Quaternion,
  RedIntegerFormat,
  RGBAFormat,
  Scene,
  ShaderMaterial,
  UnsignedIntType,
  Vector3,
  Vector4,
  WebGLRenderTarget,
} from "three";
import type { PerspectiveCamera, WebGLRenderer } from "three";
import { PICK_FRAGMENT, SIGN_OFFSET, SPLAT_FRAGMENT, SPLAT_VERTEX } from "./shaders";
import type { Packed } from "./spz";

const WIDTH = 2048; // words in one row of a tile's texture
const TEXELS = 3; // of one row of the table: quaternion; shift and scale; sides

/** Where each scene lies and on which sides it is drawn. Two rows a scene: of its tree, and of its share of the overview. */
export class Table {
  readonly texture: DataTexture;
  private readonly values: Float32Array;

  constructor(readonly rows: number) {
    this.values = new Float32Array(4 * TEXELS * rows);
    this.texture = new DataTexture(this.values, TEXELS, rows, RGBAFormat, FloatType);
    this.texture.minFilter = this.texture.magFilter = NearestFilter;
  }

  /** Sets one row; returns whether it was another. @param sides 1: left, 2: right, 3: both, 0: hidden */
  set(row: number, pose: Matrix4, sides: number): boolean {
    const shift = new Vector3();
    const turn = new Quaternion();
    const scale = new Vector3();
    pose.decompose(shift, turn, scale);
    const next = [turn.x, turn.y, turn.z, turn.w, shift.x, shift.y, shift.z, scale.x, sides, 0, 0, 0];
    const at = 4 * TEXELS * row;
    const same = next.every((value, i) => this.values[at + i] === Math.fround(value));
    if (!same) {
      this.values.set(next, at);
      this.texture.needsUpdate = true;
    }
    return !same;
  }

  sides(row: number): number {
    return this.values[4 * TEXELS * row + 8] ?? 0;
  }

  dispose(): void {
    this.texture.dispose();
  }
}

const FETCH = /* glsl */ `
uint wordOfSplat(usampler2D words, int at) { return texelFetch(words, ivec2(at % ${WIDTH}, at / ${WIDTH}), 0).r; }

float shByte(usampler2D words, int at, int k) {
  return (float((wordOfSplat(words, at + 5 + (k >> 2)) >> uint(8 * (k & 3))) & 255u) - 128.0) / 128.0;
}

vec3 shOf(usampler2D words, int at, int k) {
  return vec3(shByte(words, at, 3 * k), shByte(words, at, 3 * k + 1), shByte(words, at, 3 * k + 2));
}

// Real spherical harmonics with the signs that every trainer writes, without degree 0.
vec3 shColour(usampler2D words, int at, int degree, vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  vec3 sum = 0.4886025119029199 * (-y * shOf(words, at, 0) + z * shOf(words, at, 1) - x * shOf(words, at, 2));
  if (degree < 2) return sum;
  float xx = x * x, yy = y * y, zz = z * z;
  sum += 1.0925484305920792 * (x * y * shOf(words, at, 3) - y * z * shOf(words, at, 4) - x * z * shOf(words, at, 6))
       + 0.31539156525252005 * (2.0 * zz - xx - yy) * shOf(words, at, 5)
       + 0.5462742152960396 * (xx - yy) * shOf(words, at, 7);
  if (degree < 3) return sum;
  return sum - 0.5900435899266435 * (y * (3.0 * xx - yy) * shOf(words, at, 8) + x * (xx - 3.0 * yy) * shOf(words, at, 14))
       + 2.890611442640554 * x * y * z * shOf(words, at, 9)
       - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * shOf(words, at, 10) + x * shOf(words, at, 12))
       + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * shOf(words, at, 11)
       + 1.445305721320277 * z * (xx - yy) * shOf(words, at, 13);
}

vec4 smallestThree(uint packed) {
  float v[3];
  float rest = 1.0;
  for (int i = 0; i < 3; i++) {
    uint three = packed >> uint(20 - 10 * i);
    v[i] = float(three & 511u) * (0.7071067811865476 / 511.0) * ((three & 512u) != 0u ? -1.0 : 1.0);
    rest -= v[i] * v[i];
  }
  float w = sqrt(max(rest, 0.0));
  uint largest = packed >> 30u;
  return largest == 0u ? vec4(w, v[0], v[1], v[2]) : largest == 1u ? vec4(v[0], w, v[1], v[2])
       : largest == 2u ? vec4(v[0], v[1], w, v[2]) : vec4(v[0], v[1], v[2], w);
}

vec4 xyzQuaternion(uint packed) {
  vec3 v = vec3(uvec3(packed, packed >> 8u, packed >> 16u) & 255u) / 127.5 - 1.0;
  return normalize(vec4(v, sqrt(max(0.0, 1.0 - dot(v, v)))));
}
`;

/** The splats of one tile, or of the overview. */
export class SplatTile extends SplatGenerator {
  readonly bytes: number; // uploaded, and held by the graphics card
  private readonly texture: DataTexture;
  private readonly layout: Vector4;
  private readonly table: { value: DataTexture };

  /**
   * @param matrix from the splats' frame to the frame that the table places
   * @param row of the table; null where each splat says its own
   */
  constructor(
    readonly packed: Omit<Packed, "words"> & { words?: Uint32Array },
    matrix: Matrix4,
    table: Table,
    public row: number | null,
  ) {
    super({ numSplats: packed.count });
    const height = Math.ceil((packed.count * packed.stride) / WIDTH);
    const words = new Uint32Array(height * WIDTH);
    words.set(packed.words as Uint32Array);
    delete packed.words;
    this.bytes = words.byteLength;
    this.texture = new DataTexture(words, WIDTH, height, RedIntegerFormat, UnsignedIntType);
    this.texture.internalFormat = "R32UI";
    this.texture.minFilter = this.texture.magFilter = NearestFilter;
    this.texture.unpackAlignment = 4;
    this.texture.needsUpdate = true;
    // The card has them now; the page need not hold them, too.
    this.texture.onUpdate = () => ((this.texture.source as { data: unknown }).data = null);
    const shift = new Vector3();
    const turn = new Quaternion();
    const scale = new Vector3();
    matrix.decompose(shift, turn, scale);
    this.layout = new Vector4(packed.stride, packed.degree, packed.smallestThree ? 1 : 0, row ?? -1);
    const layout = dyno.dynoIvec4(this.layout as never);
    const placed = dyno.dynoSampler2D(table.texture);
    this.table = placed;
    this.generator = dyno.dynoBlock({ index: "int" }, { gsplat: dyno.Gsplat }, ({ index }) => {
      const made = new dyno.Dyno({
        inTypes: {
          index: "int",
          words: "usampler2D",
          table: "sampler2D",
          layout: "ivec4",
          step: "float",
          turn: "vec4",
          shift: "vec4",
          eye: "vec3",
        } as const,
        outTypes: { gsplat: dyno.Gsplat },
        inputs: {
          index,
          words: dyno.dynoUsampler2D(this.texture),
          table: placed,
          layout,
          step: dyno.dynoFloat(packed.step),
          turn: dyno.dynoVec4(new Vector4(turn.x, turn.y, turn.z, turn.w)),
          shift: dyno.dynoVec4(new Vector4(shift.x, shift.y, shift.z, scale.x)),
          eye: SplatAccumulator.viewCenterUniform,
        },
        globals: () => [dyno.defineGsplat, FETCH],
        statements: ({ inputs: i, outputs: o }) =>
          dyno.unindentLines(`
            int at = ${i.index} * ${i.layout}.x;
            uint w0 = wordOfSplat(${i.words}, at), w1 = wordOfSplat(${i.words}, at + 1), w2 = wordOfSplat(${i.words}, at + 2);
            uint w3 = wordOfSplat(${i.words}, at + 3), w4 = wordOfSplat(${i.words}, at + 4);
            int row = ${i.layout}.w >= 0 ? ${i.layout}.w : int(wordOfSplat(${i.words}, at + ${i.layout}.x - 1));
            vec4 turn = texelFetch(${i.table}, ivec2(0, row), 0), shift = texelFetch(${i.table}, ivec2(1, row), 0);
            int sides = int(texelFetch(${i.table}, ivec2(2, row), 0).x);
            ${o.gsplat}.flags = sides == 0 ? 0u : GSPLAT_FLAG_ACTIVE;
            ${o.gsplat}.index = ${i.index};
            vec3 stored = vec3(ivec3(uvec3(w0, w1, w2) << 8u) >> 8) * ${i.step};
            vec3 inTree = quatVec(${i.turn}, stored * ${i.shift}.w) + ${i.shift}.xyz;
            ${o.gsplat}.center = quatVec(turn, inTree * shift.w) + shift.xyz;
            ${o.gsplat}.scales = exp(vec3(uvec3(w3 >> 8u, w3 >> 16u, w3 >> 24u) & 255u) / 16.0 - 10.0) * (${i.shift}.w * shift.w);
            vec4 whole = quatQuat(turn, ${i.turn});
            ${o.gsplat}.quaternion = quatQuat(whole, ${i.layout}.z == 1 ? smallestThree(w4) : xyzQuaternion(w4));
            vec3 rgb = (vec3(uvec3(w1 >> 24u, w2 >> 24u, w3 & 255u)) / 255.0 - 0.5) * (0.28209479177387814 / 0.15) + 0.5;
            if (${i.layout}.y > 0) {
              vec3 way = normalize(${o.gsplat}.center - ${i.eye});
              rgb += shColour(${i.words}, at, ${i.layout}.y, quatVec(vec4(-whole.xyz, whole.w), way));
            }
            rgb = max(rgb, vec3(0.0));
            if ((sides & 1) == 0) rgb.r = -rgb.r - ${SIGN_OFFSET};
            if ((sides & 2) == 0) rgb.g = -rgb.g - ${SIGN_OFFSET};
            ${o.gsplat}.rgba = vec4(rgb, float(w0 >> 24u) / 255.0);
          `),
      });
      return { gsplat: made.outputs.gsplat };
    });
  }

  /** Another table places it from now on. */
  move(table: Table, row: number | null): void {
    this.table.value = table.texture;
    this.row = row;
    this.layout.w = row ?? -1;
  }

  override dispose(): void {
    this.removeFromParent();
    this.texture.dispose();
  }
}

/** Spark, drawing by gsmap's conventions. */
export class SplatRenderer {
  readonly spark: SparkRenderer;
  private readonly uniforms = {
    nearest: { value: 0.01 },
    field: { value: new Vector4() },
    clipLow: { value: new Vector3().setScalar(-1e30) },
    clipHigh: { value: new Vector3().setScalar(1e30) },
    ceiling: { value: new Vector4(0, 0, 0, 1) },
    splitAt: { value: 1e9 },
    leftOfSplit: { value: 1 },
    leastAlpha: { value: 0.4 },
  };
  private readonly picking: ShaderMaterial;
  private readonly target = new WebGLRenderTarget(1, 1, { type: FloatType, minFilter: NearestFilter });

  constructor(private readonly renderer: WebGLRenderer) {
    this.spark = new SparkRenderer({
      renderer,
      autoUpdate: false,
      enableLod: false,
      accumExtSplats: true,
      sortRadial: false,
      vertexShader: SPLAT_VERTEX,
      fragmentShader: SPLAT_FRAGMENT,
      extraUniforms: this.uniforms,
      depthTest: false,
    });
    this.picking = new ShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: SPLAT_VERTEX,
      fragmentShader: PICK_FRAGMENT,
      uniforms: this.spark.uniforms,
      depthTest: true,
      depthWrite: true,
      blending: NoBlending,
      side: DoubleSide,
    });
  }

  /** Sorts for a camera and works out the colours that it sees; what is drawn from then on. */
  async prepare(scene: Scene, camera: PerspectiveCamera): Promise<void> {
    await this.spark.update({ scene, camera });
  }

  setCuts(clip: { low: Vector3; high: Vector3 } | null, ceiling: Vector4 | null): void {
    this.uniforms.clipLow.value.copy(clip?.low ?? new Vector3().setScalar(-1e30));
    this.uniforms.clipHigh.value.copy(clip?.high ?? new Vector3().setScalar(1e30));
    this.uniforms.ceiling.value.copy(ceiling ?? new Vector4(0, 0, 0, 1));
  }

  /** @param px of the canvas, from the left; null: no split */
  setSplit(px: number | null): void {
    this.uniforms.splitAt.value = px ?? 1e9;
  }

  draw(scene: Scene, camera: PerspectiveCamera, nearest: number): void {
    this.uniforms.nearest.value = nearest;
    this.setField(camera);
    this.renderer.render(scene, camera);
  }

  /**
   * The nearest surface at a pixel: its depth and the splat's place in what is drawn; null where there is none.
   * @param x, y from the left and top, in pixels of the canvas of that size
   */
  pick(
    camera: PerspectiveCamera,
    x: number,
    y: number,
    width: number,
    height: number,
  ): { depth: number; splat: number } | null {
    const { renderer, spark } = this;
    const one = camera.clone();
    one.matrixWorld.copy(camera.matrixWorld);
    one.matrixWorldInverse.copy(camera.matrixWorldInverse);
    one.matrixAutoUpdate = one.matrixWorldAutoUpdate = false;
    // The pixel fills the picture of one pixel.
    const ndcX = (2 * (x + 0.5)) / width - 1;
    const ndcY = 1 - (2 * (y + 0.5)) / height;
    one.projectionMatrix
      .set(width, 0, 0, -width * ndcX, 0, height, 0, -height * ndcY, 0, 0, 1, 0, 0, 0, 0, 1)
      .multiply(camera.projectionMatrix);
    one.projectionMatrixInverse.copy(one.projectionMatrix).invert();
    this.uniforms.leftOfSplit.value = x < this.uniforms.splitAt.value ? 1 : 0;
    const only = new Scene();
    const parent = spark.parent;
    const material = spark.material;
    const mutable = spark as { material: ShaderMaterial };
    const before = renderer.getRenderTarget();
    let found: { depth: number; splat: number } | null = null;
    try {
      mutable.material = this.picking;
      only.add(spark);
      renderer.setRenderTarget(this.target);
      renderer.setClearColor(0, 0);
      for (const least of [0.4, 0.1]) {
        this.uniforms.leastAlpha.value = least;
        renderer.clear();
        renderer.render(only, one);
        const out = new Float32Array(4);
        renderer.readRenderTargetPixels(this.target, 0, 0, 1, 1, out);
        if (out[3]) {
          found = { depth: out[0] ?? 0, splat: (out[1] ?? 0) + 65536 * (out[2] ?? 0) };
          break;
        }
      }
    } finally {
      mutable.material = material;
      renderer.setRenderTarget(before);
      parent?.add(spark);
    }
    return found;
  }

  /** The tile that a picked splat is of, and its place in it. */
  owner(splat: number): { tile: SplatTile; index: number } | null {
    for (const { node, base, count } of this.spark.display.mapping)
      if (node instanceof SplatTile && splat >= base && splat < base + count)
        return { tile: node, index: splat - base };
    return null;
  }

  private setField(camera: PerspectiveCamera): void {
    const m = camera.projectionMatrix.elements;
    const [fx, fy, px, py] = [m[0] ?? 1, m[5] ?? 1, m[8] ?? 0, m[9] ?? 0];
    this.uniforms.field.value.set((px - 1.3) / fx, (py - 1.3) / fy, (px + 1.3) / fx, (py + 1.3) / fy);
  }

  dispose(): void {
    this.spark.dispose();
    this.picking.dispose();
    this.target.dispose();
  }
}
