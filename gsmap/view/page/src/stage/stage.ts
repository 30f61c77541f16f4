// What the panels ask of the 3D view. The stage knows nothing of panels.
import type { Box, ChangeEntry, EdgeDetail, GraphEntry, MapSummary, Matrix, RevisionPoses, Vector } from "../contract";

export type Source = "scenes" | "merged";
export type Overlay = "cameras" | "nodes" | "boxes" | "edges" | "ellipsoids" | "objects" | "rooms" | "photos";

/** Where the viewer stands: part of the page's address. */
export interface Standpoint {
  position: Vector;
  target: Vector;
}

/** What is picked: the nearest surface under the pointer. */
export interface Pick {
  point: Vector; // map frame
  pixel: number; // width of a pixel there, map units
  scene: number | null;
  thing: { kind: "edge" | "change" | "object" | "photo" | "camera"; index: number } | null;
}

export interface StageOptions {
  canvas: HTMLCanvasElement; // its size is the layout's and changes as panels open and fold (ResizeObserver)
  onPick: (pick: Pick) => void;
  onMove: (standpoint: Standpoint) => void; // after the viewer has come to rest
  onError: (message: string) => void;
  /** What it may cost; see loader.ts. Left out: two million splats, 600 MB. */
  budget?: { splats?: number; bytes?: number; errorPx?: number; requests?: number };
}

/** Numbers that tests and the curious look at; `window.gsmap` is one. */
export interface StageState {
  phase: "loading" | "ready" | "failed";
  frames: number;
  splats: number; // drawn
  bytesReceived: number; // of splats
  bytesUploaded: number;
  pending: number; // tiles on their way
  settled: boolean; // nothing more to load, sort or draw for this standpoint
  error: string | null;
  isShown: boolean; // some splats have been drawn
  hasStood: boolean; // the viewer was put, or went, where they are
  isAbove: boolean; // the viewer is higher than all that is drawn: ceilings are left out
}

/** The canvas gets an event "drawn" after every picture. */
export interface Stage {
  readonly state: StageState;
  /** Shows a map; again after an action, keeping what is loaded. */
  show(map: MapSummary, component: number): void;
  setVisible(scenes: ReadonlySet<number>): void;
  setSource(source: Source): void;
  /** Right of `at` (0..1 of the width) other scenes, or merged instead of scenes; null ends it. */
  setSplit(split: { at: number; scenes: ReadonlySet<number>; source: Source } | null): void;
  /** What lies outside is not drawn; drawn with handles, and `onChange` is told as they are dragged. */
  setClip(box: Box | null, onChange?: (box: Box) => void): void;
  /** Whether ceilings are drawn; from above they never are (doll's house). */
  setCeiling(shown: boolean): void;
  setOverlay(name: Overlay, shown: boolean): void;
  setGraph(graph: GraphEntry): void; // of the objects
  /** Objects whose boxes and relations are drawn, whatever else is, and changes whose boxes stand out; by their ids. */
  setHighlighted(things: ReadonlySet<string>): void;
  /** A length that is measured, or a place that was picked. */
  setMeasure(points: readonly Vector[]): void;
  /** While a length is measured, lines are not picked: its ends are on surfaces. */
  setRuler(taken: boolean): void;
  setChanges(changes: ChangeEntry[]): void; // boxes coloured by kind
  setCorrespondences(detail: EdgeDetail | null): void;
  /** Poses of an old revision in place of the newest ones; null goes back. */
  setPoses(revision: RevisionPoses | null): void;
  /** Lets a person drag a scene; `onDrag` gives S_map_scene as it is dragged; null ends it. */
  drag(scene: number | null, onDrag?: (S_map_scene: Matrix) => void): void;
  stand(at: Standpoint, fly?: boolean): void;
  fit(box?: Box, fly?: boolean): void; // all that is visible, or one box
  /** Stands where a capture was made: of this scene, or of the largest one. Gives whether any has cameras. */
  walkIn(scene?: number): Promise<boolean>;
  /** Where a point of the map is on the canvas, in its pixels; null behind the viewer. */
  project(point: Vector): [number, number] | null;
  standpoint(): Standpoint;
  setTheme(dark: boolean): void;
  /** Renders once with the camera of a capture: for tests of fidelity. */
  standAtCamera(T_map_camera: Matrix, intrinsics: [number, number, number, number], size: [number, number]): void;
  dispose(): void;
}
