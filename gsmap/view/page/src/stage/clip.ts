// A box that cuts, with a handle on each side to drag.
import { Box3, BufferAttribute, BufferGeometry, Group, Points, PointsMaterial, Vector3 } from "three";
import type { PerspectiveCamera } from "three";
import type { Box, Vector } from "../contract";
import { boxLines, COLOURS, Overlays } from "./overlays";

const REACH_PX = 16; // of a handle, for a finger
const LEAST = 0.02; // of the box that was given: how thin it may be made

export class ClipBox {
  readonly group = new Group();
  box: Box | null = null;
  isDragging = false;
  private onChange: ((box: Box) => void) | undefined;
  private readonly lines = new Overlays();
  private readonly handles: Points<BufferGeometry, PointsMaterial>;
  private side = -1; // 2 * axis + (1: high), while it is dragged
  private least = 0;
  private pointer = -1;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly camera: PerspectiveCamera,
    private readonly changed: () => void,
  ) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(18), 3));
    const material = new PointsMaterial({ color: COLOURS.clip, size: 12, sizeAttenuation: false });
    material.depthTest = false;
    material.transparent = true;
    this.handles = new Points(geometry, material);
    this.handles.frustumCulled = false;
    this.handles.renderOrder = 2;
    this.handles.visible = false;
    this.group.add(this.lines.group, this.handles);
    // Before the camera's controls hear of it.
    canvas.addEventListener("pointerdown", this.onDown, { capture: true });
    canvas.addEventListener("pointermove", this.onMoveTo, { capture: true });
    canvas.addEventListener("pointerup", this.onUp, { capture: true });
    canvas.addEventListener("pointercancel", this.onUp, { capture: true });
  }

  set(box: Box | null, onChange?: (box: Box) => void): void {
    this.box = box && [[...box[0]], [...box[1]]];
    this.onChange = onChange;
    if (box) this.least = LEAST * Math.max(...box[1].map((v, i) => v - (box[0][i] ?? 0)));
    this.draw();
  }

  update(): void {
    this.handles.material.size = 12 * Math.min(devicePixelRatio, 2);
  }

  private draw(): void {
    this.handles.visible = this.box !== null;
    this.lines.set("clip", this.box ? [{ points: boxLines(this.box), colour: COLOURS.clip }] : []);
    if (!this.box) return;
    const position = this.handles.geometry.getAttribute("position") as BufferAttribute;
    for (let side = 0; side < 6; side++) position.setXYZ(side, ...this.handle(side).toArray());
    position.needsUpdate = true;
  }

  private handle(side: number): Vector3 {
    const [low, high] = this.box as Box;
    const at = new Box3(new Vector3(...low), new Vector3(...high)).getCenter(new Vector3());
    return at.setComponent(side >> 1, (side & 1 ? high : low)[side >> 1] ?? 0);
  }

  private screen(at: Vector3): { x: number; y: number; isAhead: boolean } {
    const rect = this.canvas.getBoundingClientRect();
    const isAhead = at.clone().applyMatrix4(this.camera.matrixWorldInverse).z < 0;
    const ndc = at.clone().project(this.camera);
    return { x: rect.left + ((ndc.x + 1) / 2) * rect.width, y: rect.top + ((1 - ndc.y) / 2) * rect.height, isAhead };
  }

  private readonly onDown = (event: PointerEvent): void => {
    if (!this.box || event.button !== 0) return;
    let best = REACH_PX;
    this.side = -1;
    for (let side = 0; side < 6; side++) {
      const { x, y, isAhead } = this.screen(this.handle(side));
      const px = Math.hypot(event.clientX - x, event.clientY - y);
      if (isAhead && px < best) [best, this.side] = [px, side];
    }
    if (this.side < 0) return;
    this.isDragging = true;
    this.pointer = event.pointerId;
    this.canvas.setPointerCapture(event.pointerId);
    event.stopImmediatePropagation();
    event.preventDefault();
  };

  private readonly onMoveTo = (event: PointerEvent): void => {
    if (!this.isDragging || !this.box || event.pointerId !== this.pointer) return;
    event.stopImmediatePropagation();
    const axis = this.side >> 1;
    const at = this.handle(this.side);
    const here = this.screen(at);
    // How far one unit along the axis goes on the screen, there.
    const unit = Math.max(this.least, 1e-6);
    const there = this.screen(at.clone().setComponent(axis, at.getComponent(axis) + unit));
    const [dx, dy] = [(there.x - here.x) / unit, (there.y - here.y) / unit];
    const length2 = dx * dx + dy * dy;
    if (length2 < 1e-6) return;
    const by = ((event.clientX - here.x) * dx + (event.clientY - here.y) * dy) / length2;
    const [low, high] = this.box;
    const now = at.getComponent(axis) + by;
    if (this.side & 1) high[axis] = Math.max(now, (low[axis] ?? 0) + this.least);
    else low[axis] = Math.min(now, (high[axis] ?? 0) - this.least);
    this.draw();
    this.changed();
    this.onChange?.([[...low] as Vector, [...high] as Vector]);
  };

  private readonly onUp = (event: PointerEvent): void => {
    if (!this.isDragging || event.pointerId !== this.pointer) return;
    event.stopImmediatePropagation();
    this.isDragging = false;
  };

  dispose(): void {
    this.canvas.removeEventListener("pointerdown", this.onDown, { capture: true });
    this.canvas.removeEventListener("pointermove", this.onMoveTo, { capture: true });
    this.canvas.removeEventListener("pointerup", this.onUp, { capture: true });
    this.canvas.removeEventListener("pointercancel", this.onUp, { capture: true });
    this.lines.dispose();
    this.handles.geometry.dispose();
    this.handles.material.dispose();
  }
}
