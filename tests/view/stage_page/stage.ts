// The 3D view alone, for tests: no panels, and what it tells is kept.
import { createStage } from "../../../gsmap/view/page/src/stage";

const told = { picks: [] as unknown[], moves: [] as unknown[], errors: [] as string[] };
const query = new URLSearchParams(location.search);
const stage = createStage({
  canvas: document.querySelector("canvas") as HTMLCanvasElement,
  onPick: (pick) => told.picks.push(pick),
  onMove: (standpoint) => told.moves.push(standpoint),
  onError: (message) => told.errors.push(message),
  budget: JSON.parse(query.get("budget") ?? "{}"),
});
Object.assign(globalThis, { gsmap: { stage, state: stage.state, ...told } });
