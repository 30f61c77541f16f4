// What the server tells the page and takes from it. gsmap/view/content.py writes the same on the other side; a static
// page (`gsmap view --export`) is the GET part of it as files. Matrices are rows of rows; lengths are in the frame's
// unit unless a name says metres; dates are ISO 8601. Addresses are relative to the page.

export type Vector = [number, number, number];
export type Matrix = number[][]; // 4 x 4, [s R | t]
export type Box = [Vector, Vector]; // lowest and highest corner

/** GET map.json */
export interface MapSummary {
  schema: 1;
  title: string;
  actions: boolean; // whether POST actions/... is there: not in a static page, not with --read-only
  revision: number | null; // the newest; null before the first optimize
  stale: boolean; // reviews, priors, edges or scenes are newer than that revision: optimize would see them
  components: Component[];
  scenes: SceneEntry[];
  edges: EdgeEntry[];
  revisions: RevisionEntry[];
  changes: ChangeEntry[];
  photos: PhotoEntry[];
  counts: { objects: number; gaussians: number };
}

/** One island. A scene that nothing placed is an island of its own. */
export interface Component {
  component: number;
  num_scenes: number;
  up: Vector; // against gravity
  metres_per_unit: number;
  box: Box; // of what its scenes show, without floaters; map frame
  overview: Overview | null; // every scene of it, coarsely, in one file
  merged: string | null; // a tileset of merged tiles, in this component's frame, where one was given
}

/** The coarsest level of every scene, in the map frame, one after the other in the order of `scenes`. */
export interface Overview {
  uri: string; // SPZ
  scenes: number[]; // indices into MapSummary.scenes
  counts: number[]; // Gaussians of each
}

export interface SceneEntry {
  id: string;
  name: string;
  num_gaussians: number;
  num_cameras: number;
  captured_at: string | null;
  component: number;
  status: string; // "placed", "tentative", "not placed"
  S_map_scene: Matrix;
  box: Box; // without floaters; scene frame
  corners: Vector[]; // (8) of that box in the map frame
  sigma_m: number | null; // of its middle, along the worst axis
  ellipsoid: Matrix3 | null; // covariance of its middle, map frame, square units
  middle: Vector; // map frame
  tileset: string; // 3D Tiles, scene frame: levels of detail of this scene
  tags: string[];
  prior: string | null; // what people or receivers told of where it lies, in words: "pose, 0.05 m, 2°"
}
export type Matrix3 = number[][]; // 3 x 3

export interface EdgeEntry {
  target: number; // indices into scenes
  source: number;
  status: "accepted" | "rejected" | "no_match";
  used: boolean | "tentative" | null;
  undecided: boolean;
  review: "confirm" | "reject" | null;
  note: string; // of the review
  reason: string;
  probability: number | null;
  overlap: number;
  num_inliers: number;
  doubt: number; // 0: nobody need look; edges are listed by it, largest first
}

export interface RevisionEntry {
  id: number;
  created_at: string;
  num_scenes: number;
  num_edges_used: number;
}

/** GET revisions/ID.json: where everything lay in that revision. */
export interface RevisionPoses {
  id: number;
  scenes: { scene: number; component: number; status: string; S_map_scene: Matrix }[];
}

export interface ChangeEntry {
  id: string; // "c12"
  kind: "appeared" | "disappeared" | "moved" | "recoloured" | "replaced" | "lighting";
  component: number;
  box: Box; // map frame
  before: number; // scene indices
  after: number;
  at: string | null; // when the newer capture was made
  confidence: number;
  status: string; // "open", "confirmed", "rejected"
  note: string; // of the review
  pictures: string | null; // GET: one picture, before and after beside each other
}

export interface PhotoEntry {
  file: string;
  component: number;
  T_map_camera: Matrix;
  intrinsics: [number, number, number, number]; // fx, fy, cx, cy in pixels
  size: [number, number];
  captured_at: string | null;
}

/** GET scenes/INDEX/extras.json */
export interface SceneExtras {
  layers: Record<string, Vector[]>; // nodes of its graph, map frame
  cameras: Vector[][]; // frusta: apex and four corners, map frame
}

/** GET edges/TARGET-SOURCE.json (scene indices): why the pair is what it is. */
export interface EdgeDetail {
  target: number;
  source: number;
  S_target_source: Matrix | null;
  steps: { name: string; value: string; bar: string; passed: boolean | null }[];
  advice: string[];
  correspondences: [Vector, Vector][]; // of the accepted set, target's and source's point, map frame by the target's pose
  views: EdgeView[];
  events: { at: string; what: string; reason: string }[];
}
/** Both captures rendered from one camera of the pair; the pictures have the same size. */
export interface EdgeView {
  camera: string;
  target: string; // addresses of JPEGs
  source: string;
  difference: string;
}

/** GET objects.json */
export interface ObjectEntry {
  id: string; // "o12"
  name: string;
  component: number;
  position: Vector; // map frame
  box: Box;
  first_seen: string | null;
  last_seen: string | null;
  present: boolean;
  num_sightings: number;
}
/** GET graph.json: relations between objects, and of scenes to objects. */
export interface GraphEntry {
  objects: ObjectEntry[];
  relations: { a: string; b: string; kind: string }[];
}

/** GET history.json?at=X,Y,Z&component=K */
export interface PlaceHistory {
  rows: { at: string | null; scene: number; what: string; object: string | null }[];
}

/** POST actions/NAME with JSON; answers {"map": MapSummary} or, with a status of 400 or more, {"error": "..."}. */
export interface Actions {
  confirm: { what: string; note: string }; // "A:B" by scene ids, or "c12"
  reject: { what: string; note: string };
  withdraw: { what: string; note: string };
  prior: { scene: string; S_map_scene: Matrix; sigma_m: number; sigma_deg: number };
  remove_prior: { scene: string };
  optimize: Record<string, never>;
}
