"""Search a map for objects and places by an object, a point, an image or text."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap import find
from gsmap.describe.objects.layer import descriptor_id
from gsmap.describe.query_embedding import embed_query_picture, embed_query_text
from gsmap.errors import ConfigError, NotFoundError
from gsmap.map import models
from gsmap.map.objects.map_objects import MapObjects, compute_objects
from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys
from gsmap.map.thinning.thin import THINGS
from gsmap.store import Store
from gsmap.types import MapObject, ObjectObservation, PoseGraph, Scene, SceneGraph
from gsmap.types.progress import StageProgress
from gsmap.types.rows.find import FindHit, FindReport

_NEAR_M = 0.3  # a node, or a point that was picked, lies in the thing whose nearest sample is so near
_SAME_PLACE_M = 0.5  # nodes of no object that are nearer than this are one place


@dataclass(frozen=True)
class Request:
    """A search request; exactly one of its first four fields is set.

    Args:
        text: text, for an embedder with a text encoder.
        picture: an image file that shows one object.
        like: the id of an object, or ``SCENE:NODE``, a row of the object layer of a scene.
        at: (3,) a point in the frame of component 0, in its unit.
        top: the maximum number of hits.
    """

    text: str | None = None
    picture: str | os.PathLike[str] | None = None
    like: str | None = None
    at: Sequence[float] | None = None
    top: int = 10

    def __post_init__(self) -> None:
        given = [value for value in (self.text, self.picture, self.like, self.at) if value is not None]
        if len(given) != 1:
            raise ConfigError(
                "specify one query: text, --picture FILE, --like SCENE:NODE or --at X,Y,Z",
                code="nothing_requested",
            )
        if self.text is not None and not self.text.strip():
            raise ConfigError("the query text is empty", code="nothing_requested")
        if self.at is not None and (len(self.at) != 3 or not np.isfinite(self.at).all()):
            raise ConfigError(f"a point needs three numbers such as 1.5,0,2, got {list(self.at)}", code="invalid_point")
        if self.top < 1:
            raise ConfigError(f"--top must be at least 1, got {self.top}", code="out_of_range")

    @property
    def words(self) -> str:
        """The query as text for people."""
        if self.at is not None:
            return "what stands at " + ",".join(f"{value:g}" for value in self.at)
        if self.like is not None:
            return f"what is like {self.like}"
        return f"what {os.fspath(self.picture)} shows" if self.picture is not None else str(self.text)


@dataclass(frozen=True, eq=False)
class _SearchIndex:
    """The scene graphs of one recipe, with the objects built from them.

    Args:
        recipe: digest of the recipe.
        embedder: name of the embedder.
        graphs: scene graphs of that recipe by scene id, placed scenes only, and of thinned scenes graphs with segments
            alone.
        num_described: number of graphs of that recipe.
        poses, scenes: poses and scenes of all placed scenes.
        known: the objects of these graphs; those of the map, if these are the newest graphs.
        notes: remarks on the choice of the recipe.
    """

    recipe: str
    embedder: str
    graphs: Mapping[str, SceneGraph]
    num_described: int
    poses: PoseGraph
    scenes: Mapping[str, Scene]
    known: MapObjects
    notes: tuple[str, ...]

    @property
    def objects(self) -> list[MapObject]:
        return self.known.objects

    def name(self, scene: str) -> str:
        return self.scenes[scene].name


@dataclass(frozen=True, eq=False)
class _QueryVector:
    """A query embedding (F,), with a mask (F,) that is True for features that the query determines."""

    features: np.ndarray
    told: np.ndarray


def find_places(
    store: Store, request: Request, settings: Settings, progress: StageProgress
) -> tuple[FindReport, list[np.ndarray]]:
    """Find the places of a map that match a query, best first, and a box (2, 3) around each, map frame and unit.

    All captures are searched by one recipe: while a map moves to another embedder, the earlier one is searched until
    the map has been described anew as a whole; words and pictures need the current one. Words that are the name or
    label of an object need no embedder. Objects that are out of date are computed, and kept if the map can be written.

    Raises:
        NotFoundError: no poses yet, no such scene, node or object, or nothing stands at a point.
        ConfigError: words or a picture that the map's embedder cannot read; what to add is said.
    """
    if request.text is not None and (called := _called(store, request, settings, progress)) is not None:
        return called
    shown = _shown(store, request, settings)
    index = _index(store, settings, progress, present=shown is not None)
    if shown is not None:
        _require_same_meaning(index, descriptor_id(settings.describe.object, models.specs(store)))
    asked = _asked(store, request, index) if shown is None else shown
    hits, things = (
        _by_embedding(index, asked, request.top)
        if isinstance(asked, _QueryVector)
        else _by_likeness(index, asked, request.top)
    )
    notes = [*index.notes, *index.known.notes]
    if not hits:
        notes.append("nothing in the map is comparable with the query")
    report = FindReport(
        query=request.words,
        by="embedding" if isinstance(asked, _QueryVector) else "likeness",
        recipe=index.recipe,
        embedder=index.embedder,
        described=index.num_described,
        placed=len(index.scenes),
        hits=tuple(hits),
        notes=tuple(notes),
    )
    return report, [_box(index, hit, thing) for hit, thing in zip(hits, things, strict=True)]


# --- names that people gave ------------------------------------------------------------------------------------------


def _called(
    store: Store, request: Request, settings: Settings, progress: StageProgress
) -> tuple[FindReport, list[np.ndarray]] | None:
    """Return the objects whose name or label contains all query words; None without such objects.

    Of several those come first whose name is just what was asked for, then those that are there still.
    """
    if not store.objects.annotations():
        return None
    known = compute_objects(store, settings, progress)
    asked = str(request.text).casefold().split()
    found = []
    for thing in known.objects:
        name, label = (text.casefold().split() for text in (thing.words.name, thing.words.label))
        if set(asked) <= {*name, *label}:
            score = 1.0 if asked in (name, label) else len(set(asked)) / len({*name, *label})
            found.append((asked != name, -score, not thing.there, thing))
    if not found:
        return None
    found.sort(key=lambda one: one[:3])
    hits = []
    for rank, (_, score, _, thing) in enumerate(found[: request.top], 1):
        seen = [s.scene for s in thing.sightings if s.state == "seen" and s.scene in known.scenes]
        metres = known.metres.get(thing.component, 1.0)
        hits.append(
            FindHit(
                rank=rank,
                score=round(-score, 4),
                object=thing.id,
                name=thing.words.name or None,
                scene=seen[-1],
                scene_name=known.name_of(seen[-1]),
                node=None,
                component=thing.component,
                position=thing.position,
                position_m=thing.position * metres,
                size_m=(thing.box[1] - thing.box[0]) * metres,
                dates=tuple(known.dates[scene] for scene in seen),
            )
        )
    described = {s.scene for thing in known.objects for s in thing.sightings if s.thing >= 0}
    report = FindReport(
        query=request.words,
        by="name",
        recipe="",
        embedder="",
        described=len(described),
        placed=len(known.scenes),
        hits=tuple(hits),
        notes=known.notes,
    )
    return report, [thing.box for *_, thing in found[: request.top]]


# --- one recipe -------------------------------------------------------------------------------------------------------


def _index(store: Store, settings: Settings, progress: StageProgress, *, present: bool) -> _SearchIndex:
    """Load the graphs of the recipe that covers most scenes, and build their objects.

    Args:
        present: use the current recipe only; else the recipe that has described most scenes.
    """
    poses = store.revisions.get()
    if poses is None:
        raise NotFoundError("the map has no poses yet: run gsmap update first", code="no_poses")
    scenes = {scene.id: scene for scene in store.scenes.list() if scene.id in poses.poses}
    keys = graph_keys(store, list(scenes.values()), settings)
    now = next(iter(keys.values())).recipe if keys else ""
    made: dict[str, dict[str, str]] = {}
    for stored in store.graphs.list():  # oldest first
        if stored.scene in scenes and stored.recipe not in (None, THINGS.recipe):
            made.setdefault(stored.recipe, {})[stored.scene] = stored.key
    # Of a thinned scene only the segments are kept, which describe objects by shape and colour.
    thinned = {g.scene: g.key for g in store.graphs.list() if g.scene in scenes and g.recipe == THINGS.recipe}
    # What a scene is described under names its scale, too: of the present recipe only what is of use now counts.
    mine = {scene: key for scene, key in made.get(now, {}).items() if keys[scene].digest == key}
    made = {recipe: graphs for recipe, graphs in made.items() if recipe != now} | ({now: mine} if mine else {})
    if not made or (present and not mine):
        raise NotFoundError(
            "no placed capture is described by the present recipe yet: run gsmap update first"
            if made
            else "no placed capture is described: run gsmap update first",
            code="no_placed_scene",
        )
    recipe = now if present else max(made, key=lambda r: (len(made[r]), r == now, list(made).index(r)))
    notes = []
    if recipe != now:
        notes.append(
            f"searched the graphs of an earlier recipe, which has {len(made[recipe])} of {len(scenes)} captures; "
            f"the current recipe has {len(mine)}: gsmap update describes the rest"
        )
    elif num_without := len(scenes.keys() - mine.keys() - thinned.keys()):
        notes.append(
            f"{num_without} of {len(scenes)} captures are not described by the present recipe and take no "
            "part: gsmap update describes them"
        )
    keys_of = thinned | made[recipe]
    with store.located():
        graphs = {scene: store.graphs.load(scene, key) for scene, key in keys_of.items()}
    there = {scene: graph for scene, graph in graphs.items() if graph is not None}
    newest = {graph.scene: graph.key for graph in store.graphs.list() if graph.scene in scenes}
    known = compute_objects(store, settings, progress, None if keys_of == newest else there)
    num_described = len(there.keys() & made[recipe].keys())
    return _SearchIndex(recipe, _embedder(store, recipe), there, num_described, poses, scenes, known, tuple(notes))


def _embedder(store: Store, recipe: str) -> str:
    """Return the name of the embedder of a recipe."""
    about = store.recipes.get(recipe).settings.get("object") or {}
    named = about.get("embedders") if isinstance(about, Mapping) else None
    return ", ".join(sorted(map(str, named))) if isinstance(named, Mapping) else ""


def _require_same_meaning(index: _SearchIndex, descriptor: str) -> None:
    """Raise an error if the graphs and the query were embedded by different embedders."""
    layers = [graph.layers["objects"] for graph in index.graphs.values() if "objects" in graph.layers]
    if not layers:
        raise NotFoundError(
            "the map's graphs hold no embeddings, since describe.objects is off: search with --like or --at",
            code="no_embeddings",
        )
    if any(layer.descriptor_id != descriptor for layer in layers):
        raise NotFoundError(
            "the map's graphs were made by another embedder: run gsmap update first", code="embedding_mismatch"
        )


# --- what is asked for ------------------------------------------------------------------------------------------------


def _shown(store: Store, request: Request, settings: Settings) -> _QueryVector | None:
    """Return the embedding of a query's text or image; None for a query by object or point."""
    params, specs = settings.describe.object, models.specs(store)
    if request.text is not None:
        try:
            features = embed_query_text(request.text, params, specs)
        except ConfigError as error:
            raise ConfigError(
                f"no object has the name or label {request.text!r}: give names in gsmap view, or by gsmap edit MAP "
                f"o12 --name. Words for unnamed objects need a network; {error}",
                code="object_not_found",
            ) from error
        return _QueryVector(features, np.ones(len(features), bool))
    return None if request.picture is None else _QueryVector(*embed_query_picture(request.picture, params, specs))


def _asked(store: Store, request: Request, index: _SearchIndex) -> Sequence[ObjectObservation] | _QueryVector:
    """Return the observations of the queried object, or the embedding of a node without an object."""
    if request.at is not None:
        point = np.asarray(request.at, np.float64)
        thing = _thing_at(point, 0, index)
        if thing is None:
            raise NotFoundError(
                f"nothing stands within {_NEAR_M:g} m of {','.join(f'{v:g}' for v in request.at)}: gsmap graph "
                f"{store.home} lists where things are",
                code="nothing_near",
            )
        return thing.sightings
    assert request.like is not None
    wanted = index.known.joined.get(request.like, request.like)
    named = next((thing for thing in index.objects if wanted in (thing.id, thing.words.name)), None)
    if named is not None:
        return named.sightings
    ref, _, number = request.like.rpartition(":")
    if not ref or not number.isdecimal():
        raise NotFoundError(
            f"{request.like!r} is neither an object of the map (gsmap graph MAP) nor SCENE:NODE",
            code="object_not_found",
        )
    scene = store.scenes.get(ref)
    graph, row = index.graphs.get(scene.id), int(number)
    if graph is None:
        raise NotFoundError(
            f"scene {scene.name} has no graph of the recipe that is searched: run gsmap update first", code="no_graph"
        )
    layer = graph.layers.get("objects")
    if layer is None or row >= len(layer):
        raise NotFoundError(
            f"scene {scene.name} has {0 if layer is None else len(layer)} objects, counted from 0: "
            f"gsmap show {store.home} {scene.name!r} --picture FILE draws them",
            code="object_out_of_range",
        )
    pose = index.poses.poses[scene.id]
    thing = _thing_at(pose.S_map_scene.apply(layer.positions[row]), pose.component, index, scene.id)
    if thing is not None:
        return thing.sightings
    return _QueryVector(layer.embeddings[row], np.ones(layer.embeddings.shape[1], bool))


def _thing_at(point: np.ndarray, component: int, index: _SearchIndex, scene: str | None = None) -> MapObject | None:
    """Return the object at a point (3,) of the map; None without an object there.

    Args:
        scene: restrict the search to the segment of this scene.
    """
    metres = index.known.metres.get(component, 1.0)
    nearest, best = _NEAR_M, None
    for thing in index.objects:
        for sighting in thing.sightings if thing.component == component else ():
            if sighting.thing < 0 or scene not in (None, sighting.scene):
                continue
            samples = _samples(index, sighting)
            distance = float(np.linalg.norm(samples - point, axis=1).min(initial=np.inf)) * metres
            if distance < nearest:
                nearest, best = distance, thing
    return best


def _samples(index: _SearchIndex, sighting: ObjectObservation) -> np.ndarray:
    """Return the surface samples (K, 3) of a segment, in the map's frame and unit."""
    things = index.graphs[sighting.scene].segments
    assert things is not None
    end = int(things.sample_counts[: sighting.thing + 1].sum())
    own = things.samples[end - int(things.sample_counts[sighting.thing]) : end]
    return index.poses.poses[sighting.scene].S_map_scene.apply(own)


# --- ranking ----------------------------------------------------------------------------------------------------------


def _by_likeness(
    index: _SearchIndex, query: Sequence[ObjectObservation], top: int
) -> tuple[list[FindHit], list[MapObject | None]]:
    """Rank objects by their similarity to one object, beginning with that object."""
    looks: dict[str, list[find.SegmentDescriptor]] = {}
    for scene, graph in index.graphs.items():
        if graph.segments is not None and graph.up is not None:
            looks[scene] = find.describe_segments(graph.segments, graph.up)

    def shown(sightings: Sequence[ObjectObservation]) -> list[tuple[ObjectObservation, find.SegmentDescriptor]]:
        return [(s, looks[s.scene][s.thing]) for s in sightings if s.thing >= 0 and s.scene in looks]

    theirs = [shown(thing.sightings) for thing in index.objects]
    asked = [look for _, look in shown(query)]
    scores, which = find.rank_by_similarity(asked, [[look for _, look in one] for one in theirs])
    order = [int(i) for i in np.argsort(-scores, kind="stable")[:top] if which[i] >= 0]
    hits = [
        _hit(index, rank, float(scores[i]), index.objects[i], theirs[i][int(which[i])][0].scene)
        for rank, i in enumerate(order, 1)
    ]
    return hits, [index.objects[i] for i in order]


def _by_embedding(index: _SearchIndex, asked: _QueryVector, top: int) -> tuple[list[FindHit], list[MapObject | None]]:
    """Rank objects, each by its best matching node, and nodes that belong to no object."""
    scenes, rows, owners, points, scores = [], [], [], [], []
    places: list[MapObject | None] = list(index.objects)
    number = {thing.id: i for i, thing in enumerate(index.objects)}
    for scene, graph in sorted(index.graphs.items()):
        layer = graph.layers.get("objects")
        if layer is None or not len(layer):
            continue
        at = index.poses.poses[scene].S_map_scene.apply(layer.positions)
        inside = _thing_of(index, scene, layer.positions)
        mine = {s.thing: number[thing.id] for thing in index.objects for s in thing.sightings if s.scene == scene}
        if layer.embeddings.shape[1] != len(asked.features):
            raise ConfigError(
                f"what is asked for is a vector of {len(asked.features)} numbers, those of the map have "
                f"{layer.embeddings.shape[1]}: the text tower and the image encoder are not of one pack",
                code="embedding_mismatch",
            )
        scores.append(find.cosine_similarities(asked.features, asked.told, layer.embeddings))
        for row in range(len(layer)):
            scenes.append(scene)
            rows.append(row)
            points.append(at[row])
            owners.append(mine.get(int(inside[row]), -1) if inside[row] >= 0 else -1)
    if not scores:
        return [], []
    every, owner = np.concatenate(scores), np.array(owners)
    # What is of no object: the likest first, and what lies near it in the same component is the same place.
    component = np.array([index.poses.poses[scene].component for scene in scenes])
    where = np.array(points)
    for row in np.argsort(-every, kind="stable"):
        if owner[row] >= 0:
            continue
        metres = index.known.metres.get(int(component[row]), 1.0)
        near = np.linalg.norm(where - where[row], axis=1) * metres < _SAME_PLACE_M
        owner[(owner < 0) & near & (component == component[row])] = len(places)
        places.append(None)
        if len(places) - len(index.objects) > top:
            break
    told_of = owner >= 0
    best, which = find.best_per_owner(every[told_of], owner[told_of], len(places))
    of = np.flatnonzero(told_of)
    hits: list[FindHit] = []
    things: list[MapObject | None] = []
    for i in np.argsort(-best, kind="stable")[:top]:
        if which[i] < 0:
            break
        row = int(of[which[i]])
        hits.append(_hit(index, len(hits) + 1, float(best[i]), places[i], scenes[row], rows[row], where[row]))
        things.append(places[i])
    return hits, things


def _thing_of(index: _SearchIndex, scene: str, positions: np.ndarray) -> np.ndarray:
    """Return the segment (M,) of a scene that contains each point (M, 3) of the scene frame; -1 for no segment."""
    from scipy.spatial import cKDTree

    things = index.graphs[scene].segments
    if things is None or not len(things.samples):
        return np.full(len(positions), -1)
    distance, row = cKDTree(things.samples).query(positions)
    owner = np.repeat(np.arange(len(things)), things.sample_counts)
    return np.where(distance * things.unit_m < _NEAR_M, owner[row], -1)


def _box(index: _SearchIndex, hit: FindHit, thing: MapObject | None) -> np.ndarray:
    """Return the box (2, 3) around a hit, in the scene that matched best."""
    half = _SAME_PLACE_M / 2 / index.known.metres.get(hit.component, 1.0)
    if thing is None:
        return np.array([hit.position - half, hit.position + half])
    mine = next((s.box for s in thing.sightings if s.scene == hit.scene and s.box is not None), None)
    return thing.box if mine is None else mine


def _hit(
    index: _SearchIndex,
    rank: int,
    score: float,
    thing: MapObject | None,
    scene: str,
    node: int | None = None,
    position: np.ndarray | None = None,
) -> FindHit:
    component = index.poses.poses[scene].component
    metres = index.known.metres.get(component, 1.0)
    seen = [scene]
    if thing is not None:  # photos that see it are no scenes
        seen = [s.scene for s in thing.sightings if s.state == "seen" and s.scene in index.scenes]
    at = position if thing is None else thing.position
    assert at is not None
    return FindHit(
        rank=rank,
        score=round(score, 4),
        object=None if thing is None else thing.id,
        name=(thing.words.name or None) if thing is not None else None,
        scene=scene,
        scene_name=index.name(scene),
        node=node,
        component=component,
        position=at,
        position_m=at * metres,
        size_m=None if thing is None else (thing.box[1] - thing.box[0]) * metres,
        dates=tuple(index.scenes[one].captured_at for one in seen),
    )


def with_pictures(
    store: Store,
    report: FindReport,
    boxes: Sequence[np.ndarray],
    folder: Path,
    progress: StageProgress,
) -> FindReport:
    """Return the report with an image of every hit in a folder; see `gsmap.map.pictures.comparison_pictures`.

    Args:
        boxes: (2, 3) around each hit, map frame and unit.
    """
    from gsmap.map.pictures.comparison_pictures import draw_places

    files = draw_places(store, folder, [hit.scene for hit in report.hits], boxes, progress)
    hits = tuple(replace(hit, picture=file) for hit, file in zip(report.hits, files, strict=True))
    return replace(report, hits=hits)
