// Trees of 3D Tiles: what they say, and the fetching of what is wanted.
import { Box3, Frustum, Matrix4, Vector3 } from "three";
import type { TreeProgress, Vector } from "../contract";
import type { Choice } from "./lod";
import type { SplatTile } from "./splats";
import type { Floats, Packed } from "./spz";
import { pack, unpack } from "./spz";

const EXTENSION = "KHR_gaussian_splatting";
const SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2";
/** 3D Tiles turns the content of a tile from y up to z up. */
const Y_UP_TO_Z_UP = new Matrix4().set(1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1);
const MAX_TILES = 100_000;
const MAX_DEPTH = 64;

interface TileJson {
  boundingVolume?: { box?: number[]; sphere?: number[] };
  geometricError?: number;
  content?: { uri?: string };
  contents?: { uri?: string }[];
  children?: TileJson[];
  transform?: number[];
  extras?: Record<string, unknown>;
}

/** A tile of a scene's tree, of merged tiles, or a scene's share of the overview (`uri` null and `mesh` never). */
export class Tile implements Choice<Tile> {
  finer: Tile[] | null;
  count: number;
  state: "none" | "loading" | "ready" | "failed" = "none";
  mesh: SplatTile | null = null;
  lastUsed = 0;
  readonly isCountGuessed: boolean;
  aborter: AbortController | null = null;

  constructor(
    readonly tree: Tree,
    readonly box: Box3, // frame of the tree; around all that it draws
    readonly core: Box3, // around what matters of that, strays left out: distances are from it
    readonly error: number, // frame of the tree; infinite where it draws nothing
    readonly uri: string | null, // absolute
    readonly matrix: Matrix4, // of the tile in the tree
    count: number | null,
    finer: Tile[] | null,
    /** A tileset of its own that its finer tiles are in. */
    readonly external: string | null = null,
  ) {
    this.finer = finer;
    this.isCountGuessed = count === null;
    this.count = count ?? (uri ? ASSUMED_COUNT : 0);
  }
}
/** Splats of a tile that does not say how many it has, until it is there. */
const ASSUMED_COUNT = 50_000;

const STRAYS_WEIGHT = 0.25;

/** A tileset and where it lies. */
export class Tree {
  root: Tile | null = null;
  state: "none" | "loading" | "waiting" | "ready" | "failed" = "none";
  retryAt = 0;
  /** Where its frame lies in the map's; [s R | t]. */
  readonly pose = new Matrix4();
  private readonly inverse = new Matrix4();
  private scale = 1;
  private readonly frustum = new Frustum();
  private readonly eye = new Vector3();

  constructor(
    readonly url: string,
    public row: number, // of the table of poses
  ) {}

  /** Takes the view: planes and eye in the tree's own frame. */
  see(viewProjection: Matrix4, eye: Vector3): void {
    this.inverse.copy(this.pose).invert();
    this.scale = this.pose.getMaxScaleOnAxis();
    this.frustum.setFromProjectionMatrix(new Matrix4().multiplyMatrices(viewProjection, this.pose));
    this.eye.copy(eye).applyMatrix4(this.inverse);
  }

  isInSight(box: Box3): boolean {
    return this.frustum.intersectsBox(box);
  }

  /** Distance of the eye from a box, in the map's unit; 0 inside. */
  distance(box: Box3): number {
    return box.distanceToPoint(this.eye) * this.scale;
  }

  /** Pixels that an error of the tree's unit has on the screen. */
  errorPx(tile: Tile, focalPx: number, nearest: number): number {
    if (!this.isInSight(tile.box)) return -1;
    // Of what shows nothing but strays, coarser levels will do.
    const weight = this.isInSight(tile.core) ? 1 : STRAYS_WEIGHT;
    return (weight * tile.error * this.scale * focalPx) / Math.max(this.distance(tile.core), nearest);
  }
}

function boxOf(volume: TileJson["boundingVolume"], matrix: Matrix4): Box3 {
  const out = new Box3();
  const b = volume?.box;
  const s = volume?.sphere;
  if (b?.length === 12) {
    const [cx, cy, cz, ax, ay, az, bx, by, bz, dx, dy, dz] = b as [number, number, number, ...number[]];
    const half = new Vector3(
      Math.abs(ax ?? 0) + Math.abs(bx ?? 0) + Math.abs(dx ?? 0),
      Math.abs(ay ?? 0) + Math.abs(by ?? 0) + Math.abs(dy ?? 0),
      Math.abs(az ?? 0) + Math.abs(bz ?? 0) + Math.abs(dz ?? 0),
    );
    const centre = new Vector3(cx, cy, cz);
    out.set(centre.clone().sub(half), centre.clone().add(half));
  } else if (s?.length === 4) {
    const [x, y, z, r] = s as [number, number, number, number];
    out.set(new Vector3(x - r, y - r, z - r), new Vector3(x + r, y + r, z + r));
  } else throw new Error("a tile has neither box nor sphere");
  return out.applyMatrix4(matrix);
}

/** The box of what matters of a tile, where it says one. */
function coreOf(extras: TileJson["extras"], matrix: Matrix4): Box3 | null {
  const [x0, y0, z0, x1, y1, z1] = ["x0", "y0", "z0", "x1", "y1", "z1"].map((name) => Number(extras?.[`core_${name}`]));
  const out = new Box3(new Vector3(x0, y0, z0), new Vector3(x1, y1, z1));
  return out.min.lengthSq() + out.max.lengthSq() < Infinity && !out.isEmpty() ? out.applyMatrix4(matrix) : null;
}

/** A tileset's JSON as tiles; the root's own transform is left out: the frame is the root's. */
export function readTileset(tree: Tree, json: unknown, url: string, outer: Matrix4 | null = null): Tile {
  const root = (json as { root?: TileJson }).root;
  if (!root) throw new Error(`${url} is not a tileset`);
  let seen = 0;
  const read = (tile: TileJson, parent: Matrix4, depth: number, isRoot: boolean): Tile => {
    if (++seen > MAX_TILES || depth > MAX_DEPTH) throw new Error(`${url} has too many tiles`);
    const matrix = parent.clone();
    if (tile.transform?.length === 16 && !(isRoot && !outer)) matrix.multiply(new Matrix4().fromArray(tile.transform));
    const children = (tile.children ?? []).map((child) => read(child, matrix, depth + 1, false));
    const uris = (tile.contents ?? (tile.content ? [tile.content] : [])).flatMap((one) => one.uri ?? []);
    const content = uris.find((uri) => !isJson(uri)) ?? null;
    const external = uris.find(isJson) ?? null;
    const scale = matrix.getMaxScaleOnAxis();
    const count = Number(tile.extras?.["num_gaussians"] ?? tile.extras?.["gaussians"]);
    const box = boxOf(tile.boundingVolume, matrix);
    return new Tile(
      tree,
      box,
      coreOf(tile.extras, matrix) ?? box,
      content ? (tile.geometricError ?? 0) * scale : Infinity,
      content && new URL(content, url).href,
      matrix,
      count > 0 ? count : null,
      external ? null : children,
      external && new URL(external, url).href,
    );
  };
  return read(root, outer ?? new Matrix4(), 0, true);
}
const isJson = (uri: string) => /\.json($|\?)/.test(uri);

/** A tileset, or how long to wait for it where it is still being made. */
export async function fetchTileset(
  url: string,
  rank: number,
  signal: AbortSignal,
): Promise<{ json: unknown } | { retry_s: number }> {
  const ask = new URL(url, document.baseURI);
  if (rank > 0) ask.searchParams.set("rank", String(rank));
  const response = await fetch(ask, { signal, priority: "low" });
  if (!response.ok) throw new Error(`${ask.pathname}: ${response.status} ${response.statusText}`);
  if (response.status === 202) return { retry_s: Math.max(0.2, ((await response.json()) as TreeProgress).retry_s) };
  return { json: await response.json() };
}

export interface Content {
  packed: Packed;
  matrix: Matrix4; // of the splats in the tile
  bytes: number; // received
}

/** The splats of a GLB. */
export async function fetchContent(url: string, signal: AbortSignal): Promise<Content> {
  const response = await fetch(url, { signal, priority: "low" });
  if (!response.ok) throw new Error(`${new URL(url).pathname}: ${response.status} ${response.statusText}`);
  const bytes = new Uint8Array(await response.arrayBuffer());
  const { spz, floats, matrix } = readGlb(bytes, url);
  if (spz) return { packed: await unpack(spz), matrix, bytes: bytes.length };
  const packed = pack(floats);
  return {
    packed,
    matrix: matrix.multiply(new Matrix4().makeTranslation(...(packed.middle as Vector))),
    bytes: bytes.length,
  };
}

/**
 * A buffer of a GLB ends with up to three zeros that the browser's inflater does not bear. The stream's own last word
 * is the size of what it holds, and only one place for it fits the number of splats.
 */
function withoutPadding(spz: Uint8Array<ArrayBuffer>, count: number): Uint8Array<ArrayBuffer> {
  const view = new DataView(spz.buffer);
  for (let end = spz.length; end >= Math.max(18, spz.length - 3); end--) {
    const each = (view.getUint32(end - 4, true) - 16) / count;
    if (PAYLOAD_BYTES.includes(each)) return spz.subarray(0, end);
    if (spz[end - 1]) break;
  }
  return spz;
}
/** Of a splat in an SPZ of version 2 and 3, SH degree 0 to 3. */
const PAYLOAD_BYTES = [0, 9, 24, 45].flatMap((sh) => [19 + sh, 20 + sh]);

interface Gltf {
  nodes?: { mesh?: number; matrix?: number[] }[];
  accessors?: { count: number; componentType: number; bufferView?: number; byteOffset?: number }[];
  meshes?: {
    primitives: {
      attributes?: Record<string, number>;
      extensions?: Record<string, { extensions?: Record<string, { bufferView: number }> }>;
    }[];
  }[];
  bufferViews?: { byteOffset?: number; byteLength: number }[];
}

type Read = { matrix: Matrix4 } & (
  { spz: Uint8Array<ArrayBuffer>; floats?: undefined } | { spz?: undefined; floats: Floats }
);

function readGlb(bytes: Uint8Array<ArrayBuffer>, url: string): Read {
  const view = new DataView(bytes.buffer);
  if (bytes.length < 28 || view.getUint32(0, true) !== 0x46546c67) throw new Error(`${url} is not a GLB`);
  const jsonLength = view.getUint32(12, true);
  const gltf = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + jsonLength))) as Gltf;
  const node = gltf.nodes?.find((one) => one.mesh !== undefined);
  const primitive = gltf.meshes?.[node?.mesh ?? 0]?.primitives[0];
  const splatting = primitive?.extensions?.[EXTENSION];
  const matrix = Y_UP_TO_Z_UP.clone();
  if (node?.matrix?.length === 16) matrix.multiply(new Matrix4().fromArray(node.matrix));
  const part = (index: number | undefined) => {
    const found = index === undefined ? undefined : gltf.bufferViews?.[index];
    if (!found) throw new Error(`${url} holds no splats that the page reads`);
    const start = 20 + jsonLength + 8 + (found.byteOffset ?? 0);
    return bytes.slice(start, start + found.byteLength);
  };
  const packed = splatting?.extensions?.[SPZ_EXTENSION];
  if (packed) {
    const count = gltf.accessors?.[primitive?.attributes?.["POSITION"] ?? -1]?.count ?? 0;
    return { spz: withoutPadding(part(packed.bufferView), count), matrix };
  }
  const values = (name: string): Float32Array | null => {
    const index = primitive?.attributes?.[name];
    const accessor = index === undefined ? undefined : gltf.accessors?.[index];
    if (!accessor) return null;
    if (accessor.componentType !== 5126) throw new Error(`${url}: ${name} is not of float32`);
    return new Float32Array(part(accessor.bufferView).buffer, accessor.byteOffset ?? 0);
  };
  const named = (name: string) => {
    const found = values(name);
    if (!found) throw new Error(`${url} holds no splats that the page reads: it has no ${name}`);
    return found;
  };
  const sh: Float32Array[] = [];
  for (let degree = 0; degree <= 3; degree++)
    for (let k = 0; k < 2 * degree + 1; k++) {
      const found = values(`${EXTENSION}:SH_DEGREE_${degree}_COEF_${k}`);
      if (found) sh.push(found);
    }
  const floats = {
    positions: named("POSITION"),
    rotations: named(`${EXTENSION}:ROTATION`),
    scales: named(`${EXTENSION}:SCALE`),
    opacities: named(`${EXTENSION}:OPACITY`),
    sh,
  };
  return { floats, matrix };
}
