// SPZ (versions 2 and 3) to what the graphics card holds: the numbers of the file as they are, one splat after the other.
//
// A splat is `stride` words of 32 bits: x and alpha, y and red, z and green, blue and the three log scales, the
// quaternion, then the SH bytes, and one more word where the splats belong to several scenes: whose it is.

export interface Packed {
  count: number;
  degree: number; // of SH
  stride: number; // words of one splat
  step: number; // of the positions
  smallestThree: boolean; // version 3; x y z before
  words: Uint32Array;
}

const SH_COEFFICIENTS = [0, 3, 8, 15];
const MAX_COUNT = 20_000_000;

/** Largest part of a GLB or SPZ that is unpacked; a page is no place for a file that unpacks without end. */
const MAX_BYTES = 2 ** 31 - 1;

async function gunzip(bytes: Uint8Array<ArrayBuffer>): Promise<Uint8Array> {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const reader = stream.getReader();
  let out = new Uint8Array(0);
  let length = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    if (length === 0 && value.length >= 16) out = new Uint8Array(expected(value));
    if (length + value.length > out.length) throw new Error("an SPZ holds more than its header says");
    out.set(value, length);
    length += value.length;
  }
  if (length < out.length || length < 16) throw new Error("an SPZ is truncated");
  return out;
}

function header(bytes: Uint8Array) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  if (view.getUint32(0, true) !== 0x5053474e) throw new Error("not an SPZ");
  const version = view.getUint32(4, true);
  const count = view.getUint32(8, true);
  const degree = bytes[12] ?? 0;
  if (version !== 2 && version !== 3) throw new Error(`SPZ version ${version}; the page reads 2 and 3`);
  const coefficients = SH_COEFFICIENTS[degree];
  if (coefficients === undefined || count > MAX_COUNT) throw new Error("an SPZ is damaged");
  return { version, count, degree, coefficients, bits: bytes[13] ?? 0 };
}

function expected(first: Uint8Array): number {
  const { version, count, coefficients } = header(first);
  const size = 16 + count * (9 + 1 + 3 + 3 + (version >= 3 ? 4 : 3) + 3 * coefficients);
  if (size > MAX_BYTES) throw new Error("an SPZ is too large for the page");
  return size;
}

/**
 * Unpacks an SPZ.
 * @param shares how many splats of each share follow each other, where they belong to several scenes
 */
export async function unpack(
  bytes: Uint8Array<ArrayBuffer>,
  shares?: { owner: number; count: number }[],
): Promise<Packed> {
  const raw = await gunzip(bytes);
  const { version, count, degree, coefficients, bits } = header(raw);
  const own = shares ? 1 : 0;
  const stride = 5 + Math.ceil((3 * coefficients) / 4) + own;
  const words = new Uint32Array(count * stride);
  const position = 16;
  const alpha = position + 9 * count;
  const rgb = alpha + count;
  const scale = rgb + 3 * count;
  const rotation = scale + 3 * count;
  const width = version >= 3 ? 4 : 3;
  const sh = rotation + width * count;
  const b = (k: number): number => raw[k] ?? 0;
  for (let i = 0, to = 0; i < count; i++, to += stride) {
    const p = position + 9 * i;
    const c = rgb + 3 * i;
    const s = scale + 3 * i;
    const q = rotation + width * i;
    words[to] = b(p) | (b(p + 1) << 8) | (b(p + 2) << 16) | (b(alpha + i) << 24);
    words[to + 1] = b(p + 3) | (b(p + 4) << 8) | (b(p + 5) << 16) | (b(c) << 24);
    words[to + 2] = b(p + 6) | (b(p + 7) << 8) | (b(p + 8) << 16) | (b(c + 1) << 24);
    words[to + 3] = b(c + 2) | (b(s) << 8) | (b(s + 1) << 16) | (b(s + 2) << 24);
    words[to + 4] = b(q) | (b(q + 1) << 8) | (b(q + 2) << 16) | (width === 4 ? b(q + 3) << 24 : 0);
    for (let k = 0, h = sh + 3 * coefficients * i; k < 3 * coefficients; k++)
      words[to + 5 + (k >> 2)] = (words[to + 5 + (k >> 2)] as number) | (b(h + k) << (8 * (k & 3)));
  }
  if (shares) {
    let i = 0;
    for (const { owner, count: n } of shares) {
      for (const end = Math.min(count, i + n); i < end; i++) words[(i + 1) * stride - 1] = owner;
    }
    if (i !== count || shares.reduce((sum, share) => sum + share.count, 0) !== count)
      throw new Error("the overview does not hold what the map says");
  }
  return { count, degree, stride, step: 2 ** -bits, smallestThree: version >= 3, words };
}

/** Splats as numbers: those of a glTF without compression. */
export interface Floats {
  positions: Float32Array; // x y z
  rotations: Float32Array; // x y z w, of length 1
  scales: Float32Array; // linear
  opacities: Float32Array;
  sh: Float32Array[]; // red, green and blue of each coefficient
}

/** Packs as SPZ does, so that one way of drawing serves; positions are counted from `middle`. */
export function pack({ positions, rotations, scales, opacities, sh }: Floats): Packed & { middle: number[] } {
  const count = opacities.length;
  const degree = SH_COEFFICIENTS.indexOf(sh.length - 1);
  if (degree < 0) throw new Error(`${sh.length} SH coefficients are of no degree`);
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  positions.forEach((v, i) => {
    low[i % 3] = Math.min(low[i % 3] as number, v);
    high[i % 3] = Math.max(high[i % 3] as number, v);
  });
  const middle = low.map((v, i) => (v + (high[i] as number)) / 2);
  const reach = Math.max(1e-6, ...high.map((v, i) => v - (middle[i] as number)));
  const step = reach / (2 ** 23 - 1);
  const stride = 5 + Math.ceil((3 * (sh.length - 1)) / 4);
  const words = new Uint32Array(count * stride);
  const byte = (v: number) => Math.min(255, Math.max(0, Math.round(v)));
  for (let i = 0, to = 0; i < count; i++, to += stride) {
    const three = (of: Float32Array, k: number) => of[3 * i + k] ?? 0;
    const colour = [0, 1, 2].map((k) => byte((three(sh[0] as Float32Array, k) * 0.15 + 0.5) * 255)) as number[];
    const log = [0, 1, 2].map((k) => byte((Math.log(Math.max(three(scales, k), 1e-30)) + 10) * 16)) as number[];
    const at = (k: number) => Math.round((three(positions, k) - (middle[k] as number)) / step) & 0xffffff;
    words[to] = at(0) | (byte(255 * (opacities[i] ?? 0)) << 24);
    words[to + 1] = at(1) | ((colour[0] as number) << 24);
    words[to + 2] = at(2) | ((colour[1] as number) << 24);
    words[to + 3] =
      (colour[2] as number) | ((log[0] as number) << 8) | ((log[1] as number) << 16) | ((log[2] as number) << 24);
    const q = [0, 1, 2, 3].map((k) => rotations[4 * i + k] ?? 0);
    const largest = q.reduce((best, v, k) => (Math.abs(v) > Math.abs(q[best] as number) ? k : best), 0);
    const sign = (q[largest] as number) < 0 ? -1 : 1;
    let packed = largest;
    q.forEach((v, k) => {
      if (k === largest) return;
      const level = Math.min(511, Math.round(Math.abs(v) * 511 * Math.SQRT2));
      packed = ((packed << 10) | (v * sign < 0 ? 512 : 0) | level) >>> 0;
    });
    words[to + 4] = packed;
    for (let k = 0; k < 3 * (sh.length - 1); k++) {
      const value = byte(128 * (three(sh[1 + Math.floor(k / 3)] as Float32Array, k % 3) + 1));
      words[to + 5 + (k >> 2)] = (words[to + 5 + (k >> 2)] as number) | (value << (8 * (k & 3)));
    }
  }
  return { count, degree, stride, step, smallestThree: true, words, middle };
}
