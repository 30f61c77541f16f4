"""Transfer the data of a superseded scene to the scene that replaces it."""

from __future__ import annotations

from dataclasses import replace

from sqlalchemy import Connection, delete, insert, select, update

from gsmap.store import facts, objects, photos, world
from gsmap.store.change_rows import pair_of
from gsmap.store.schema import comparisons, priors, scene_facts
from gsmap.store.store import Store
from gsmap.store.transfer import merge_by_time
from gsmap.types import PoseGraph


def inherit(store: Store, old: str, new: str) -> None:
    """Copy the facts, prior, newest pose, observations, photos, objects and comparisons of a scene to its replacement.

    Comparisons bring the numbers of changes and their reviews; their arrays refer to the old scene's Gaussians, so that
    they are stale.

    Args:
        old, new: ids of scenes in the map that share a frame.
    """
    with store.catalog.write() as connection:
        _inherit_facts(connection, old, new)
        # Where the new content was superseded before, and returns, what held for it then holds no longer.
        store.priors.retire(connection, new)
        current = (priors.c.scene == old) & priors.c.removed_at.is_(None)
        for row in connection.execute(select(priors).where(current)).mappings().all():
            content = {column: value for column, value in row.items() if column != "number"}
            connection.execute(insert(priors), content | {"scene": new})
        _inherit_comparisons(connection, old, new)
        world.inherit(connection, old, new)
        photos.inherit(connection, old, new)
        objects.inherit(connection, old, new)
        graph = store.revisions.get()
        if graph is not None and old in graph.poses:
            name = store.scenes.get(old).name
            store.revisions.save(_in_place_of(graph, old, new), note=f"a new capture replaces {name}")


def _inherit_facts(connection: Connection, old: str, new: str) -> None:
    """Merge the facts of both scenes in the order of time; those that both have are one."""
    both = facts.list_facts(connection, old), facts.list_facts(connection, new)
    merged = merge_by_time(*both, time=lambda fact: fact.created_at)
    once = dict.fromkeys((one.kind, one.value, one.author, one.created_at) for one in merged)
    rows = [
        {"scene": new, "kind": kind, "value": value, "author": author, "created_at": created_at}
        for kind, value, author, created_at in once
    ]
    connection.execute(delete(scene_facts).where(scene_facts.c.scene == new))
    if rows:
        connection.execute(insert(scene_facts), rows)


def _inherit_comparisons(connection: Connection, old: str, new: str) -> None:
    of_old = (comparisons.c.older == old) | (comparisons.c.newer == old)
    for row in connection.execute(select(comparisons).where(of_old)).all():
        if new in (row.older, row.newer):
            continue  # a comparison of the two scenes with each other stays
        older, newer = (new if scene == old else scene for scene in (row.older, row.newer))
        values = {"older": older, "newer": newer, "pair": pair_of(older, newer), "group_id": None}
        connection.execute(update(comparisons).where(comparisons.c.number == row.number).values(**values))


def _in_place_of(graph: PoseGraph, old: str, new: str) -> PoseGraph:
    """Replace a scene in a pose graph; drop its edges, which are unknown for the new scene."""
    poses = {scene: pose for scene, pose in graph.poses.items() if scene != old}
    poses[new] = replace(graph.poses[old], scene=new)
    outcomes = {pair: outcome for pair, outcome in graph.outcomes.items() if old not in pair}
    outweighed = tuple(new if scene == old else scene for scene in graph.provenance.contradicted_priors)
    provenance = replace(graph.provenance, contradicted_priors=outweighed)
    return replace(graph, poses=poses, outcomes=outcomes, provenance=provenance)
