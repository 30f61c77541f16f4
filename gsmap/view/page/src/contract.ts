// What the server tells the page and takes from it. gsmap/view/content.py writes the same on the other side; a static
// page (`gsmap view --export`) is the GET part of it as files. Matrices are rows of rows; lengths are in the frame's
// unit unless a name says metres; dates are ISO 8601. Addresses are relative to the page, and are followed as they are
// given: they name things by content, not by their place in a list. Scene indices are into MapSummary.scenes of the
// same `state`.

export type Vector = [number, number, number];
export type Vector4 = [number, number, number, number];
export type Matrix = number[][]; // 4 x 4, [s R | t]
export type Box = [Vector, Vector]; // lowest and highest corner

/** GET map.json */
export interface MapSummary {
  schema: 1;
  state: string; // another one whenever the map has changed; see MapState
  title: string;
  actions: boolean; // whether POST actions/... is there: not in a static page, not with --read-only
  revision: number | null; // the newest; null before the first optimize
  stale: boolean; // reviews, priors, edges or scenes are newer than that revision: optimize would see them
  components: Component[];
  scenes: SceneEntry[];
  edges: EdgeEntry[];
  revisions: RevisionEntry[];
  changes: ChangeEntry[];
  compared: [number, number][]; // older and newer scene that were compared for changes, at the poses of now
  uncompared: [number, number][]; // those that the action `compare` would compare
  photos: PhotoEntry[];
  counts: { gaussians: number };
  graph: string | null; // GET: GraphEntry; null where there is none
  history: string | null; // GET with ?at=X,Y,Z&component=K: PlaceHistory; null in a static page
}

/** GET state.json, not in a static page: ask every few seconds, and map.json again when `state` is another. */
export interface MapState {
  state: string;
}

/** One component. A scene that nothing placed is a component of its own. */
export interface Component {
  component: number;
  num_scenes: number;
  up: Vector; // against gravity
  metres_per_unit: number;
  scale_sigma: number | null; // standard deviation of its logarithm; null if the scale is not known
  box: Box; // of what its scenes show, without floaters; map frame
  plan: string | null; // GET: FloorPlan; null in a static page and before the first optimize
  overview: Overview | null; // every scene of it, coarsely, in one file
  merged: string | null; // a tileset of merged tiles, in this component's frame, where one was given
}

/**
 * The coarsest level of every scene, in the map frame, one after the other in the order of `scenes`. What a scene looks
 * like from afar has to be found out once: while some are `pending`, `state` changes as they come.
 */
export interface Overview {
  uri: string; // SPZ whose numbers are in the map frame as they are: no axes are turned; colours of SH degree 0
  pending: number; // scenes that are not in it yet
  scenes: number[]; // indices into MapSummary.scenes
  counts: number[]; // Gaussians of each
  frame: Vector[] | null; // (8) corners of an upright box around nearly all of it, the lower four first; map frame
  outline: Vector[] | null; // around nearly all of its floor, closer than that box; map frame
  size: Vector | null; // length, width and height of that box, map units
  has_ceiling: boolean; // from above one would see roofs: most of the floor has something over it
}

export interface SceneEntry {
  id: string;
  name: string;
  num_gaussians: number;
  num_cameras: number;
  captured_at: string | null;
  component: number;
  status: string; // "placed", "one pair", "tentative", "not placed"
  S_map_scene: Matrix;
  box: Box; // without floaters; scene frame
  corners: Vector[]; // (8) of an upright box around it, or of `box` before there is an overview; map frame
  sigma_m: number | null; // of its middle, along the worst axis
  ellipsoid: Matrix3 | null; // covariance of its middle, map frame, square units
  middle: Vector; // map frame
  /**
   * GET: 3D Tiles, levels of detail of this scene, in its frame once the root's `transform` is left out. Answered with
   * 202 and TreeProgress while it is made; ask again after `retry_s`, the ones that matter most with the lowest
   * ?rank=0.. . What is no longer asked for is not made.
   */
  tileset: string;
  extras: string; // GET: SceneExtras
  tags: string[];
  prior: string | null; // what people or receivers told of where it lies, in words: "pose, 0.05 m, 2°"
  prior_number: number | null; // which of what was ever told that is
}
/** 202 of a tileset that is not there yet. */
export interface TreeProgress {
  progress: number; // 0..1 of this one; 0 while it waits
  waiting: number; // trees before it
  retry_s: number;
}
export type Matrix3 = number[][]; // 3 x 3

export interface EdgeEntry {
  target: number; // indices into scenes
  source: number;
  status: "accepted" | "rejected" | "no_match";
  used: boolean | "tentative" | null;
  one_pair: boolean; // tentative only because no loop confirms it; nothing contradicts it
  undecided: boolean;
  review: "confirm" | "reject" | null;
  note: string; // of the review
  reason: string;
  probability: number | null;
  overlap: number;
  num_inliers: number;
  doubt: number; // 0: nobody need look; edges are listed by it, largest first
  detail: string; // GET: EdgeDetail
}

export interface RevisionEntry {
  id: number;
  created_at: string;
  num_scenes: number;
  num_edges_used: number;
  poses: string | null; // GET: RevisionPoses; null where they were pruned
}

/** GET: where everything lay in a revision; scenes that were removed since are left out. */
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
  pictures: [string, string] | null; // GET: before and after, from the same camera
}

export interface PhotoEntry {
  file: string;
  component: number;
  T_map_camera: Matrix;
  intrinsics: [number, number, number, number]; // fx, fy, cx, cy in pixels
  size: [number, number];
  captured_at: string | null;
}

/** GET of Component.plan: its floor plan from above. Positions are shares of width and height, from the top left. */
export interface FloorPlan {
  picture: string | null; // a data address
  size_m: [number, number];
  P_plan_map: [Vector4, Vector4]; // times (x, y, z, 1) of a point of the map: its position on the plan
  scenes: { scene: number; at: [number, number]; outlines: [number, number][][] }[]; // index into MapSummary.scenes
}

/** GET of SceneEntry.extras */
export interface SceneExtras {
  layers: Record<string, Vector[]>; // nodes of its graph, map frame
  cameras: Vector[][]; // frusta: apex and four corners, map frame
}

/** GET of EdgeEntry.detail: why the pair is what it is. */
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
/** Both captures rendered from one camera of the pair; the pictures have the same size. Drawn when they are asked for. */
export interface EdgeView {
  camera: string;
  target: string; // addresses of JPEGs
  source: string;
  difference: string;
}

export interface ObjectEntry {
  id: string; // "o12"; 8 hex digits in a map that nobody may write
  name: string; // given by people; empty where there is none
  label: string; // the class that people gave it; empty where there is none
  component: number;
  position: Vector; // map frame
  box: Box;
  first_seen: string | null;
  last_seen: string | null;
  present: boolean;
  num_sightings: number;
  room: string | null; // id of the one it stands in
  picture: string | null; // GET: a small picture of it
}
export interface RoomEntry {
  id: string; // "r1"
  component: number;
  outline: [Vector, Vector][]; // straight pieces of line around its floor, map frame
  area_m2: number;
  doors: string[]; // ids of the rooms that one can walk to from it
}
/** GET of MapSummary.graph: objects of the map, how they stand to each other, its rooms. It may take a while to make. */
export interface GraphEntry {
  objects: ObjectEntry[];
  relations: { a: string; b: string; kind: string }[]; // ids; kind: "on", "in", "next to"
  rooms: RoomEntry[];
  changes: Record<string, string>; // room of each change that lies in one; ids
}

/** GET of MapSummary.history */
export interface PlaceHistory {
  rows: { at: string | null; scene: number; what: string; object: string | null }[];
}

/**
 * POST actions/NAME with JSON; answers {"map": MapSummary} or, with a status of 400 or more, {"error": "..."}: 400 what
 * makes no sense, 404 no such thing, 409 another action is at work. Any GET may answer with {"error": "..."}, too.
 */
export interface Actions {
  confirm: { what: string; note: string }; // "A:B" by scene ids, or "c12"
  reject: { what: string; note: string };
  withdraw: { what: string; note: string };
  prior: { scene: string; S_map_scene: Matrix; sigma_m: number; sigma_deg: number };
  earlier_prior: { scene: string; number: number }; // what was told of it before, by its number, holds again
  remove_prior: { scene: string };
  optimize: Record<string, never>;
  compare: Record<string, never>;
  date: { scene: string; captured_at: string }; // ISO 8601; "none" takes it away
  name_object: { object: string; name: string }; // an empty name takes the last one back
}
