"""The JSON that the server and a static page give to the page of `gsmap view`, and the JSON that the page sends.

`tools.make.page_contract` generates `gsmap/view/page/src/contract.ts` from it. Matrices are rows of rows; lengths are
in the unit of the frame unless a name says metres; dates are ISO 8601. Addresses are relative to the page and name
things by content. Indices of scenes are into ``MapSummary.scenes`` of the same ``state``. A static page
(`gsmap view --export`) is the GET part as files.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, TypedDict, TypeVar

from gsmap.types.plain import plain
from gsmap.types.rows.base import Row
from gsmap.types.scene import SceneFacts

_Entry = TypeVar("_Entry")


class Ts(NamedTuple):
    """The type of a value in TypeScript, where it says more than that in Python."""

    text: str


Vector = Annotated[list[float], Ts("Vector")]
Vector4 = Annotated[list[float], Ts("Vector4")]
Point2 = Annotated[list[float], Ts("[number, number]")]
Matrix = Annotated[list[list[float]], Ts("Matrix")]
Matrix3 = Annotated[list[list[float]], Ts("Matrix3")]
Box = Annotated[list[list[float]], Ts("Box")]
Pair = Annotated[list[int], Ts("[number, number]")]

ALIASES = {
    "Vector": "[number, number, number]",
    "Vector4": "[number, number, number, number]",
    "Matrix": "number[][]",
    "Matrix3": "number[][]",
    "Box": "[Vector, Vector]",
}
"""Names of types in TypeScript: a matrix is 4 x 4, [s R | t], or 3 x 3; a box its lowest and highest corner."""


def entry_of(row: Row, entry: type[_Entry]) -> _Entry:
    """Return the part of an entry of the page that is the same in a row of the verbs."""
    found: Any = {name: plain(getattr(row, name)) for name in entry.__annotations__ if hasattr(row, name)}
    return found


class Overview(TypedDict):
    """The coarsest level of every scene of a component, in the map frame, one after the other in the order of
    ``scenes``. ``state`` changes while scenes are pending.

    Args:
        uri: SPZ file in the map frame, axes not turned, colours of SH degree 0.
        pending: number of scenes that it still lacks.
        scenes: indices of its scenes.
        counts: number of Gaussians of each.
        frame: (8) corners of an upright box around nearly all of it, the lower four first; map frame.
        outline: points around nearly all of its floor, closer than the box; map frame.
        size: length, width and height of the box, map units.
        has_ceiling: most of the floor has something above it.
    """

    uri: str
    pending: int
    scenes: list[int]
    counts: list[int]
    frame: list[Vector] | None
    outline: list[Vector] | None
    size: Vector | None
    has_ceiling: bool


class Component(TypedDict):
    """A component; a scene without a pose is a component of its own.

    Args:
        up: direction opposite to gravity.
        scale_sigma: standard deviation of the logarithm of the scale; null if the scale is unknown.
        box: box of its scenes without floaters; map frame.
        plan: GET: FloorPlan; null in a static page and before the first optimize.
        overview: every scene, coarsely, in one file.
        merged: tileset of merged tiles in the frame of the component; null without.
    """

    component: int
    num_scenes: int
    up: Vector
    metres_per_unit: float
    scale_sigma: float | None
    box: Box
    plan: str | None
    overview: Overview | None
    merged: str | None


class SceneEntry(TypedDict):
    """A scene on the page: its facts (`FACTS`), and where it lies.

    Args:
        status: ``placed``, ``one pair``, ``tentative`` or ``not placed``.
        box: box without floaters; scene frame.
        corners: (8) corners of an upright box around it, or of ``box`` without an overview; map frame.
        sigma_m: standard deviation of its middle in the least certain direction.
        ellipsoid: covariance of its middle; map frame, square units.
        middle: middle of its box; map frame.
        tileset: GET: 3D Tiles, levels of detail in the scene's frame without the root's ``transform``; 202 with
            TreeProgress until they are made: ask again after ``retry_s``, the most important ones with the lowest
            ?rank=0.. . Requests that are not repeated are dropped.
        extras: GET: SceneExtras.
        prior: description of its pose prior, such as "pose, 0.05 m, 2°".
        prior_number: number of that prior in the history of priors.
    """

    component: int
    status: str
    S_map_scene: Matrix
    box: Box
    corners: list[Vector]
    sigma_m: float | None
    ellipsoid: Matrix3 | None
    middle: Vector
    tileset: str
    extras: str
    tags: list[str]
    prior: str | None
    prior_number: int | None


FACTS = {"SceneEntry": SceneFacts}
"""Dataclasses whose fields an entry has as well."""


class EdgeEntry(TypedDict):
    """A registered pair; edges are listed by ``doubt``, largest first.

    Args:
        target: index of the target scene.
        source: index of the source scene.
        status: status after any review.
        used: use in the newest revision; null before the first optimize.
        one_pair: tentative only because no cycle confirms it; nothing contradicts it.
        undecided: it contradicts other edges, without evidence for either.
        review: current review.
        note: note of the review.
        reason: reason for the status.
        probability: probability that the pose is right.
        overlap: overlap of the scenes, in [0, 1].
        doubt: urgency of a review, in [0, 1].
        registration: number of its current registration.
        detail: GET: EdgeDetail.
    """

    target: int
    source: int
    status: Annotated[str, Literal["accepted", "rejected", "no_match"]]
    used: Annotated[bool | str | None, Ts('boolean | "tentative" | null')]
    one_pair: bool
    undecided: bool
    review: Annotated[str | None, Literal["confirm", "reject", None]]
    note: str
    reason: str
    probability: float | None
    overlap: float
    num_inliers: int
    doubt: float
    registration: int | None
    detail: str


class RevisionEntry(TypedDict):
    """A revision.

    Args:
        poses: GET: RevisionPoses; null if they were pruned.
    """

    number: int
    created_at: str
    scenes: int
    edges_used: int
    poses: str | None


class ChangeEntry(TypedDict):
    """A change between two scenes.

    Args:
        id: such as "c12".
        box: bounding box; map frame.
        older: index of the older scene.
        newer: index of the newer scene.
        newer_at: date of the newer scene.
        status: ``open``, ``confirmed`` or ``rejected``.
        note: note of its review.
        pictures: GET: pictures before and after, from the same camera.
    """

    id: str
    kind: Annotated[str, Literal["appeared", "disappeared", "moved", "recoloured", "replaced", "lighting"]]
    component: int
    box: Box
    older: int
    newer: int
    newer_at: str | None
    confidence: float
    status: str
    note: str
    pictures: Annotated[list[str] | None, Ts("[string, string] | null")]


class PhotoEntry(TypedDict):
    """A localized photo.

    Args:
        T_map_camera: pose in the map frame.
        intrinsics_px: fx, fy, cx, cy.
        size_px: width and height.
        captured_at: date of the photo.
    """

    file: str
    component: int
    T_map_camera: Matrix
    intrinsics_px: Vector4
    size_px: Pair
    captured_at: str | None


class Counts(TypedDict):
    """Counts of the whole map."""

    gaussians: int


class MapSummary(TypedDict):
    """GET map.json.

    Args:
        state: text that differs after every change of the map; see MapState.
        actions: POST actions/... is available: not in a static page or with --read-only.
        revision: newest revision; null before the first optimize.
        stale: reviews, priors, edges or scenes are newer than the revision.
        compared: older and newer scene of each pair that was compared for changes at the current poses.
        uncompared: pairs that the action ``compare`` would compare.
        graph: GET: GraphEntry; null without one.
        history: GET with ?at=X,Y,Z&component=K: PlaceHistory; null in a static page.
    """

    schema: Literal[1]
    state: str
    title: str
    actions: bool
    revision: int | None
    stale: bool
    components: list[Component]
    scenes: Annotated[list[dict[str, Any]], Ts("SceneEntry[]")]
    edges: list[EdgeEntry]
    revisions: list[RevisionEntry]
    changes: list[ChangeEntry]
    compared: list[Pair]
    uncompared: list[Pair]
    photos: list[PhotoEntry]
    counts: Counts
    graph: str | None
    history: str | None


class MapState(TypedDict):
    """GET state.json, not in a static page: ask every few seconds, and for map.json again if ``state`` differs."""

    state: str


class TreeProgress(TypedDict):
    """202 of a tileset that is not made yet.

    Args:
        progress: 0..1 of this one; 0 while it waits.
        waiting: number of trees before it.
        retry_s: delay of the next request.
    """

    progress: float
    waiting: int
    retry_s: float


class RevisionScene(TypedDict):
    """The pose of a scene in a revision; ``scene`` is an index."""

    scene: int
    component: int
    status: str
    S_map_scene: Matrix


class RevisionPoses(TypedDict):
    """GET: the poses of a revision, without scenes that were removed since."""

    number: int
    scenes: list[RevisionScene]


class PlanScene(TypedDict):
    """A scene on a floor plan; ``scene`` is an index."""

    scene: int
    at: Point2
    outlines: list[list[Point2]]


class FloorPlan(TypedDict):
    """GET: the floor plan of a component from above. Positions are shares of width and height, from the top left.

    Args:
        picture: data address.
        P_plan_map: times (x, y, z, 1) of a point of the map: its position on the plan.
    """

    picture: str | None
    size_m: Point2
    P_plan_map: Annotated[list[list[float]], Ts("[Vector4, Vector4]")]
    scenes: list[PlanScene]


class SceneExtras(TypedDict):
    """GET: nodes and cameras of a scene.

    Args:
        layers: nodes of its graph by layer; map frame.
        cameras: frusta, apex and four corners; map frame.
    """

    layers: dict[str, list[Vector]]
    cameras: list[list[Vector]]


class Step(TypedDict):
    """A step of the explanation of a pair: its value, and the bar that it passed or not."""

    name: str
    value: str
    bar: str
    passed: bool | None


class EdgeView(TypedDict):
    """Both scenes rendered from one camera of the pair, pictures of the same size, drawn on request.

    Args:
        target: address of a JPEG, as the next two.
    """

    camera: str
    target: str
    source: str
    difference: str


class PairEvent(TypedDict):
    """An event in the history of a pair."""

    at: str
    what: str
    reason: str


class PairDetail(TypedDict):
    """The explanation of a pair.

    Args:
        correspondences: target's and source's point of each correspondence, map frame by the pose of the target.
    """

    S_target_source: Matrix | None
    steps: list[Step]
    advice: list[str]
    correspondences: Annotated[list[list[list[float]]], Ts("[Vector, Vector][]")]
    events: list[PairEvent]


class PlacedPairDetail(PairDetail):
    """The explanation of a pair, with the indices of its scenes."""

    target: int
    source: int


class EdgeDetail(PlacedPairDetail):
    """GET: the explanation of a pair, with pictures."""

    views: list[EdgeView]


class ObjectEntry(TypedDict):
    """An object.

    Args:
        id: such as "o12"; 8 hex digits in a map that is read-only.
        name: name that people gave it, or empty.
        label: class that people gave it, or empty.
        position: centre; map frame.
        room: id of its room.
        picture: GET: a small picture.
    """

    id: str
    name: str
    label: str
    component: int
    position: Vector
    box: Box
    first_seen: str | None
    last_seen: str | None
    there: bool
    seen: int
    room: str | None
    picture: str | None


class RoomEntry(TypedDict):
    """A room.

    Args:
        id: such as "r1".
        outline: line segments around its floor; map frame.
        doors: ids of the rooms that its doors lead to.
    """

    id: str
    component: int
    outline: Annotated[list[list[list[float]]], Ts("[Vector, Vector][]")]
    area_m2: float
    doors: list[str]


class RelationEntry(TypedDict):
    """A relation of two objects by id: ``on``, ``in`` or ``next to``."""

    subject: str
    relation: str
    other: str


class GraphEntry(TypedDict):
    """GET: objects, their relations, and rooms. It may take a while.

    Args:
        changes: room of each change that lies in one, by ids.
    """

    objects: list[ObjectEntry]
    relations: list[RelationEntry]
    rooms: list[RoomEntry]
    changes: dict[str, str]


class HistoryRow(TypedDict):
    """An observation of an object; ``scene`` is an index, ``object`` an id."""

    captured_at: str | None
    scene: int
    state: str
    object: str | None


class PlaceHistory(TypedDict):
    """GET: what scenes showed at a place, oldest first."""

    rows: list[HistoryRow]


class ReviewAction(TypedDict):
    """A review of a pair "A:B" by scene ids, or of a change "c12"."""

    what: str
    note: str


class PriorAction(TypedDict):
    """A pose prior of a scene."""

    scene: str
    S_map_scene: Matrix
    sigma_m: float
    sigma_deg: float


class EarlierPriorAction(TypedDict):
    """Set an earlier prior of a scene again, by its number."""

    scene: str
    number: int


class SceneAction(TypedDict):
    """An action on a scene."""

    scene: str


class DateAction(TypedDict):
    """The capture date of a scene, ISO 8601; "none" removes it."""

    scene: str
    captured_at: str


class NameAction(TypedDict):
    """A name of an object; an empty name takes the last one back."""

    object: str
    name: str


Nothing = Annotated[dict[str, Any], Ts("Record<string, never>")]


class Actions(TypedDict):
    """POST actions/NAME with JSON; answers {"map": MapSummary} or, with a status of 400 or more, {"error": "..."}: 400
    for invalid requests, 404 if there is no such thing, 409 while another action runs. Any GET may answer with an
    error, too.
    """

    confirm: ReviewAction
    reject: ReviewAction
    withdraw: ReviewAction
    prior: PriorAction
    earlier_prior: EarlierPriorAction
    remove_prior: SceneAction
    optimize: Nothing
    compare: Nothing
    date: DateAction
    name_object: NameAction
