// The page's beginning: the map, the view that the address asks for, the 3D view, the keys.
import * as actions from "./actions";
import * as address from "./address";
import { drive } from "./driver";
import { listen } from "./keys";
import "./panels/app";
import { page } from "./state";
import type { State, Theme } from "./state";
import { createStage } from "./view3d";

const REST_MS = 250; // a slider that moves writes the address once

function restore(hash: string): void {
  const { map } = page.state;
  if (!map) return;
  const shared = address.read(hash, map);
  page.set({ ...shared, side: "left", drag: null, pick: null, ruler: null });
  const { standpoint } = shared;
  actions.aim(() => (standpoint ? page.stage?.stand(standpoint) : page.stage?.fit(undefined, false)));
}

/** Keeps the address at what is shown. What was chosen makes an entry to go back to; moving about does not. */
function follow(): void {
  const landmark = ({ component, tab, selection, revision, split }: State) =>
    JSON.stringify([component, tab, selection, revision, split !== null]);
  let last = landmark(page.state);
  let timer = 0;
  page.listen(() => {
    const { state } = page;
    if (!state.map) return;
    const hash = `#${address.write(state, state.map)}`;
    if (hash === location.hash) return;
    clearTimeout(timer);
    const now = landmark(state);
    if (now !== last) {
      last = now;
      history.pushState(null, "", hash);
    } else timer = window.setTimeout(() => history.replaceState(null, "", hash), REST_MS);
  });
  addEventListener("popstate", () => {
    clearTimeout(timer);
    restore(location.hash);
    last = landmark(page.state);
  });
}

function colours(): void {
  try {
    const kept = localStorage.getItem("gsmap.theme");
    if (kept === "light" || kept === "dark") page.set({ theme: kept satisfies Theme });
  } catch {
    // a browser that keeps nothing follows the system
  }
  const show = () => (document.documentElement.dataset["theme"] = page.state.theme);
  show();
  page.listen(show);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => page.tell());
}

async function stage(): Promise<void> {
  const canvas = document.getElementById("canvas") as HTMLCanvasElement;
  try {
    page.stage = await createStage({
      canvas,
      onPick: actions.picked,
      onMove: (standpoint) => page.set({ standpoint }),
      onError: (message) => actions.say(`3D view: ${message}`, true),
    });
    Object.assign(window, { gsmap: page.stage.state });
    drive(page.stage);
  } catch (error) {
    page.set({ stageError: error instanceof Error ? error.message : String(error) });
  }
}

async function main(): Promise<void> {
  colours();
  listen();
  const first = page.listen(() => {
    if (page.state.phase !== "ready") return;
    first();
    restore(location.hash);
    follow();
    void stage();
  });
  await actions.load();
  await actions.watch();
}

void main();
