// The page: loads the map, moves the camera, lists scenes and edges.
import { Renderer } from "./scene.js";

const $ = (id) => document.getElementById(id);
const GREEN = [0.35, 0.85, 0.45, 0.9];
const AMBER = [0.98, 0.75, 0.2, 0.9];
const RED = [0.95, 0.35, 0.3, 0.8];
const GREY = [0.6, 0.6, 0.65, 0.5];
const palette = Array.from({ length: 64 }, (_, i) => hue((i * 0.618034) % 1));
const given = new URLSearchParams(location.hash.slice(1));
const plain = given.get("plain") === "1";
// For tests and for the curious: what the page is doing.
const state = (window.gsmap = { phase: "loading", frames: 0, loaded: 0, sorted: 0, error: null });

let map = null;
let renderer = null;
let sorter = null;
let shownComponent = 0;
let busySorting = false;
let sortAgain = false;
let dirty = true;
const extras = new Map(); // scene index -> nodes and cameras
const hidden = new Set(); // scene indices
const layersShown = new Set();
const camera = { target: [0, 0, 0], distance: 5, yaw: 0.6, pitch: 0.35, fov: 1.0, basis: null };

function hue(h) {
  const f = (n) => {
    const k = (n + h * 12) % 12;
    return 0.62 - 0.33 * Math.max(-1, Math.min(k - 3, 9 - k, 1));
  };
  return [f(0), f(8), f(4)];
}
const css = (c) => `rgb(${c.slice(0, 3).map((v) => Math.round(255 * v)).join(" ")})`;
const add = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / (Math.hypot(...a) || 1));
const mean = (points) => points.reduce((a, b) => add(a, b)).map((v) => v / points.length);

// ---- camera -----------------------------------------------------------------------------------------------------

function setUp(up) {
  const u = unit(up);
  const aside = unit(cross(Math.abs(u[2]) < 0.9 ? [0, 0, 1] : [0, 1, 0], u));
  camera.basis = [aside, cross(u, aside), u]; // east, north, up
}

// Right, down and forward in the map frame, and the eye.
function axes() {
  const [e, n, u] = camera.basis;
  const level = add(e.map((v) => v * Math.sin(camera.yaw)), n, Math.cos(camera.yaw));
  const forward = add(level.map((v) => v * Math.cos(camera.pitch)), u, -Math.sin(camera.pitch));
  const right = unit(cross(forward, u));
  return { right, down: cross(forward, right), forward, eye: add(camera.target, forward, -camera.distance) };
}

function pose() {
  const { right, down, forward, eye } = axes();
  const { width, height } = renderer.gl.canvas;
  const f = (0.5 * Math.max(width, height)) / Math.tan(camera.fov / 2);
  const rows = [right, down, forward];
  const view = new Float32Array(16);
  rows.forEach((row, r) => {
    for (let c = 0; c < 3; c++) view[4 * c + r] = row[c];
    view[12 + r] = -dot(row, eye);
  });
  view[15] = 1;
  return { view, focal: [f, f], near: Math.max(camera.distance * 0.002, 1e-4), forward };
}

function lookFrom(eye, target) {
  const forward = unit(add(target, eye, -1));
  const [e, n, u] = camera.basis;
  camera.target = target;
  camera.distance = Math.hypot(...add(target, eye, -1));
  camera.pitch = -Math.asin(Math.max(-1, Math.min(1, dot(forward, u))));
  camera.yaw = Math.atan2(dot(forward, e), dot(forward, n));
}

function fit(indices) {
  const corners = indices.flatMap((i) => map.scenes[i].corners);
  if (!corners.length) return;
  const low = [0, 1, 2].map((a) => Math.min(...corners.map((c) => c[a])));
  const high = [0, 1, 2].map((a) => Math.max(...corners.map((c) => c[a])));
  camera.target = add(low, high).map((v) => v / 2);
  camera.distance = (0.6 * Math.hypot(...add(high, low, -1))) / Math.tan(camera.fov / 2) || 1;
  look();
}

function look() {
  dirty = true;
  sort();
}

function listen(canvas) {
  let last = null;
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    last = [e.clientX, e.clientY, e.button === 2 || e.shiftKey];
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!last) return;
    const [dx, dy] = [e.clientX - last[0], e.clientY - last[1]];
    if (last[2]) {
      const { right, down } = axes();
      const step = (camera.distance * 2 * Math.tan(camera.fov / 2)) / Math.max(canvas.clientWidth, canvas.clientHeight);
      camera.target = add(add(camera.target, right, -dx * step), down, -dy * step);
    } else {
      camera.yaw += dx * 0.006;
      camera.pitch = Math.max(-1.55, Math.min(1.55, camera.pitch + dy * 0.006));
    }
    last = [e.clientX, e.clientY, last[2]];
    look();
  });
  canvas.addEventListener("pointerup", () => (last = null));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener(
    "wheel",
    (e) => {
      e.preventDefault();
      camera.distance *= Math.exp(Math.max(-1, Math.min(1, e.deltaY * 0.0015)));
      look();
    },
    { passive: false }
  );
  addEventListener("keydown", (e) => {
    if (e.target.tagName === "INPUT" || e.target.tagName === "SELECT") return;
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (turn) {
      camera.yaw += turn[0];
      camera.pitch = Math.max(-1.55, Math.min(1.55, camera.pitch + turn[1]));
      look();
    } else if (e.key === "f" || e.key === "F") fit(shownScenes());
  });
  addEventListener("resize", resize);
}

function resize() {
  const canvas = renderer.gl.canvas;
  const ratio = plain ? 1 : Math.min(devicePixelRatio, 2);
  canvas.width = Math.round(innerWidth * ratio);
  canvas.height = Math.round(innerHeight * ratio);
  dirty = true;
}

// ---- what is drawn ----------------------------------------------------------------------------------------------

const inComponent = (i) => map.scenes[i].component === shownComponent;
const shownScenes = () => map.scenes.map((_, i) => i).filter((i) => inComponent(i) && !hidden.has(i));

function sort() {
  if (busySorting) {
    sortAgain = true;
    return;
  }
  busySorting = true;
  const visible = new Uint8Array(65536);
  for (const i of shownScenes()) visible[i] = 1;
  sorter.postMessage({ forward: axes().forward, visible });
}

function sorted({ data }) {
  renderer.setOrder(data);
  state.sorted++;
  busySorting = false;
  dirty = true;
  if (sortAgain) {
    sortAgain = false;
    sort();
  }
}

function edgeColour(edge) {
  if (edge.status !== "accepted") return edge.status === "rejected" ? RED : GREY;
  if (edge.used === "tentative") return AMBER;
  return edge.used === false ? RED : GREEN;
}
const failed = (edge) => edge.status !== "accepted" || edge.used === false;

function overlays() {
  if (plain) return [];
  const lines = [];
  const points = [];
  const segment = (a, b, colour) => lines.push(...a, ...colour, ...b, ...colour);
  const shown = shownScenes();
  if ($("show-edges").checked)
    for (const edge of map.edges)
      if ([edge.target, edge.source].every((i) => shown.includes(i)) && (!failed(edge) || $("show-failed").checked))
        segment(mean(map.scenes[edge.target].corners), mean(map.scenes[edge.source].corners), edgeColour(edge));
  for (const i of shown) {
    const colour = [...palette[i % 64], 0.9];
    const box = map.scenes[i].corners;
    if ($("show-boxes").checked) {
      const S = map.scenes[i].S_map_scene; // its frame: x red, y green, z blue, a twentieth of its box long
      const long = Math.hypot(...add(box[7], box[0], -1)) / 20;
      const origin = S.slice(0, 3).map((line) => line[3]);
      for (let a = 0; a < 3; a++) {
        const axis = unit(S.slice(0, 3).map((line) => line[a]));
        segment(origin, add(origin, axis, long), [0, 1, 2].map((c) => (c === a ? 1 : 0.25)).concat(1));
      }
      for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) segment(box[a], box[a | bit], colour);
    }
    const more = extras.get(i);
    if (!more) continue;
    if ($("show-cameras").checked)
      for (const [eye, ...rim] of more.cameras)
        rim.forEach((corner, k) => {
          segment(eye, corner, colour);
          segment(corner, rim[(k + 1) % 4], colour);
        });
    for (const name of layersShown) for (const node of more.layers[name] || []) points.push(...node, ...colour);
  }
  return [
    { mode: "LINES", width: 1, vertices: new Float32Array(lines) },
    { mode: "POINTS", width: 5, vertices: new Float32Array(points) },
  ];
}

function drawLabels(view) {
  const box = $("labels");
  const shown = shownScenes();
  while (box.children.length < shown.length) box.append(document.createElement("span"));
  while (box.children.length > shown.length) box.lastChild.remove();
  const ratio = innerWidth / renderer.gl.canvas.width;
  shown.forEach((i, k) => {
    const p = mean(map.scenes[i].corners);
    const q = [0, 1, 2].map((r) => view.view[r] * p[0] + view.view[4 + r] * p[1] + view.view[8 + r] * p[2] + view.view[12 + r]);
    const label = box.children[k];
    label.textContent = map.scenes[i].name;
    label.style.display = q[2] > view.near ? "" : "none";
    label.style.left = `${innerWidth / 2 + (ratio * view.focal[0] * q[0]) / q[2]}px`;
    label.style.top = `${innerHeight / 2 + (ratio * view.focal[1] * q[1]) / q[2]}px`;
  });
}

function frame() {
  requestAnimationFrame(frame);
  if (!dirty) return;
  dirty = false;
  const view = pose();
  renderer.draw(view, {
    splats: $("show-splats").checked,
    byScene: $("by-scene").checked,
    background: plain ? [0, 0, 0] : [0.078, 0.086, 0.102],
    overlays: overlays(),
  });
  if (!plain) drawLabels(view);
  state.frames++;
}

// ---- lists ------------------------------------------------------------------------------------------------------

function row(text, detail, colour, click) {
  const item = document.createElement("li");
  const swatch = document.createElement("span");
  swatch.className = "swatch";
  swatch.style.background = css(colour);
  const button = document.createElement("button");
  button.textContent = text;
  button.addEventListener("click", click);
  const more = document.createElement("span");
  more.className = "detail";
  more.textContent = detail;
  item.append(swatch, button, more);
  return item;
}

function lists() {
  $("scenes").replaceChildren(
    ...map.scenes.map((scene, i) => {
      const item = row(scene.name, `${scene.num_gaussians.toLocaleString()} ${scene.status}`, palette[i % 64], () => {
        if (!inComponent(i)) choose(scene.component);
        fit([i]);
      });
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = !hidden.has(i);
      box.setAttribute("aria-label", `show ${scene.name}`);
      box.addEventListener("change", () => {
        box.checked ? hidden.delete(i) : hidden.add(i);
        look();
      });
      item.prepend(box);
      item.hidden = !inComponent(i);
      return item;
    })
  );
  $("edges").replaceChildren(
    ...map.edges.map((edge) => {
      const names = `${map.scenes[edge.target].name} : ${map.scenes[edge.source].name}`;
      const how = edge.status === "accepted" && edge.used === "tentative" ? "tentative" : edge.status;
      const item = row(names, `${edge.num_inliers} ${how}`, edgeColour(edge), () => fit([edge.target, edge.source]));
      item.title = edge.reason || `overlap ${edge.overlap.toFixed(2)}`;
      item.hidden = !(inComponent(edge.target) || inComponent(edge.source));
      return item;
    })
  );
}

function choose(component) {
  shownComponent = component;
  $("component").value = String(component);
  lists();
  fit(shownScenes());
}

function say(text, isFailure = false) {
  $("status").textContent = text;
  $("status").classList.toggle("failed", isFailure);
}

// ---- loading ----------------------------------------------------------------------------------------------------

async function fetched(path) {
  const answer = await fetch(path);
  if (!answer.ok) {
    const said = await answer.json().catch(() => ({}));
    throw new Error(said.error || `${path}: ${answer.status}`);
  }
  return answer;
}

async function loadScene(i) {
  const bytes = await (await fetched(`scenes/${i}/splats`)).arrayBuffer();
  state.loaded += renderer.add(i, bytes);
  sorter.postMessage({ positions: renderer.positions.slice(0), scenes: renderer.scenes.slice(0) });
  look();
  extras.set(i, await (await fetched(`scenes/${i}/extras`)).json());
  for (const name of Object.keys(extras.get(i).layers)) addLayer(name);
  dirty = true;
}

function addLayer(name) {
  if (document.getElementById(`layer-${name}`)) return;
  const label = document.createElement("label");
  const box = document.createElement("input");
  box.type = "checkbox";
  box.id = `layer-${name}`;
  box.addEventListener("change", () => {
    box.checked ? layersShown.add(name) : layersShown.delete(name);
    dirty = true;
  });
  label.append(box, ` ${name}`);
  $("show-layers").append(label);
}

async function main() {
  map = await (await fetched("map.json")).json();
  document.title = `${map.title} · gsmap`;
  $("title").textContent = map.title;
  document.body.classList.toggle("plain", plain);
  renderer = new Renderer($("canvas"), palette);
  sorter = new Worker("sort.js");
  sorter.onmessage = sorted;
  setUp(map.up);
  resize();
  listen($("canvas"));
  for (const id of ["show-splats", "show-edges", "show-failed", "show-boxes", "show-cameras", "by-scene"])
    $(id).addEventListener("change", () => (dirty = true));
  const components = [...new Set(map.scenes.map((s) => s.component))].sort((a, b) => a - b);
  $("component-row").hidden = components.length < 2;
  for (const component of components) {
    const count = map.scenes.filter((s) => s.component === component).length;
    $("component").append(new Option(`${component} (${count} scene${count > 1 ? "s" : ""})`, String(component)));
  }
  $("component").addEventListener("change", () => choose(Number($("component").value)));
  if (!map.scenes.length) {
    say("the map has no scenes yet: gsmap ingest");
    state.phase = "ready";
    return;
  }
  choose(components[0]);
  const numbers = (name) => given.get(name).split(",").map(Number);
  if (given.has("fov")) camera.fov = numbers("fov")[0];
  if (given.has("eye")) lookFrom(numbers("eye"), numbers("target"));
  frame();
  const first = map.scenes.map((_, i) => i).sort((a, b) => inComponent(b) - inComponent(a) || a - b);
  for (const i of first) {
    say(`loading ${map.scenes[i].name}`);
    await loadScene(i);
  }
  say(`${map.scenes.length} scenes, ${state.loaded.toLocaleString()} splats`);
  state.phase = "ready";
}

main().catch((error) => {
  state.phase = "failed";
  state.error = String(error.message || error);
  say(state.error, true);
});
