// Lines over the splats: what is known of the map beside what it looks like. Each line belongs to a thing or to none,
// so that a thing can be picked by it.
import { Color, Group, Vector3, Vector4 } from "three";
import type { Matrix4, PerspectiveCamera } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Box, ChangeEntry, Matrix3, Vector } from "../contract";
import type { Pick } from "./stage";

export type Thing = NonNullable<Pick["thing"]>;

/** Lines of one colour. */
export interface Lines {
  points: number[]; // x y z of both ends, one segment after the other
  colour: number;
  thing?: Thing;
  scene?: number;
}

/** Told apart without seeing colours, too: by lightness. */
export const COLOURS = {
  used: 0x2fbf83,
  tentative: 0xf2b134,
  rejected: 0xd64570,
  unused: 0x8a8f98,
  camera: 0x7fb2ff,
  photo: 0xffd166,
  node: 0xff8a5c,
  box: 0x97a3b6,
  ellipsoid: 0xc792ea,
  object: 0x5ad1e6,
  room: 0xe7e3d4,
  correspondence: 0x9be564,
  clip: 0x4f9dff,
  measure: 0xff4fa3,
};
export const CHANGE_COLOURS: Record<ChangeEntry["kind"], number> = {
  appeared: 0x2fbf83,
  disappeared: 0xd64570,
  moved: 0x4f9dff,
  recoloured: 0xc792ea,
  replaced: 0xf2913d,
  lighting: 0xf5e663,
};
/** Standard deviations of the ellipsoid that holds 95 % of a normal distribution in space. */
const SIGMAS_95 = Math.sqrt(7.814727903);
const PICK_PX = 7;

export class Overlays {
  readonly group = new Group();
  private readonly layers = new Map<string, { lines: Lines[]; object: LineSegments2 }>();

  /** Replaces a layer. @param width of its lines in pixels */
  set(name: string, lines: Lines[], width = 1.5): void {
    const old = this.layers.get(name);
    if (old) {
      this.group.remove(old.object);
      old.object.geometry.dispose();
      old.object.material.dispose();
      this.layers.delete(name);
    }
    const count = lines.reduce((sum, one) => sum + one.points.length, 0);
    if (!count) return;
    const positions = new Float32Array(count);
    const colours = new Float32Array(count);
    const colour = new Color();
    let at = 0;
    for (const one of lines) {
      colour.setHex(one.colour);
      positions.set(one.points, at);
      for (let i = 0; i < one.points.length; i += 3) colours.set([colour.r, colour.g, colour.b], at + i);
      at += one.points.length;
    }
    const geometry = new LineSegmentsGeometry();
    geometry.setPositions(positions);
    geometry.setColors(colours);
    const material = new LineMaterial({ vertexColors: true, linewidth: width, transparent: true, opacity: 0.9 });
    material.depthTest = material.depthWrite = false;
    const object = new LineSegments2(geometry, material);
    object.frustumCulled = false;
    object.renderOrder = 1;
    this.group.add(object);
    this.layers.set(name, { lines, object });
  }

  /** The thing whose line is nearest to a pixel, where it lies there, and how far off it is. */
  pick(camera: PerspectiveCamera, x: number, y: number, width: number, height: number) {
    const viewProjection = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse);
    let best: { lines: Lines; point: Vector3; px: number } | null = null;
    const a = new Vector4();
    const b = new Vector4();
    for (const { lines } of this.layers.values())
      for (const one of lines) {
        if (!one.thing) continue;
        const p = one.points;
        for (let i = 0; i + 5 < p.length; i += 6) {
          a.set(p[i] as number, p[i + 1] as number, p[i + 2] as number, 1).applyMatrix4(viewProjection);
          b.set(p[i + 3] as number, p[i + 4] as number, p[i + 5] as number, 1).applyMatrix4(viewProjection);
          let [from, to] = [0, 1]; // the part in front of the eye
          const least = 1e-6;
          if (a.w < least && b.w < least) continue;
          if (a.w < least) from = (least - a.w) / (b.w - a.w);
          if (b.w < least) to = (least - a.w) / (b.w - a.w);
          const screen = (t: number): [number, number] => {
            const w = a.w + t * (b.w - a.w);
            return [(((a.x + t * (b.x - a.x)) / w + 1) / 2) * width, ((1 - (a.y + t * (b.y - a.y)) / w) / 2) * height];
          };
          const [ax, ay] = screen(from);
          const [bx, by] = screen(to);
          const length2 = (bx - ax) ** 2 + (by - ay) ** 2;
          const s = length2 ? Math.min(1, Math.max(0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length2)) : 0;
          const px = Math.hypot(x - ax - s * (bx - ax), y - ay - s * (by - ay));
          if (px > PICK_PX || (best && px >= best.px)) continue;
          const t = from + s * (to - from);
          const at = (k: number) => (p[i + k] as number) + t * ((p[i + 3 + k] as number) - (p[i + k] as number));
          best = { lines: one, point: new Vector3(at(0), at(1), at(2)), px };
        }
      }
    return best;
  }

  dispose(): void {
    for (const name of [...this.layers.keys()]) this.set(name, []);
  }
}

const EDGES_OF_BOX = [0, 1, 2, 3, 4, 5, 6, 7, 0, 2, 1, 3, 4, 6, 5, 7, 0, 4, 1, 5, 2, 6, 3, 7];

export function boxLines([low, high]: Box, pose?: Matrix4): number[] {
  const corner = (i: number) => {
    const at = new Vector3((i & 1 ? high : low)[0], (i & 2 ? high : low)[1], (i & 4 ? high : low)[2]);
    return (pose ? at.applyMatrix4(pose) : at).toArray();
  };
  return EDGES_OF_BOX.flatMap(corner);
}

/** @param frustum apex and four corners */
export function frustumLines(frustum: Vector[], pose?: Matrix4): number[] {
  const points = frustum.map((at) => {
    const point = new Vector3(...at);
    return (pose ? point.applyMatrix4(pose) : point).toArray();
  });
  return [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1].flatMap((i) => points[i] ?? []);
}

export function crossLines(at: Vector, reach: number): number[] {
  return [0, 1, 2].flatMap((axis) => [-reach, reach].flatMap((d) => at.map((v, i) => (i === axis ? v + d : v))));
}

/** Three ellipses on the surface that holds 95 % of a normal distribution. */
export function ellipsoidLines(centre: Vector, covariance: Matrix3): number[] {
  // With covariance L L^T the surface is L u for unit u: no eigenvectors are needed.
  const c = (i: number, j: number) => covariance[i]?.[j] ?? 0;
  const tiny = 1e-12 * (c(0, 0) + c(1, 1) + c(2, 2)) + 1e-30;
  const root = (v: number) => Math.sqrt(Math.max(v, tiny));
  const l00 = root(c(0, 0));
  const l10 = c(1, 0) / l00;
  const l20 = c(2, 0) / l00;
  const l11 = root(c(1, 1) - l10 * l10);
  const l21 = (c(2, 1) - l20 * l10) / l11;
  const l22 = root(c(2, 2) - l20 * l20 - l21 * l21);
  const surface = (x: number, y: number, z: number) => [
    centre[0] + SIGMAS_95 * l00 * x,
    centre[1] + SIGMAS_95 * (l10 * x + l11 * y),
    centre[2] + SIGMAS_95 * (l20 * x + l21 * y + l22 * z),
  ];
  const out: number[] = [];
  const steps = 48;
  for (let ring = 0; ring < 3; ring++)
    for (let k = 0; k < steps; k++)
      for (const i of [k, k + 1]) {
        const [s, t] = [Math.sin((2 * Math.PI * i) / steps), Math.cos((2 * Math.PI * i) / steps)];
        out.push(...(ring === 0 ? surface(s, t, 0) : ring === 1 ? surface(s, 0, t) : surface(0, s, t)));
      }
  return out;
}
