// The keys of the page: one table, which the help shows and the page obeys.
import * as actions from "./actions";
import * as derive from "./derive";
import { page, TAB_NAMES, TABS } from "./state";

export interface Key {
  key: string;
  shown?: string;
  what: string;
  group: "Everywhere" | "Review" | "View";
  press: () => void;
}

const reviewed = () => {
  const { selection } = page.state;
  return selection?.kind === "edge" || selection?.kind === "change" ? selection : null;
};

/** The form of the chosen edge or change, so that a note which was typed goes with the key. */
function form(): { send(verdict: actions.Verdict): Promise<void>; focusNote(): void } | null {
  const part = reviewed()?.kind === "edge" ? "gs-edge" : "gs-change";
  const found = document
    .querySelector("gs-app")
    ?.shadowRoot?.querySelector(part)
    ?.shadowRoot?.querySelector("gs-verdict");
  return (found as unknown as ReturnType<typeof form>) ?? null;
}

function verdict(name: actions.Verdict): void {
  if (!reviewed()) actions.say("Choose an edge or a change first (j and k walk over them)");
  else if (!actions.mayAct(page.state)) actions.say("This page only shows the map");
  else void form()?.send(name);
}

function writeNote(): void {
  const thing = document.querySelector("gs-app")?.shadowRoot?.querySelector("gs-thing")?.shadowRoot;
  if (page.state.selection?.kind === "object") thing?.querySelector<HTMLElement>("#name")?.focus();
  else form()?.focusNote();
}

function views(): number {
  const edge = derive.selectedEdge(page.state);
  const known = edge && actions.edges.get(edge.detail);
  return known?.status === "ready" ? known.value.views.length : 0;
}

function findBox(): void {
  actions.fold(false);
  const panels = ["gs-look", "gs-review", "gs-things"].map((name) =>
    document.querySelector("gs-app")?.shadowRoot?.querySelector(name),
  );
  const roots = panels.flatMap((panel) => (panel?.shadowRoot ? [panel.shadowRoot] : []));
  const inner = roots.flatMap((root) => root.querySelector("gs-scene-list")?.shadowRoot ?? root);
  for (const root of inner) root.querySelector<HTMLElement>("#filter")?.focus();
}

function escape(): void {
  const { state } = page;
  if (state.drag) actions.endDrag();
  else if (state.ruler) actions.measure();
  else if (state.pick) page.set({ pick: null });
  else if (state.selection) actions.select(null);
}

const mayAct = (what: () => void) => () => {
  if (actions.mayAct(page.state)) what();
  else actions.say("This page only shows the map");
};

export const KEYS: readonly Key[] = [
  { key: "?", what: "This help", group: "Everywhere", press: () => actions.help() },
  ...TABS.map((name, i): Key => ({
    key: String(i + 1),
    what: TAB_NAMES[name],
    group: "Everywhere",
    press: () => actions.tab(name),
  })),
  { key: "/", what: "Find in the list", group: "Everywhere", press: findBox },
  {
    key: "j",
    what: "Next in the list: edge, change, object, scene, photo",
    group: "Everywhere",
    press: () => actions.step(1),
  },
  { key: "k", what: "Previous in the list", group: "Everywhere", press: () => actions.step(-1) },
  { key: "p", what: "Fold or open the panel", group: "Everywhere", press: () => actions.fold() },
  { key: "l", what: "Copy a link to this view", group: "Everywhere", press: () => void actions.copyLink() },
  { key: "Escape", shown: "Esc", what: "Close what is chosen", group: "Everywhere", press: escape },
  { key: "c", what: "Confirm", group: "Review", press: () => verdict("confirm") },
  { key: "r", what: "Reject", group: "Review", press: () => verdict("reject") },
  { key: "t", what: "Take the review back", group: "Review", press: () => verdict("withdraw") },
  { key: "n", what: "Write a note, or the name of an object", group: "Review", press: writeNote },
  { key: "u", what: "Undo the last action", group: "Review", press: mayAct(() => void actions.undo()) },
  { key: "o", what: "Optimize now", group: "Review", press: mayAct(() => void actions.optimize()) },
  { key: "b", what: "Blink, swipe, side by side, difference", group: "Review", press: actions.nextComparison },
  { key: ",", what: "Previous camera", group: "Review", press: () => actions.view(-1, views()) },
  { key: ".", what: "Next camera", group: "Review", press: () => actions.view(1, views()) },
  { key: "f", what: "Fit all in view", group: "View", press: actions.fit },
  { key: "i", what: "Walk in", group: "View", press: () => void actions.walkIn() },
  { key: "m", what: "Measure a length: two clicks", group: "View", press: () => actions.measure() },
  { key: "g", what: "Fly to what is chosen", group: "View", press: () => actions.flyToSelected() },
  { key: "h", what: "Doll’s house: no ceiling", group: "View", press: () => actions.ceiling() },
  { key: "x", what: "Clip box", group: "View", press: () => actions.clip() },
  { key: "v", what: "Split view", group: "View", press: () => actions.split() },
];

/** Whether what is focused takes letters itself. */
function isTyped(event: KeyboardEvent): boolean {
  const target = event.composedPath()[0];
  if (!(target instanceof HTMLElement)) return false;
  if (target.matches("textarea, select, [contenteditable]")) return true;
  return target instanceof HTMLInputElement && !["checkbox", "radio", "range", "button"].includes(target.type);
}

export function listen(): void {
  addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.ctrlKey || event.altKey || event.metaKey || event.isComposing) return;
    if (isTyped(event)) {
      if (event.key === "Escape") (event.composedPath()[0] as HTMLElement).blur();
      return;
    }
    if (page.state.help) {
      // The dialog has the keys to itself; its own closing comes only with the next picture.
      if (event.key === "Escape") {
        event.preventDefault();
        actions.help(false);
      }
      return;
    }
    const isInDialog = event.composedPath().some((one) => one instanceof HTMLDialogElement);
    if (event.key === "Escape" && isInDialog) return; // which it closes
    const found = KEYS.find((one) => one.key === event.key);
    if (!found || page.state.phase !== "ready") return;
    event.preventDefault();
    if (found.group === "View" && !actions.has3D(page.state))
      actions.say("This needs the 3D view, which needs WebGL 2");
    else found.press();
  });
}
