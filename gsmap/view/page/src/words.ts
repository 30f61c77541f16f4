// Numbers, dates and lengths as the page writes them.
import type { Box, ChangeEntry, MapSummary, Matrix, ObjectEntry, PhotoEntry, Vector } from "./contract";
import type { Standpoint } from "./stage/stage";

const count = new Intl.NumberFormat("en");
const short = new Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 });

export const number = (value: number) => count.format(value);
export const compact = (value: number) => short.format(value);
export const plural = (value: number, one: string, many = `${one}s`) => `${number(value)} ${value === 1 ? one : many}`;

/** Never "100 %" of what is less, nor "0 %" of what is more. */
export function percent(share: number): string {
  if (share > 0.99 && share < 1) return "> 99 %";
  return share > 0 && share < 0.01 ? "< 1 %" : `${Math.round(100 * share)} %`;
}

export function metres(value: number): string {
  if (!Number.isFinite(value)) return "unknown";
  if (Math.abs(value) < 0.0995) return `${(100 * value).toPrecision(2)} cm`;
  return Math.abs(value) < 9.95 ? `${value.toFixed(2)} m` : `${number(Number(value.toPrecision(4)))} m`;
}

const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

/** One argument of a POSIX shell's command, so that a name from a map is never more than that. */
export const quote = (text: string) =>
  /^[\w@%+=:,./][\w@%+=:,./-]*$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;

/** "3 Mar 2026" of an ISO date; what is no date stays as it is. */
export function day(at: string | null): string {
  if (!at) return "no date";
  const found = /^(\d{4})-(\d\d)-(\d\d)/.exec(at);
  const month = found && MONTHS[Number(found[2]) - 1];
  return found && month ? `${Number(found[3])} ${month} ${found[1]}` : at;
}

/** The same with hours and minutes, where it has them. */
export function moment(at: string | null): string {
  const time = at && /T(\d\d:\d\d)/.exec(at);
  return time ? `${day(at)}, ${time[1]}` : day(at);
}

export const point = (at: Vector, metresPerUnit: number) =>
  at.map((v) => (v * metresPerUnit).toFixed(2)).join(", ") + " m";

/** How far a scene was moved: metres of its middle (scene frame), degrees of its turn. */
export function moved(from: Matrix, now: Matrix, middle: Vector, metresPerUnit: number) {
  const column = (m: Matrix, c: number) => [0, 1, 2].map((r) => m[r]?.[c] ?? 0);
  const at = (m: Matrix) =>
    [0, 1, 2].map((r) => middle.reduce((sum, v, c) => sum + (m[r]?.[c] ?? 0) * v, m[r]?.[3] ?? 0));
  const [a, b] = [at(from), at(now)];
  let trace = 0;
  for (const c of [0, 1, 2]) {
    const [x, y] = [column(from, c), column(now, c)];
    trace += x.reduce((sum, v, i) => sum + v * (y[i] ?? 0), 0) / (Math.hypot(...x) * Math.hypot(...y) || 1);
  }
  const cosine = Math.max(-1, Math.min(1, (trace - 1) / 2));
  return {
    metres: Math.hypot(...a.map((v, i) => v - (b[i] ?? 0))) * metresPerUnit,
    degrees: (Math.acos(cosine) * 180) / Math.PI,
  };
}

/** What is said of a change, in its row and in its panel. */
export const CHANGE_WORDS: Record<ChangeEntry["kind"], string> = {
  appeared: "Appeared",
  disappeared: "Disappeared",
  moved: "Moved",
  recoloured: "Another colour",
  replaced: "Replaced by another",
  lighting: "Lit differently",
};

/** The older and the newer capture: "hall (3 Mar 2026) → hall again (2 Apr 2026)". */
export const pairText = (map: MapSummary, older: number, newer: number) =>
  [older, newer]
    .map((index) => map.scenes[index])
    .map((scene) => `${scene?.name ?? "?"} (${day(scene?.captured_at ?? null)})`)
    .join(" → ");

/** What an object is called: by people, else by its number. */
export const titleOf = (one: ObjectEntry) => one.name || (one.label ? `${one.label} (${one.id})` : one.id);

/** Two sides and the height of an object, in metres. */
export function sizeOf(one: ObjectEntry, metresPerUnit: number): string {
  const sides = one.box[1].map((v, i) => Math.max(0, v - (one.box[0][i] ?? v)) * metresPerUnit);
  return `${sides.map((side) => side.toFixed(side < 0.995 ? 2 : 1)).join(" × ")} m`;
}

export const middleOf = (box: Box) => box[0].map((v, i) => (v + (box[1][i] ?? v)) / 2) as Vector;

/** Where a photograph was taken from, looking along its axis. */
export function standpointOf(photo: PhotoEntry, metresPerUnit: number): Standpoint {
  const T = photo.T_map_camera;
  const position = [0, 1, 2].map((r) => T[r]?.[3] ?? 0) as Vector;
  const target = [0, 1, 2].map((r) => (position[r] ?? 0) + (T[r]?.[2] ?? 0) * (2 / metresPerUnit)) as Vector;
  return { position, target };
}
