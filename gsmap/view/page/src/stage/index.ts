// The 3D view. Everything is drawn on demand: nothing runs while nothing changes.
import { Box3, Color, Group, Matrix4, Raycaster, Scene, Timer, Vector2, Vector3, Vector4, WebGLRenderer } from "three";
import { TransformControls } from "three/addons/controls/TransformControls.js";
import { Object3D } from "three";
import type {
  Box,
  Component,
  EdgeDetail,
  GraphEntry,
  MapSummary,
  Matrix,
  PhotoEntry,
  RevisionPoses,
  SceneEntry,
  SceneExtras,
  Vector,
} from "../contract";
import type { ChangeEntry } from "../contract";
import { ClipBox } from "./clip";
import { BUDGET, Loader } from "./loader";
import type { Budget, TreePlacement, Sixteen } from "./loader";
import { boxLines, CHANGE_COLOURS, COLOURS, crossLines, ellipsoidLines, frustumLines, Overlays } from "./overlays";
import type { Lines } from "./overlays";
import { SplatRenderer } from "./splats";
import type { Overlay, Pick, Source, Stage, StageOptions, StageState, Standpoint } from "./stage";
import { View } from "./view";

export type { Pick, Source, Stage, StageOptions, StageState, Standpoint } from "./stage";

const BACKGROUND = { dark: 0x0d1014, light: 0xf4f4f1 };
const MAX_PIXEL_RATIO = 2;
const CLICK_PX = 4;
/** Between pictures while tiles come. */
const SHORTEST_MS = 50;
const LONGEST_MS = 2000;
/** How far up a room reaches that is drawn without its ceiling: of what its scene shows, from the floor. */
const CEILING_AT = 0.72;

interface Split {
  at: number;
  scenes: ReadonlySet<number>;
  source: Source;
}

/** Makes the 3D view on a canvas. @throws Error where the browser has no WebGL 2 */
export function createStage(options: StageOptions): Stage {
  return new View3D(options);
}

class View3D implements Stage {
  readonly state: StageState = {
    phase: "loading",
    frames: 0,
    splats: 0,
    bytesReceived: 0,
    bytesUploaded: 0,
    pending: 0,
    settled: false,
    error: null,
    isShown: false,
    hasStood: false,
    isAbove: false,
  };
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly splats = new Group();
  private readonly overlays = new Overlays();
  private readonly splatRenderer: SplatRenderer;
  private readonly view: View;
  private readonly clip: ClipBox;
  private readonly timer = new Timer();
  private readonly observer: ResizeObserver;
  private readonly budget: Budget;
  private loader: Loader | null = null;
  private map: MapSummary | null = null;
  private component = 0;
  private written: Matrix4[] = [];
  private revision: RevisionPoses | null = null;
  private dragged: { scene: number; pose: Matrix4 } | null = null;
  private visible: ReadonlySet<number> = new Set();
  private isVisibleKnown = false;
  private source: Source = "scenes";
  private split: Split | null = null;
  private isCeilingShown = true;
  private gizmos: { handle: Object3D; controls: TransformControls[] } | null = null;
  private readonly shownOverlays = new Set<Overlay>();
  private graph: GraphEntry = { objects: [], relations: [], rooms: [], changes: {} };
  private highlighted: ReadonlySet<string> = new Set();
  private measured: readonly Vector[] = [];
  private isRulerTaken = false;
  private changes: ChangeEntry[] = [];
  private detail: EdgeDetail | null = null;
  private readonly extras = new Map<string, Promise<SceneExtras | null>>(); // by address, asked for once
  private readonly extrasOf = new Map<string, SceneExtras>(); // those that are there
  private top = Infinity; // height above which the viewer sees ceilings
  private scheduled = 0;
  private isStale = true; // the order and the colours are another view's
  private isPreparing = false;
  private later = 0; // timer of the next picture while tiles come
  private costMs = 0; // of the last picture, its sorting included
  private isMoving = false;
  private isDisposed = false;

  constructor(private readonly options: StageOptions) {
    const { canvas } = options;
    this.budget = { ...BUDGET, ...options.budget };
    this.renderer = new WebGLRenderer({ canvas, antialias: false, alpha: false, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
    this.splatRenderer = new SplatRenderer(this.renderer);
    this.view = new View(canvas, this.draw);
    this.clip = new ClipBox(canvas, this.view.camera, () => {
      this.cut();
      this.draw();
    });
    this.scene.add(this.splatRenderer.spark, this.splats, this.overlays.group, this.clip.group);
    this.setTheme(true);
    canvas.addEventListener("webglcontextlost", this.onLost);
    canvas.addEventListener("pointerdown", this.onDown);
    canvas.addEventListener("pointerup", this.onUp);
    canvas.addEventListener("dblclick", this.onDouble);
    for (const name of ["wheel", "keydown"] as const) canvas.addEventListener(name, this.onOwnWay, { passive: true });
    this.observer = new ResizeObserver(this.resize);
    this.observer.observe(canvas);
    this.resize();
  }

  // ---- what is shown ----------------------------------------------------------------------------------------------

  show(map: MapSummary, component: number): void {
    const shown = map.components.find((one) => one.component === component);
    if (!shown) return;
    const isOther = !this.map || this.component !== component;
    const before = this.loader;
    this.map = map;
    this.component = component;
    this.written = map.scenes.map((scene) => new Matrix4().set(...(scene.S_map_scene.flat() as Sixteen)));
    if (isOther) {
      this.isVisibleKnown = false;
      this.state.hasStood = false;
    }
    if (!this.isVisibleKnown) this.visible = new Set(map.scenes.keys());
    this.dragged = null;
    this.loader = new Loader(map, component, this.splats, this.budget, this.refreshLater, this.fail, before);
    const box = new Box3(new Vector3(...shown.box[0]), new Vector3(...shown.box[1]));
    this.view.setWorld(shown.up, box.getSize(new Vector3()).length(), 1 / (shown.metres_per_unit || 1));
    this.state.phase = "ready";
    this.place();
    this.drawOverlays();
    this.cut();
    // Once, when all bounds are known; at first by what is known, under the floor plan.
    if (!this.state.hasStood && (isOther || !shown.overview?.pending)) this.fit(undefined, false);
    this.state.hasStood ||= !shown.overview?.pending;
    this.refresh();
  }

  setVisible(scenes: ReadonlySet<number>): void {
    this.visible = scenes;
    this.isVisibleKnown = true;
    this.place();
    this.drawOverlays();
    this.cut();
  }

  setSource(source: Source): void {
    this.source = source;
    this.place();
  }

  setSplit(split: Split | null): void {
    this.split = split;
    this.place();
  }

  setClip(box: Box | null, onChange?: (box: Box) => void): void {
    this.clip.set(box, onChange);
    this.cut();
    this.draw();
  }

  setCeiling(shown: boolean): void {
    this.isCeilingShown = shown;
    this.cut();
    this.draw();
  }

  setOverlay(name: Overlay, shown: boolean): void {
    if (shown) this.shownOverlays.add(name);
    else this.shownOverlays.delete(name);
    this.drawOverlays();
  }

  setGraph(graph: GraphEntry): void {
    this.graph = graph;
    this.drawOverlays();
  }

  setHighlighted(things: ReadonlySet<string>): void {
    this.highlighted = things;
    this.drawOverlays();
  }

  setMeasure(points: readonly Vector[]): void {
    this.measured = points;
    this.drawOverlays();
  }

  setRuler(taken: boolean): void {
    this.isRulerTaken = taken;
  }

  setChanges(changes: ChangeEntry[]): void {
    this.changes = changes;
    this.drawOverlays();
  }

  setCorrespondences(detail: EdgeDetail | null): void {
    this.detail = detail;
    this.drawOverlays();
  }

  setPoses(revision: RevisionPoses | null): void {
    this.revision = revision;
    this.place();
    this.drawOverlays();
  }

  setTheme(dark: boolean): void {
    this.scene.background = new Color(dark ? BACKGROUND.dark : BACKGROUND.light);
    this.draw();
  }

  // ---- where scenes lie -------------------------------------------------------------------------------------------

  private poseOf(scene: number): Matrix4 {
    if (this.dragged?.scene === scene) return this.dragged.pose;
    const then = this.revision?.scenes.find((one) => one.scene === scene);
    if (then) return new Matrix4().set(...(then.S_map_scene.flat() as Sixteen));
    return this.written[scene] ?? new Matrix4();
  }

  /** From where the map says that something of a scene is to where the scene is drawn. */
  private movedBy(scene: number): Matrix4 {
    const written = this.written[scene];
    return written ? this.poseOf(scene).clone().multiply(written.clone().invert()) : new Matrix4();
  }

  private isInComponent(scene: number): boolean {
    if (!this.revision) return this.map?.scenes[scene]?.component === this.component;
    return this.revision.scenes.some((one) => one.scene === scene && one.component === this.component);
  }

  private place(): void {
    const { map, loader, split } = this;
    if (!map || !loader) return;
    const hasMerged = loader.merged !== null;
    const left = hasMerged ? this.source : "scenes";
    const right = split ? (hasMerged ? split.source : "scenes") : left;
    const poses = new Map(this.revision?.scenes.map((one) => [one.scene, one]));
    const placed: TreePlacement[] = map.scenes.map((scene, i) => {
      const then = poses.get(i);
      const component = this.revision ? then?.component : scene.component;
      const isHere = component === this.component;
      const isLeft = isHere && left === "scenes" && this.visible.has(i);
      const isRight = isHere && right === "scenes" && (split?.scenes ?? this.visible).has(i);
      const pose =
        this.dragged?.scene === i
          ? this.dragged.pose
          : then
            ? new Matrix4().set(...(then.S_map_scene.flat() as Sixteen))
            : (this.written[i] as Matrix4);
      return { pose, sides: (isLeft ? 1 : 0) + (isRight ? 2 : 0) };
    });
    loader.place(placed, hasMerged ? (left === "merged" ? 1 : 0) + (right === "merged" ? 2 : 0) : 0);
    this.splatRenderer.setSplit(split ? split.at * this.renderer.domElement.width : null);
    this.refresh();
  }

  private get shown(): Component | undefined {
    return this.map?.components.find((one) => one.component === this.component);
  }

  /** All of the component is drawn, where its overview was made. */
  private get isWhole(): boolean {
    const isSeen = this.map?.scenes.every((_, i) => !this.isInComponent(i) || this.isSeen(i)) ?? false;
    return isSeen && !this.revision && !this.dragged;
  }

  /** Corners of boxes around all that is drawn. */
  private seenCorners(): Vector3[] {
    const { map, shown } = this;
    const at = (corner: Vector) => new Vector3(...corner);
    const inside = map?.scenes.map((_, i) => i).filter((i) => this.isInComponent(i)) ?? [];
    if (this.isWhole && shown?.overview?.frame) return shown.overview.frame.map(at);
    const corners = inside
      .filter((i) => this.isSeen(i))
      .flatMap((i) => map?.scenes[i]?.corners.map((one) => at(one).applyMatrix4(this.movedBy(i))) ?? []);
    return corners.length || !shown ? corners : new Array(8).fill(0).map((_, k) => at(cornerOf(shown.box, k)));
  }

  private cut(): void {
    const box = this.clip.box;
    const clip = box && { low: new Vector3(...box[0]), high: new Vector3(...box[1]) };
    const { up } = this.view.camera;
    const { at, top } = this.ceilingOf(this.seenCorners());
    this.top = this.shown?.overview?.has_ceiling ? top : Infinity;
    const isCut = top > -Infinity && (!this.isCeilingShown || this.state.isAbove);
    this.splatRenderer.setCuts(clip, isCut ? new Vector4(up.x, up.y, up.z, at) : null);
  }

  /** From which height on ceilings are left out of what has these corners, and how high it is. */
  private ceilingOf(corners: readonly Vector3[]): { at: number; top: number } {
    const heights = corners.map((corner) => corner.dot(this.view.camera.up));
    const [low, top] = [Math.min(...heights), Math.max(...heights)];
    return { at: low + CEILING_AT * (top - low), top };
  }

  /** Ceilings go as the viewer rises above them, and come back as they walk in. */
  private lookWhetherAbove(eye: Vector3): void {
    const isAbove = eye.dot(this.view.camera.up) > this.top;
    if (isAbove === this.state.isAbove) return;
    this.state.isAbove = isAbove;
    this.cut();
  }

  // ---- the view ---------------------------------------------------------------------------------------------------

  stand(at: Standpoint, fly = false): void {
    this.state.hasStood = true;
    this.view.stand(at, fly);
  }

  standpoint(): Standpoint {
    return this.view.standpoint();
  }

  fit(box?: Box, fly = true): void {
    if (box) {
      this.state.hasStood = true;
      this.view.fit(
        new Array(8).fill(0).map((_, k) => new Vector3(...cornerOf(box, k))),
        fly,
      );
      return;
    }
    let corners = this.seenCorners();
    if (!corners.length) return;
    const { up } = this.view.camera;
    const { at, top } = this.ceilingOf(corners);
    const highest = this.shown?.overview?.has_ceiling ? at : top;
    const outline = this.isWhole ? this.shown?.overview?.outline : null;
    const raised = (point: Vector3, by: number) => point.clone().addScaledVector(up, by);
    corners = outline
      ? outline
          .map((point) => new Vector3(...point))
          .flatMap((point) => [point, raised(point, highest - point.dot(up))])
      : corners.map((corner) => raised(corner, Math.min(0, highest - corner.dot(up))));
    this.view.fit(corners, fly, this.acrossFrame());
  }

  /** The level direction from which the component is widest. */
  private acrossFrame(): Vector3 | undefined {
    const frame = this.shown?.overview?.frame?.map((corner) => new Vector3(...corner));
    const [origin, along, across] = frame ?? [];
    if (!origin || !along || !across) return undefined;
    const isWide = this.view.camera.aspect >= 1;
    return (isWide ? origin.sub(across) : origin.sub(along)).normalize();
  }

  standAtCamera(T_map_camera: Matrix, intrinsics: [number, number, number, number], size: [number, number]): void {
    this.state.hasStood = true;
    this.view.standAtCamera(T_map_camera, intrinsics, size);
  }

  async walkIn(scene?: number): Promise<boolean> {
    const { map, component } = this;
    const scenes =
      map?.scenes.filter((one, i) => one.component === component && one.num_cameras && this.isSeen(i)) ?? [];
    const [largest] = [...scenes].sort((a, b) => b.num_gaussians - a.num_gaussians);
    const first = scene === undefined ? largest : map?.scenes[scene];
    const extras = first && (await this.fetchExtras(first.extras));
    const moved = this.movedBy(map?.scenes.indexOf(first as SceneEntry) ?? -1);
    const cameras = extras?.cameras.map((frustum) =>
      frustum.map((at) => new Vector3(...at).applyMatrix4(moved).toArray()),
    );
    if (!cameras?.length || this.map !== map || this.component !== component) return false;
    // From the camera that has most of the capture before it: the others' places lie ahead.
    const apexes = cameras.map((frustum) => new Vector3(...(frustum[0] as Vector)));
    const middle = apexes.reduce((sum, at) => sum.add(at), new Vector3()).divideScalar(apexes.length);
    const looks = cameras.map((frustum) => {
      const corners = frustum.slice(1).map((corner) => new Vector3(...corner));
      const ahead = corners.reduce((sum, at) => sum.add(at), new Vector3()).divideScalar(Math.max(1, corners.length));
      return ahead.sub(new Vector3(...(frustum[0] as Vector))).normalize();
    });
    let best = 0;
    let most = -Infinity;
    apexes.forEach((at, i) => {
      const to = middle.clone().sub(at);
      const score =
        to.dot(looks[i] as Vector3) - Math.abs((looks[i] as Vector3).dot(this.view.camera.up)) * to.length();
      if (score > most) [most, best] = [score, i];
    });
    const eye = apexes[best] as Vector3;
    const distance = Math.max(eye.distanceTo(middle), this.view.controls.minDistance * 5);
    const target = eye.clone().addScaledVector(looks[best] as Vector3, distance);
    this.state.hasStood = true;
    this.view.stand({ position: eye.toArray(), target: target.toArray() }, true);
    return true;
  }

  project(point: Vector): [number, number] | null {
    const { camera } = this.view;
    const at = new Vector3(...point).applyMatrix4(camera.matrixWorldInverse);
    if (at.z > -camera.near) return null;
    at.applyMatrix4(camera.projectionMatrix);
    const { clientWidth: width, clientHeight: height } = this.options.canvas;
    return [((at.x + 1) / 2) * width, ((1 - at.y) / 2) * height];
  }

  /** The viewer has moved of their own: what comes later does not move them. */
  private readonly onOwnWay = (): void => {
    this.state.hasStood = true;
  };

  private readonly resize = (): void => {
    const { canvas } = this.options;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.view.resize(width, height);
    if (this.split) this.splatRenderer.setSplit(this.split.at * canvas.width);
    this.refresh();
  };

  // ---- drawing ----------------------------------------------------------------------------------------------------

  /** Something is drawn otherwise from now on: choose, sort and draw anew. */
  private readonly refresh = (): void => {
    this.isStale = true;
    this.draw();
  };

  /** As tiles come: what the card takes for a picture is left for fetching the next ones. */
  private readonly refreshLater = (): void => {
    this.state.settled = false;
    this.later ||= window.setTimeout(
      () => {
        this.later = 0;
        this.refresh();
      },
      Math.min(LONGEST_MS, Math.max(SHORTEST_MS, this.costMs)),
    );
  };

  private readonly draw = (): void => {
    if (this.isDisposed) return;
    this.state.settled = false;
    this.scheduled ||= requestAnimationFrame(this.frame);
  };

  private readonly last = new Matrix4();

  private readonly frame = (now: number): void => {
    this.scheduled = 0;
    if (this.isDisposed) return;
    this.timer.update(now);
    const { camera } = this.view;
    const wasMoving = this.isMoving;
    // Flights go by the clock, however long a picture takes. After a rest the clock has gone on; the viewer has not.
    this.isMoving = this.view.update(wasMoving ? this.timer.getDelta() : 1 / 60);
    const viewProjection = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse);
    if (!viewProjection.equals(this.last)) {
      this.last.copy(viewProjection);
      this.isStale = true;
    }
    this.lookWhetherAbove(new Vector3().setFromMatrixPosition(camera.matrixWorld));
    if (this.isStale && this.loader) {
      const nearest = camera.near;
      const focalPx = ((camera.projectionMatrix.elements[5] ?? 1) * this.renderer.domElement.height) / 2;
      const eye = new Vector3().setFromMatrixPosition(camera.matrixWorld);
      this.loader.update({ viewProjection, eye, focalPx, nearest: Math.max(nearest, 1e-9) });
    }
    if (this.isStale && !this.isPreparing) void this.prepare();
    this.clip.update();
    this.splatRenderer.draw(this.scene, camera, camera.near);
    this.state.frames++;
    this.count();
    this.options.canvas.dispatchEvent(new Event("drawn"));
    if (this.isMoving) this.draw();
    else {
      if (wasMoving) this.options.onMove(this.standpoint());
      this.rest();
    }
  };

  private async prepare(): Promise<void> {
    this.isPreparing = true;
    this.isStale = false;
    const start = performance.now();
    try {
      await this.splatRenderer.prepare(this.scene, this.view.camera);
    } catch (error) {
      this.fail(error instanceof Error ? error.message : String(error));
    }
    this.isPreparing = false;
    this.state.isShown ||= (this.loader?.splats ?? 0) > 0;
    this.costMs = performance.now() - start;
    this.draw();
  }

  private count(): void {
    const { loader, state } = this;
    if (!loader) return;
    state.splats = loader.splats;
    state.bytesReceived = loader.bytesReceived;
    state.bytesUploaded = loader.bytesUploaded;
    state.pending = loader.pending;
  }

  private rest(): void {
    this.state.settled =
      this.loader !== null &&
      !this.isMoving &&
      !this.isStale &&
      !this.isPreparing &&
      !this.scheduled &&
      !this.later &&
      !this.state.pending;
  }

  private readonly fail = (message: string): void => {
    this.state.error = message;
    this.options.onError(message);
  };

  private readonly onLost = (event: Event): void => {
    event.preventDefault();
    this.state.phase = "failed";
    this.fail("the graphics card was lost: reload the page");
  };

  // ---- overlays ---------------------------------------------------------------------------------------------------

  private fetchExtras(uri: string): Promise<SceneExtras | null> {
    const known = this.extras.get(uri);
    if (known) return known;
    const asked = fetch(new URL(uri, document.baseURI))
      .then(async (response) => {
        if (!response.ok) throw new Error(`${uri}: ${response.status} ${response.statusText}`);
        const extras = (await response.json()) as SceneExtras;
        this.extrasOf.set(uri, extras);
        this.drawOverlays();
        return extras;
      })
      .catch((error: unknown) => {
        this.fail(error instanceof Error ? error.message : String(error));
        return null;
      });
    this.extras.set(uri, asked);
    return asked;
  }

  private drawOverlays(): void {
    const { map, shownOverlays: on, overlays } = this;
    if (!map) return;
    const here = map.scenes.map((_, i) => i).filter((i) => this.isInComponent(i) && this.isSeen(i));
    const shown = map.components.find((one) => one.component === this.component);
    const unit = 1 / (shown?.metres_per_unit || 1);
    const isHere = (component: number) => component === this.component;
    const middle = (i: number) => new Vector3(...(map.scenes[i]?.middle as Vector)).applyMatrix4(this.movedBy(i));

    const cameras: Lines[] = [];
    const nodes: Lines[] = [];
    if (on.has("cameras") || on.has("nodes"))
      for (const i of here) {
        const scene = map.scenes[i];
        const extras = scene && this.extrasOf.get(scene.extras);
        if (scene && !extras) void this.fetchExtras(scene.extras);
        if (!extras) continue;
        const moved = this.movedBy(i);
        if (on.has("cameras"))
          extras.cameras.forEach((frustum, index) =>
            cameras.push({
              points: frustumLines(frustum, moved),
              colour: COLOURS.camera,
              thing: { kind: "camera", index },
              scene: i,
            }),
          );
        if (on.has("nodes"))
          for (const points of Object.values(extras.layers))
            nodes.push({
              points: points.flatMap((at) => crossLines(new Vector3(...at).applyMatrix4(moved).toArray(), 0.06 * unit)),
              colour: COLOURS.node,
              scene: i,
            });
      }
    overlays.set("cameras", cameras);
    overlays.set("nodes", nodes, 1);
    overlays.set(
      "boxes",
      on.has("boxes")
        ? here.map((i) => ({
            points: boxLines(map.scenes[i]?.box as Box, this.poseOf(i)),
            colour: COLOURS.box,
            scene: i,
          }))
        : [],
    );
    const seen = new Set(here);
    overlays.set(
      "edges",
      on.has("edges")
        ? map.edges.flatMap((edge, index) => {
            if (!seen.has(edge.target) || !seen.has(edge.source) || edge.status === "no_match") return [];
            const colour =
              edge.status === "rejected"
                ? COLOURS.rejected
                : edge.used === "tentative"
                  ? COLOURS.tentative
                  : edge.used
                    ? COLOURS.used
                    : COLOURS.unused;
            const points = [...middle(edge.target).toArray(), ...middle(edge.source).toArray()];
            return [{ points, colour, thing: { kind: "edge" as const, index } }];
          })
        : [],
      3,
    );
    overlays.set(
      "ellipsoids",
      on.has("ellipsoids")
        ? here.flatMap((i) => {
            const covariance = map.scenes[i]?.ellipsoid;
            if (!covariance) return [];
            return [{ points: ellipsoidLines(middle(i).toArray(), covariance), colour: COLOURS.ellipsoid, scene: i }];
          })
        : [],
    );
    const things: Lines[] = [];
    const isDrawn = ({ id, component }: { id: string; component: number }) =>
      isHere(component) && (on.has("objects") || this.highlighted.has(id));
    this.graph.objects.forEach((object, index) => {
      if (isDrawn(object))
        things.push({ points: boxLines(object.box), colour: COLOURS.object, thing: { kind: "object", index } });
    });
    overlays.set("objects", things, 2);
    const [from, to] = this.measured;
    const marks = this.measured.flatMap((at) => crossLines(at, 0.06 * unit));
    if (from && to) marks.push(...from, ...to);
    overlays.set("measure", [{ points: marks, colour: COLOURS.measure }], 2.5);
    const rooms = on.has("rooms") ? this.graph.rooms.filter((room) => isHere(room.component)) : [];
    overlays.set("rooms", [{ points: rooms.flatMap((room) => room.outline.flat(2)), colour: COLOURS.room }], 2);
    overlays.set(
      "photos",
      on.has("photos")
        ? map.photos.flatMap((photo, index) =>
            isHere(photo.component)
              ? [
                  {
                    points: photoLines(photo, 0.4 * unit),
                    colour: COLOURS.photo,
                    thing: { kind: "photo" as const, index },
                  },
                ]
              : [],
          )
        : [],
      2,
    );
    const boxes = (isBold: boolean) =>
      this.changes.flatMap((change) => {
        if (!isHere(change.component) || this.highlighted.has(change.id) !== isBold) return [];
        const index = map.changes.findIndex((one) => one.id === change.id);
        const thing = { kind: "change" as const, index };
        return [{ points: boxLines(change.box), colour: CHANGE_COLOURS[change.kind], thing }];
      });
    overlays.set("changes", boxes(false), 2);
    overlays.set("highlighted changes", boxes(true), 5);
    overlays.set(
      "correspondences",
      this.detail
        ? [
            {
              points: this.detail.correspondences.flatMap(([a, b]) => [...a, ...b]),
              colour: COLOURS.correspondence,
            },
            {
              points: this.detail.correspondences.flatMap(([a]) => crossLines(a, 0.03 * unit)),
              colour: COLOURS.node,
            },
          ]
        : [],
    );
    this.draw();
  }

  private isSeen(scene: number): boolean {
    return this.visible.has(scene) || (this.split?.scenes.has(scene) ?? false);
  }

  // ---- picking ----------------------------------------------------------------------------------------------------

  private down: { x: number; y: number; id: number } | null = null;

  private readonly onDown = (event: PointerEvent): void => {
    this.options.canvas.focus({ preventScroll: true });
    this.state.hasStood = true;
    this.down =
      event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY, id: event.pointerId } : null;
  };

  private readonly onUp = (event: PointerEvent): void => {
    const { down } = this;
    this.down = null;
    if (down?.id !== event.pointerId || this.clip.isDragging || this.gizmos?.controls.some((one) => one.axis)) return;
    if (Math.hypot(event.clientX - down.x, event.clientY - down.y) > CLICK_PX) return;
    const found = this.pickAt(event);
    if (found) this.options.onPick(found);
  };

  private readonly onDouble = (event: MouseEvent): void => {
    const found = this.pickAt(event);
    if (found) this.view.flyTo(new Vector3(...found.point));
  };

  /** What lies under the pointer: a thing by its lines, else the nearest surface. */
  private pickAt(event: MouseEvent): Pick | null {
    const { canvas } = this.options;
    const rect = canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - rect.left, event.clientY - rect.top];
    const { camera } = this.view;
    const line = this.isRulerTaken ? null : this.overlays.pick(camera, x, y, rect.width, rect.height);
    const pixelAt = (depth: number) => (2 * depth) / ((camera.projectionMatrix.elements[5] ?? 1) * rect.height);
    if (line) {
      const depth = -line.point.clone().applyMatrix4(camera.matrixWorldInverse).z;
      const { scene = null, thing = null } = line.lines;
      return { point: line.point.toArray(), pixel: pixelAt(depth), scene, thing };
    }
    const k = canvas.width / rect.width;
    const hit = this.splatRenderer.pick(camera, Math.floor(x * k), Math.floor(y * k), canvas.width, canvas.height);
    if (!hit) return null;
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2((2 * x) / rect.width - 1, 1 - (2 * y) / rect.height), camera);
    const forward = new Vector3();
    camera.getWorldDirection(forward);
    const distance = hit.depth / ray.ray.direction.dot(forward);
    const point = ray.ray.origin.clone().addScaledVector(ray.ray.direction, distance);
    const owner = this.splatRenderer.owner(hit.splat);
    const scene = owner && this.loader ? this.loader.sceneOf(owner.tile, owner.index) : -1;
    return { point: point.toArray(), pixel: pixelAt(hit.depth), scene: scene >= 0 ? scene : null, thing: null };
  }

  // ---- dragging a scene -------------------------------------------------------------------------------------------

  drag(scene: number | null, onDrag?: (S_map_scene: Matrix) => void): void {
    if (this.gizmos) {
      for (const one of this.gizmos.controls) {
        one.detach();
        this.scene.remove(one.getHelper());
        one.dispose();
      }
      this.scene.remove(this.gizmos.handle);
      this.gizmos = null;
    }
    if (this.dragged) {
      this.dragged = null;
      this.place();
      this.drawOverlays();
    }
    const entry = scene === null ? undefined : this.map?.scenes[scene];
    if (scene === null || !entry) return this.draw();
    const start = this.poseOf(scene).clone();
    const handle = new Object3D();
    handle.position.copy(new Vector3(...entry.middle).applyMatrix4(this.movedBy(scene)));
    this.scene.add(handle);
    handle.updateMatrixWorld();
    const from = handle.matrixWorld.clone().invert();
    const controls = (["translate", "rotate"] as const).map((mode) => {
      const one = new TransformControls(this.view.camera, this.options.canvas);
      one.setMode(mode);
      one.setSize(mode === "translate" ? 0.8 : 1.1);
      one.attach(handle);
      one.addEventListener("dragging-changed", ({ value }) => {
        this.view.controls.enabled = !value;
        for (const other of controls) if (other !== one) other.enabled = !value;
      });
      one.addEventListener("change", this.draw);
      one.addEventListener("objectChange", () => {
        handle.updateMatrixWorld();
        const pose = handle.matrixWorld.clone().multiply(from).multiply(start);
        this.dragged = { scene, pose };
        this.place();
        this.drawOverlays();
        const e = pose.elements;
        onDrag?.([0, 1, 2, 3].map((r) => [0, 1, 2, 3].map((c) => e[4 * c + r] ?? 0)));
      });
      this.scene.add(one.getHelper());
      return one;
    });
    this.gizmos = { handle, controls };
    this.draw();
  }

  dispose(): void {
    this.isDisposed = true;
    cancelAnimationFrame(this.scheduled);
    clearTimeout(this.later);
    const { canvas } = this.options;
    canvas.removeEventListener("webglcontextlost", this.onLost);
    canvas.removeEventListener("pointerdown", this.onDown);
    canvas.removeEventListener("pointerup", this.onUp);
    canvas.removeEventListener("dblclick", this.onDouble);
    for (const name of ["wheel", "keydown"] as const) canvas.removeEventListener(name, this.onOwnWay);
    this.observer.disconnect();
    this.drag(null);
    this.clip.dispose();
    this.loader?.dispose();
    this.overlays.dispose();
    this.view.dispose();
    this.splatRenderer.dispose();
    this.renderer.dispose();
  }
}

const cornerOf = ([low, high]: Box, k: number) =>
  [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high : low)[axis]) as Vector;

function photoLines(photo: PhotoEntry, depth: number): number[] {
  const pose = new Matrix4().set(...(photo.T_map_camera.flat() as Sixteen));
  const [fx, fy, cx, cy] = photo.intrinsics_px;
  const [w, h] = photo.size_px;
  const corner = (x: number, y: number): Vector => [((x - cx) / fx) * depth, ((y - cy) / fy) * depth, depth];
  return frustumLines([[0, 0, 0], corner(0, 0), corner(w, 0), corner(w, h), corner(0, h)], pose);
}
