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
