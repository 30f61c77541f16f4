// A 3D view that draws nothing but remembers what it was told: the panels are tested by it in milliseconds.
import type { Pick, Stage, StageOptions, StageState, Standpoint } from "../../../gsmap/view/page/src/stage/stage";

export interface Fake {
  calls: [string, ...unknown[]][];
  state: StageState;
  pick(pick: Pick): void;
  move(standpoint: Standpoint): void;
  dragTo(matrix: number[][]): void;
  clipTo(box: unknown): void;
}

const plain = (value: unknown): unknown => {
  if (value instanceof Set) return [...(value as Set<unknown>)];
  return typeof value === "function" ? "function" : value;
};

export async function createStage(options: StageOptions): Promise<Stage> {
  const calls: Fake["calls"] = [];
  let standpoint: Standpoint = { position: [5, 5, 5], target: [0, 0, 0] };
  let onDrag: ((matrix: number[][]) => void) | undefined;
  let onClip: ((box: never) => void) | undefined;
  const note =
    (name: string) =>
    (...values: unknown[]) => {
      calls.push([name, ...values.map(plain)]);
    };
  if (location.search === "?no-webgl") throw new Error("no WebGL");
  const state: StageState = {
    phase: "ready",
    frames: 0,
    splats: 0,
    bytesReceived: 0,
    bytesUploaded: 0,
    pending: 0,
    settled: true,
    error: null,
    isShown: true,
    hasStood: true,
    isAbove: true,
  };
  const fake: Fake = {
    calls,
    state,
    pick: options.onPick,
    move: (at) => {
      standpoint = at;
      options.onMove(at);
    },
    dragTo: (matrix) => onDrag?.(matrix),
    clipTo: (box) => onClip?.(box as never),
  };
  Object.assign(window, { fake });
  const { canvas } = options;
  canvas.getContext("2d")?.fillText("3D", 10, 20);
  return {
    state,
    show: (map, component) => calls.push(["show", map.scenes.length, component]),
    setVisible: note("setVisible"),
    setSource: note("setSource"),
    setSplit: (split) => calls.push(["setSplit", split && { ...split, scenes: [...split.scenes] }]),
    setClip: (box, onChange) => {
      onClip = onChange as typeof onClip;
      calls.push(["setClip", box]);
    },
    setCeiling: note("setCeiling"),
    setOverlay: note("setOverlay"),
    setGraph: note("setGraph"),
    setHighlighted: note("setHighlighted"),
    setMeasure: note("setMeasure"),
    setRuler: note("setRuler"),
    setChanges: (changes) => calls.push(["setChanges", changes.map((one) => one.id)]),
    setCorrespondences: (detail) => calls.push(["setCorrespondences", detail?.correspondences.length ?? null]),
    setPoses: (revision) => calls.push(["setPoses", revision?.number ?? null]),
    drag: (scene, how) => {
      onDrag = how;
      calls.push(["drag", scene]);
    },
    stand: (at, fly) => {
      calls.push(["stand", at, fly]);
      fake.move(at);
    },
    fit: note("fit"),
    walkIn: (scene) => {
      calls.push(["walkIn", scene ?? null]);
      return Promise.resolve(true);
    },
    project: ([x, y]) => [100 + 40 * x, 100 + 40 * y],
    standpoint: () => standpoint,
    setTheme: note("setTheme"),
    standAtCamera: note("standAtCamera"),
    dispose: () => undefined,
  };
}
