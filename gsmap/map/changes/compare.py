"""Change stage: choose pairs of visits and compare the pairs that lack a current comparison."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from gsmap import change
from gsmap.engine import run_jobs
from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.metric_scale import in_metres
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.geometry.warps import Warp, warp_cameras, warp_gaussians
from gsmap.map.changes.visits import Visit, has_moved, pairs_of_visits
from gsmap.map.date_filter import NO_DATE, parse_moment
from gsmap.map.jobs import store_of
from gsmap.map.metric_scales import metres_of_scenes
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import SharedJobs, note_interruption
from gsmap.map.stages.nonrigid import DeformedPair, deformed_pairs
from gsmap.methods import RecipeKey
from gsmap.store import Store
from gsmap.store.change_rows import Comparison
from gsmap.types import ChangeReport, PosedScene, PoseGraph, Scene, Sim3
from gsmap.types.progress import StageProgress

_NAMED = 5  # scenes that a remark names
_NOT_COMPARED = (
    "not compared: a capture is bent or stretched, and they share too little to fit its shape, or lack a graph"
)


@dataclass(frozen=True, eq=False)
class ComparisonPlan:
    """The comparisons that a map needs.

    Args:
        visits: dated scenes with a pose, by scene id.
        pairs: (older, newer) scene ids.
        notes: scenes that are left out, with the reason.
        deformed: the pairs of which the older scene is warped onto the newer one.
    """

    visits: dict[str, Visit]
    pairs: list[tuple[str, str]]
    notes: tuple[str, ...]
    deformed: Mapping[tuple[str, str], DeformedPair]


def plan_comparisons(store: Store, settings: Settings, pair: tuple[Scene, Scene] | None = None) -> ComparisonPlan:
    """Choose the pairs of visits to compare (`gsmap.map.changes.visits`), or one given pair, without reading arrays.

    Raises:
        NotFoundError: the map has no poses yet, or a scene that is named has no place.
        InputError: of two scenes that are named, which one is newer is not known, or they share no frame.
    """
    graph = _poses(store)
    scenes = store.scenes.list() if pair is None else list(pair)
    undated = [scene.name for scene in scenes if scene.captured_at is None]
    visits = _visits(store, scenes, graph)
    if pair is None:
        unplaced = [scene.name for scene in scenes if scene.id not in graph.poses]
        notes = [f"{_names(undated)} no date: which one is newer is not known ({NO_DATE})"] if undated else []
        if unplaced:
            notes.append(f"{_names(unplaced)} no place in the map yet: run gsmap update")
        pairs = pairs_of_visits(list(visits.values()), settings.visits)
        return ComparisonPlan(visits, pairs, tuple(notes), deformed_pairs(store, settings, graph, pairs))
    for scene in pair:
        if scene.id not in graph.poses:
            raise NotFoundError(
                f"scene {scene.name} has no place in the map yet: run gsmap update first", code="scene_unplaced"
            )
    if undated:
        raise InputError(
            f"{_names(undated)} no date: which one is newer is not known ({NO_DATE})", code="order_unknown"
        )
    older, newer = sorted((visits[scene.id] for scene in pair), key=lambda visit: visit.when)
    if older.when == newer.when:
        raise InputError(
            f"{pair[0].name} and {pair[1].name} have the same date, so it is unknown which one is newer",
            code="order_unknown",
        )
    if older.component != newer.component:
        raise InputError(
            f"{pair[0].name} and {pair[1].name} lie in two components, so their relative pose is unknown",
            code="different_components",
        )
    pairs = [(older.scene, newer.scene)]
    return ComparisonPlan(visits, pairs, (), deformed_pairs(store, settings, graph, pairs))


def missing_comparisons(store: Store, asked: ComparisonPlan, settings: Settings) -> list[tuple[str, str]]:
    """Return the pairs without a current comparison: new pairs, and pairs compared by another recipe or at other
    poses.
    """
    done = {(one.older, one.newer) for one in _valid(store.changes.current(), asked, settings)}
    return [pair for pair in asked.pairs if pair not in done]


def standing_comparisons(store: Store, settings: Settings) -> list[Comparison]:
    """Return the comparisons of visits that hold at the present poses, by whatever recipe, also of pairs that a person
    asked for: exports may act on their changes. Of deformed pairs only the current recipe holds, as another one may
    have compared them without a warp."""
    graph = _poses(store)
    visits = _visits(store, store.scenes.list(), graph)
    dated = (one for one in store.changes.current() if one.older in visits and one.newer in visits)
    found = [
        one
        for one in dated
        if visits[one.older].component == visits[one.newer].component
        and visits[one.older].when < visits[one.newer].when
        and _stands(one, visits)
    ]
    pairs = [(one.older, one.newer) for one in found]
    asked = ComparisonPlan(visits, pairs, (), deformed_pairs(store, settings, graph, pairs))
    return [
        one
        for one, pair in zip(found, pairs, strict=True)
        if pair not in asked.deformed or one.key == _key(settings, asked, *pair).digest
    ]


def compare(
    store: Store, asked: ComparisonPlan, settings: Settings, progress: StageProgress, *, verify: bool = False
) -> int:
    """Compare the pairs that lack a current comparison; return their number.

    Args:
        verify: also read stored comparisons and repeat damaged ones.
    """
    keys = {_key(settings, asked, *pair).digest: pair for pair in asked.pairs}

    def done(wanted_keys: Collection[str]) -> set[str]:
        valid = {one.key: one.number for one in _valid(store.changes.current(), asked, settings)}
        there = {key for key in wanted_keys if key in valid}
        damaged = store.changes.damaged(valid[key] for key in there) if verify else set()
        return {key for key in there if valid[key] not in damaged}

    todo = set(keys) - done(keys)
    jobs = {key: _job(store, asked, settings, keys[key]) for key in keys if key in todo}
    names = {scene.id: scene.name for scene in store.scenes.list()}
    shared = SharedJobs(store, "changes", "comparison", jobs, keys, done, progress, again=verify)
    results = shared.results(lambda arguments: run_jobs(compare_scenes, arguments, settings.engine))
    kept = note_interruption(lambda: f"{shared.num_kept()} of {len(jobs)} pairs are compared and kept")
    with kept, closing(results):
        for key, (report, counted) in results:
            older, newer = (asked.visits[scene] for scene in keys[key])
            found = store.changes.save(
                report,
                _key(settings, asked, older.scene, newer.scene),
                older=older.scene,
                newer=newer.scene,
                S_newer_older=newer.S_map_scene.inverse() @ older.S_map_scene,
                S_frame_newer=newer.S_map_scene,
                num_at_comparison=counted,
            )
            shared.saved(key, f"{names[older.scene]}-{names[newer.scene]}: {len(found.changes)} changes")
    return len(jobs)


def _stands(one: Comparison, visits: Mapping[str, Visit]) -> bool:
    """Return whether a comparison has its arrays, and was made at the present poses."""
    return one.whole and not has_moved(visits[one.older], visits[one.newer], one.S_newer_older)


def _valid(current: Iterable[Comparison], asked: ComparisonPlan, settings: Settings) -> list[Comparison]:
    """Return the comparisons that are up to date."""
    pairs = set(asked.pairs)
    return [
        one
        for one in current
        if (one.older, one.newer) in pairs
        and _stands(one, asked.visits)
        and one.key == _key(settings, asked, one.older, one.newer).digest
    ]


def _key(settings: Settings, asked: ComparisonPlan, older: str, newer: str) -> RecipeKey:
    """Return the key of a pair's comparison, which depends on the metric scale and on what warps the older scene."""
    metres, deformed = asked.visits[newer].metres_per_unit, asked.deformed.get((older, newer))
    inputs = [] if metres == 1.0 else [f"metres_per_unit {metres!r}"]
    inputs += [] if deformed is None else deformed.inputs()
    return change.recipe_key(settings.change).of(older, newer, *inputs)


def _job(store: Store, asked: ComparisonPlan, settings: Settings, pair: tuple[str, str]) -> tuple[object, ...]:
    """Return the arguments of `compare_scenes`."""
    sides = [(visit.scene, visit.S_map_scene, visit.when.isoformat()) for visit in (asked.visits[s] for s in pair)]
    return (store.location, *sides, settings.change, asked.deformed.get(pair))


def _poses(store: Store) -> PoseGraph:
    """Return the newest poses.

    Raises:
        NotFoundError: the map has no poses yet.
    """
    graph = store.revisions.get()
    if graph is None:
        raise NotFoundError(
            "the map has no poses yet, so that nothing can be compared: run gsmap update first", code="no_poses"
        )
    return graph


def _visits(store: Store, scenes: Iterable[Scene], graph: PoseGraph) -> dict[str, Visit]:
    """Return the visits of the scenes that have a date and a pose, by scene id."""
    metres = metres_of_scenes(store, graph)
    return {
        scene.id: Visit(
            scene.id,
            parse_moment(scene.captured_at),
            pose.component,
            in_metres(pose.S_map_scene, metres[scene.id]),
            scene.bounds,
            metres[scene.id],
        )
        for scene in scenes
        if scene.captured_at is not None and (pose := graph.poses.get(scene.id)) is not None
    }


def _names(names: Sequence[str]) -> str:
    """Return names with the matching form of ``have``."""
    shown = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    return f"{shown} {'has' if len(names) == 1 else 'have'}"


def compare_scenes(
    path: str,
    older: tuple[str, Sim3, str],
    newer: tuple[str, Sim3, str],
    params: change.Params,
    deformed: DeformedPair | None = None,
) -> tuple[ChangeReport, tuple[int, int]]:
    """Compare two scenes of the map at ``path``; return the changes and the number of Gaussians of each.

    Args:
        older, newer: scene id, S_map_scene and date.
        deformed: the older scene is warped onto the newer one, unless it fits without a warp.
    """
    notes, warp, S_map_older = tuple[str, ...](), None, older[1]
    if deformed is not None:
        store = store_of(path)
        fitted = deformed.fit(store, newer[0], older[0], newer[1].inverse() @ S_map_older)
        if fitted is None:
            return ChangeReport((), 0.0, np.ones(3), (_NOT_COMPARED,)), (0, 0)
        S_newer_older, warp = fitted
        S_map_older = newer[1] @ S_newer_older
        if warp is not None:
            name = store.scenes.get(older[0]).name
            notes = (f"no rigid pose aligns all of both captures: {name} is warped onto the other to compare them",)
    before, after = _posed(path, older[0], S_map_older, older[2], warp), _posed(path, *newer)
    report = change.compare(before, after, params)
    return replace(report, notes=(*notes, *report.notes)), (len(before.gaussians), len(after.gaussians))


def _posed(path: str, scene_id: str, S_map_scene: Sim3, captured_at: str, warp: Warp | None = None) -> PosedScene:
    """Return a scene in the map frame, in the shape that a warp gives it, with its view-independent colour, which is
    all that comparisons use."""
    scenes = store_of(path).scenes
    gaussians, cameras = scenes.unread(scene_id).degree_0(), scenes.cameras(scene_id)
    if warp is not None:
        gaussians, cameras = warp_gaussians(gaussians, warp), warp_cameras(cameras, warp)
    return PosedScene(
        transform_gaussians(gaussians, S_map_scene), transform_cameras(cameras, S_map_scene), scene_id, captured_at
    )
