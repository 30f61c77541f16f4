// Where the viewer is and how they move: mouse, touch and keys.
import CameraControls from "camera-controls";
import {
  Box3,
  Matrix4,
  PerspectiveCamera,
  Quaternion,
  Raycaster,
  Sphere,
  Spherical,
  Vector2,
  Vector3,
  Vector4,
} from "three";
import type { Matrix, Vector } from "../contract";
import type { Standpoint } from "./stage";

CameraControls.install({
  THREE: { Vector2, Vector3, Vector4, Quaternion, Matrix4, Spherical, Box3, Sphere, Raycaster },
});

const FIELD_DEG = 60;
const STEP = 0.08; // of the distance to what is looked at, for one key
const TURN = Math.PI / 36;
const ELEVATION = (68 * Math.PI) / 180; // of the viewer over what is seen whole
const FILL = 0.99; // of the view, by what is seen whole

export class View {
  readonly camera = new PerspectiveCamera(FIELD_DEG, 1, 0.01, 1000);
  readonly controls: CameraControls;
  /** A capture's camera that is stood at, until the viewer moves. */
  private fixed: { pose: Matrix4; intrinsics: [number, number, number, number]; size: [number, number] } | null = null;
  private width = 1;
  private height = 1;
  private readonly still = matchMedia("(prefers-reduced-motion: reduce)");
  private size = 10;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onMove: () => void,
  ) {
    this.controls = new CameraControls(this.camera, canvas);
    this.controls.dollyToCursor = true;
    this.controls.infinityDolly = true;
    this.controls.smoothTime = 0.12;
    this.controls.draggingSmoothTime = 0.05;
    this.controls.addEventListener("controlstart", () => this.leaveCamera());
    for (const name of ["controlstart", "control", "transitionstart", "update", "wake"] as const)
      this.controls.addEventListener(name, onMove);
    canvas.addEventListener("wheel", () => this.leaveCamera(), { passive: true, capture: true });
    canvas.addEventListener("keydown", this.onKey);
  }

  get smooth(): boolean {
    return !this.still.matches;
  }

  /** Takes the component's up and size. */
  setWorld(up: Vector, size: number, unit: number): void {
    this.size = size;
    this.camera.up.set(...up).normalize();
    this.controls.updateCameraUp();
    this.controls.minDistance = 0.2 * unit;
    this.camera.near = 0.02 * unit;
  }

  resize(width: number, height: number): void {
    [this.width, this.height] = [Math.max(1, width), Math.max(1, height)];
    this.camera.aspect = this.width / this.height;
    // A phone held upright sees as much from side to side as it else would from top to bottom.
    const half = Math.tan((FIELD_DEG * Math.PI) / 360);
    this.camera.fov = (360 / Math.PI) * Math.atan(half / Math.min(1, this.camera.aspect * 1.2));
    this.camera.updateProjectionMatrix();
    this.onMove();
  }

  /** Moves on; returns whether it is still moving. */
  update(seconds: number): boolean {
    if (this.fixed) {
      this.standFixed(this.fixed);
      return false;
    }
    const moved = this.controls.update(seconds);
    const far = this.size + 2 * this.controls.distance;
    if (this.camera.far < far || this.camera.far > 4 * far) {
      this.camera.far = 2 * far;
      this.camera.updateProjectionMatrix();
    }
    this.camera.updateMatrixWorld();
    return moved;
  }

  stand({ position, target }: Standpoint, fly: boolean): void {
    this.fixed = null;
    this.camera.matrixAutoUpdate = true;
    this.camera.updateProjectionMatrix();
    void this.controls.setLookAt(...position, ...target, fly && this.smooth);
    this.onMove();
  }

  standAtCamera(pose: Matrix, intrinsics: [number, number, number, number], size: [number, number]): void {
    this.fixed = { pose: new Matrix4().set(...(pose.flat() as Parameters<Matrix4["set"]>)), intrinsics, size };
    this.onMove();
  }

  standpoint(): Standpoint {
    const position = this.controls.getPosition(new Vector3(), false);
    const target = this.controls.getTarget(new Vector3(), false);
    if (this.fixed) {
      position.setFromMatrixPosition(this.fixed.pose);
      target.copy(this.ahead(this.fixed.pose));
    }
    return { position: position.toArray(), target: target.toArray() };
  }

  /** Flies towards a point: half way, and turns about it from then on. */
  flyTo(point: Vector3): void {
    const { position } = this.standpoint();
    const eye = new Vector3(...position);
    const near = eye.clone().lerp(point, 0.5);
    this.stand({ position: near.toArray(), target: point.toArray() }, true);
  }

  /**
   * Sees points whole, obliquely from above, as large as they fit.
   * @param aside level direction in which the viewer stands, or its opposite, from where they are larger; else any
   */
  fit(points: readonly Vector3[], fly: boolean, aside?: Vector3): void {
    const { up } = this.camera;
    const side = aside ?? new Vector3(Math.abs(up.x) < 0.9 ? 1 : 0, Math.abs(up.x) < 0.9 ? 0 : 1, 0).cross(up);
    const ways = [side, side.clone().negate()].slice(0, aside ? 2 : 1).map((one) => this.wholeFrom(points, one));
    const [best] = ways.sort((a, b) => a.distance - b.distance);
    if (best) this.stand({ position: best.eye.toArray(), target: best.target.toArray() }, fly);
  }

  /** Where one stands on a side to see points whole. */
  private wholeFrom(points: readonly Vector3[], side: Vector3) {
    const { up } = this.camera;
    const forward = side.normalize().multiplyScalar(-Math.cos(ELEVATION)).addScaledVector(up, -Math.sin(ELEVATION));
    const right = forward.clone().cross(up).normalize();
    const above = right.clone().cross(forward);
    const middle = new Box3().setFromPoints([...points]).getCenter(new Vector3());
    const half = Math.tan((this.camera.fov * Math.PI) / 360) * FILL;
    // At a distance d a point at x across and z ahead of the middle is in view where |x - shift| <= tan (d + z).
    const along = (axis: Vector3, tan: number) => {
      let [a, b] = [-Infinity, -Infinity];
      for (const point of points) {
        const off = point.clone().sub(middle);
        const [x, z] = [off.dot(axis) / tan, off.dot(forward)];
        [a, b] = [Math.max(a, x - z), Math.max(b, -x - z)];
      }
      return { distance: (a + b) / 2, shift: (tan * (a - b)) / 2 };
    };
    const [x, y] = [along(right, half * this.camera.aspect), along(above, half)];
    const distance = Math.max(x.distance, y.distance, this.controls.minDistance);
    const target = middle.addScaledVector(right, x.shift).addScaledVector(above, y.shift);
    return { distance, target, eye: target.clone().addScaledVector(forward, -distance) };
  }

  private ahead(pose: Matrix4): Vector3 {
    const e = pose.elements;
    const forward = new Vector3(e[8], e[9], e[10]).normalize();
    return new Vector3().setFromMatrixPosition(pose).addScaledVector(forward, this.controls.minDistance * 8);
  }

  /** Goes on from a capture's camera as from any other standpoint. */
  private leaveCamera(): void {
    if (this.fixed) this.stand(this.standpoint(), false);
  }

  private standFixed({ pose, intrinsics: [fx, fy, cx, cy], size: [w, h] }: NonNullable<View["fixed"]>): void {
    const { camera, width, height } = this;
    // Right, down, front to right, up, back; the whole picture is seen, in the middle.
    camera.matrixAutoUpdate = false;
    camera.matrix.copy(pose).multiply(new Matrix4().makeScale(1, -1, -1));
    camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
    camera.scale.setScalar(1);
    camera.matrix.compose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
    const k = Math.min(width / w, height / h);
    const [x, y] = [width / 2 + k * (cx - w / 2), height / 2 + k * (cy - h / 2)];
    const { near, far } = camera;
    camera.projectionMatrix.set(
      ...[(2 * k * fx) / width, 0, 1 - (2 * x) / width, 0],
      ...[0, (2 * k * fy) / height, (2 * y) / height - 1, 0],
      ...([0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near), 0, 0, -1, 0] as const),
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  private readonly onKey = (event: KeyboardEvent): void => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    this.leaveCamera();
    const { controls } = this;
    const step = STEP * Math.max(controls.distance, 2 * controls.minDistance) * (event.shiftKey ? 4 : 1);
    const smooth = this.smooth;
    const moves: Record<string, () => unknown> = {
      w: () => controls.forward(step, smooth),
      s: () => controls.forward(-step, smooth),
      a: () => controls.truck(-step, 0, smooth),
      d: () => controls.truck(step, 0, smooth),
      q: () => controls.elevate(-step, smooth),
      e: () => controls.elevate(step, smooth),
      arrowleft: () => controls.rotate(-TURN, 0, smooth),
      arrowright: () => controls.rotate(TURN, 0, smooth),
      arrowup: () => controls.rotate(0, -TURN, smooth),
      arrowdown: () => controls.rotate(0, TURN, smooth),
      "+": () => controls.dolly(2 * step, smooth),
      "=": () => controls.dolly(2 * step, smooth),
      "-": () => controls.dolly(-2 * step, smooth),
    };
    const move = moves[event.key.toLowerCase()];
    if (!move) return;
    event.preventDefault();
    move();
    this.onMove();
  };

  dispose(): void {
    this.canvas.removeEventListener("keydown", this.onKey);
    this.controls.dispose();
  }
}
