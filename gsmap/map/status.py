"""List the missing and stale results of a map, and the decisions that a person has to make."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.map.metric_scales import map_metres
from gsmap.map.reports.one_pair import is_one_pair, scenes_by_one_pair
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.stages.describe import graph_keys, unthinned, without_graph
from gsmap.map.stages.optimize import pose_basis
from gsmap.map.stages.register import num_stale
from gsmap.register.duplicate import SAME_CAPTURE
from gsmap.store import Store
from gsmap.store.leases import Lease
from gsmap.store.quarantine import CAPTURE
from gsmap.types import PoseGraph
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.leases import LeaseRow
from gsmap.types.rows.maps import MapStatus, MetricScaleRow, TodoKind, TodoRow

if TYPE_CHECKING:
    from gsmap.map.stages.export import FindOmitted


@snapshot_read
def status(
    store: Store, settings: Settings, num_open_changes: Callable[[Store, Settings], int], find_omitted: FindOmitted
) -> MapStatus:
    """Report the status of a map (``gsmap status MAP``) from the catalog. Nothing is computed but the warps of
    exports that were made with ``--nonrigid``.

    Args:
        num_open_changes: returns the number of unreviewed changes.
        find_omitted: see `gsmap.map.stages.export.plan`.
    """
    at = shlex.quote(store.location)
    update = f"gsmap update {at} --no-create"
    scenes = store.scenes.summaries()
    newest, graph = store.revisions.newest(), PoseGraph(store.revisions.poses(), world=store.revisions.world())
    todo: list[TodoRow] = []

    def add(what: TodoKind, count: int, verb: str, meaning: str) -> None:
        if count:
            todo.append(TodoRow(what=what, count=count, verb=verb, meaning=meaning))

    keys = graph_keys(store, unthinned(scenes), settings)
    living = {scene.id for scene in scenes}
    lacking = without_graph(store, keys)
    bare = set(lacking) - (set(store.graphs.node_counts()) if lacking else set())
    add("undescribed", len(bare), update, "scenes without a graph")
    add(
        "stale_graphs",
        len(lacking) - len(bare),
        update,
        "graphs made by other settings or another version",
    )
    pairs = store.registrations.current_keys()
    registered = {scene for pair, _ in pairs if living.issuperset(ends := pair.split(":")) for scene in ends}
    unregistered = living - registered if len(scenes) > 1 else set[str]()
    if unregistered:
        counts = store.graphs.node_counts()
        unregistered = {scene for scene in unregistered if counts.get(scene) != 0}  # without nodes no pair is proposed
    add(
        "unregistered",
        len(unregistered),
        update,
        "scenes that were never registered with another",
    )
    add(
        "stale_edges",
        num_stale(pairs, keys, settings),
        update,
        "edges made by other settings or versions",
    )
    _add_unsolved(store, settings, add, f"gsmap optimize {at}")
    if store.exports.targets():
        from gsmap.map.stages.export import dirty_tiles  # with merging, which a map that nobody exported does without

        for target, (count, request) in dirty_tiles(store, settings, find_omitted).items():
            verb = " ".join(["gsmap export", at, shlex.quote(target), *request.options()])
            add("dirty_tiles", count, verb, f"tiles in {target} that are out of date")
    poses = [pose for scene, pose in graph.poses.items() if scene in living]
    tentative = [pose for pose in poses if pose.status == "tentative"]
    alone = scenes_by_one_pair(store) if tentative else set()
    held = store.revisions.tentative() if tentative else {}
    pairs_of = {
        one_pair: [pair for pair, edge in held.items() if living.issuperset(pair) and is_one_pair(edge) == one_pair]
        for one_pair in (True, False)
    }
    in_doubt = [pose for pose in tentative if pose.scene not in alone]
    add("tentative", len(in_doubt), _look(store, pairs_of[False] or pairs_of[True]), "scenes placed by a doubtful edge")
    by_one = len(tentative) - len(in_doubt)
    add("one_pair", by_one, _look(store, pairs_of[True]), "scenes placed by one pair, which nothing contradicts")
    judged = store.revisions.undecided(newest.number).get(newest.number, []) if newest else []
    undecided = [pair for pair in judged if living.issuperset(pair)]
    add("undecided", len(undecided), _look(store, undecided), "undecided edges: confirm or reject them")
    todo += quarantined_rows(store)
    add("changes", num_open_changes(store, settings), f"gsmap changes {at}", "unreviewed changes")
    outweighed = [scene for scene in (newest.provenance.contradicted_priors if newest else ()) if scene in living]
    add("contradicted_priors", len(outweighed), f"gsmap prior {at} SCENE", "priors that contradict the edges")
    contrary = sum(row.use == "outlier" for tie in graph.world for row in tie.residuals)
    add(
        "world_outliers",
        contrary,
        f"gsmap georeference {at}",
        "observations of the world that contradict other observations",
    )
    untied = sum(bool(tie.problem) for tie in graph.world)
    add("untied", untied, f"gsmap georeference {at}", "components that are not georeferenced")
    twice = store.registrations.current_with_note(SAME_CAPTURE)
    add(
        "duplicates",
        len(twice),
        f"gsmap list {at} edges",
        "pairs of scenes from the same capture: remove one scene of each pair",
    )
    isolated = [pose for pose in poses if pose.status == "isolated"]
    add("isolated", len(isolated), f"gsmap list {at} scenes --status isolated", "scenes without edges to others")
    metres = map_metres(store, graph)
    components = len({pose.component for pose in poses})
    return MapStatus(
        todo=tuple(todo),
        scenes=len(scenes),
        components=components,
        islands=components,
        tentative=len(tentative),
        one_pair=by_one,
        revision=newest.number if newest else None,
        metres_per_unit=next((one.metres_per_unit for one in metres.values() if one.is_known), None),
        metres=tuple(metre_row(component, one) for component, one in metres.items()),
        at_work=lease_rows(store.leases.others()),
    )


def _look(store: Store, pairs: Sequence[tuple[str, str]]) -> str:
    """Return the command to review some pairs of scenes (ids)."""
    at = shlex.quote(store.location)
    if len(pairs) != 1:
        return f"gsmap view {at}"
    target, source = (store.scenes.get(scene).name for scene in pairs[0])
    return f"gsmap why {at} {shlex.quote(f'{target}:{source}')}"


def quarantined_rows(store: Store) -> list[TodoRow]:
    """Return one row per quarantined job or capture, with the command to retry it."""
    aside = store.quarantine.list()
    at, names = shlex.quote(store.location), store.scenes.names() if aside else {}
    rows = []
    for one in aside:
        kind = one.what.partition(" ")[0]
        if kind == CAPTURE:
            verb, about = f"gsmap update {at} --no-create {shlex.quote(one.about)}", Path(one.about).name
        elif kind == "tile":
            verb, about = f"gsmap export {at} {shlex.quote(one.about)}", f"a tile in {one.about}"
        else:
            scenes = [names[scene] for scene in one.about.split() if scene in names]
            if len(scenes) != len(one.about.split()) or kind not in _TRIES_AGAIN:
                continue  # of a scene that was removed
            about = ":".join(scenes)
            verb = f"gsmap {_TRIES_AGAIN[kind]} {at} {shlex.quote(about)}"
        rows.append(TodoRow(what="set_aside", count=1, verb=verb, meaning=f"{about} is quarantined: {one.reason}"))
    return rows


_TRIES_AGAIN = {"graph": "describe", "edge": "register", "comparison": "changes"}


def lease_rows(leases: Sequence[Lease]) -> tuple[LeaseRow, ...]:
    """Return the running processes as rows."""
    return tuple(
        LeaseRow(what=one.what, task=one.task, host=one.host, process=one.pid, since=one.since) for one in leases
    )


def _add_unsolved(store: Store, settings: Settings, add: Callable[[TodoKind, int, str, str], None], verb: str) -> None:
    """Add an entry with the reason if the newest poses are out of date."""
    given = pose_basis(store, settings)
    newest = store.revisions.newest()
    if not given.scenes or (newest is not None and newest.key == given.key.digest):
        return
    if newest is not None and newest.recipe not in (None, given.key.recipe):  # poses that a merge joined have none
        add("stale_poses", 1, verb, "poses solved by other settings or another version")
    else:
        add("unsolved", 1, verb, "scenes, edges, reviews, priors or observations newer than the poses")


def metre_row(component: int, metre: MetricScale) -> MetricScaleRow:
    """Return the metric scale of a component as a row."""
    return MetricScaleRow(
        component=component,
        metres_per_unit=metre.metres_per_unit,
        metre_sigma=metre.sigma if metre.is_known else None,
        metre_known_by=metre.known_by,
        metre_note=metre.note,
    )
