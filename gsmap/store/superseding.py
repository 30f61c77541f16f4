"""A scene in the place of another: what is known of the one and holds for the other."""

from __future__ import annotations

from dataclasses import replace

from sqlalchemy import Connection, delete, insert, select, update

from gsmap.store import facts, objects, photos, world
from gsmap.store.change_rows import pair_of
from gsmap.store.schema import comparisons, priors, scene_facts
from gsmap.store.store import Store
from gsmap.store.transfer import in_order
from gsmap.types import PoseGraph


def inherit(store: Store, old: str, new: str) -> None:
    """Let a scene have what was said of another, its prior, its place in the newest poses, and its comparisons.

    Of the comparisons it has the numbers of the changes and the words on them; their arrays are of the other scene's
    Gaussians, so that they count as made by another recipe.

    Args:
        old, new: ids of scenes that share a frame; both are in the map.
    """
    with store.catalog.write() as connection:
        _inherit_facts(connection, old, new)
        standing = (priors.c.scene == old) & priors.c.removed_at.is_(None)
        for row in connection.execute(select(priors).where(standing)).mappings().all():
            content = {column: value for column, value in row.items() if column != "number"}
            connection.execute(insert(priors), content | {"scene": new})
        _inherit_comparisons(connection, old, new)
        world.inherit(connection, old, new)
        photos.inherit(connection, old, new)
        objects.inherit(connection, old, new)
        graph = store.revisions.get()
        if graph is not None and old in graph.poses:
            name = store.scenes.get(old).name
            store.revisions.save(_in_place_of(graph, old, new), note=f"a new capture in the place of {name}")


def _inherit_facts(connection: Connection, old: str, new: str) -> None:
    """All that was said of either, in the order of time."""
    said = facts.said(connection, old), facts.said(connection, new)
    rows = [
        {"scene": new, "kind": one.kind, "value": one.value, "author": one.author, "created_at": one.created_at}
        for one in in_order(*said, time=lambda fact: fact.created_at)
    ]
    connection.execute(delete(scene_facts).where(scene_facts.c.scene == new))
    if rows:
        connection.execute(insert(scene_facts), rows)


def _inherit_comparisons(connection: Connection, old: str, new: str) -> None:
    of_old = (comparisons.c.older == old) | (comparisons.c.newer == old)
    for row in connection.execute(select(comparisons).where(of_old)).all():
        if new in (row.older, row.newer):
            continue  # of the two with each other, when both were in the map: it stays theirs
        older, newer = (new if scene == old else scene for scene in (row.older, row.newer))
        values = {"older": older, "newer": newer, "pair": pair_of(older, newer), "group_id": None}
        connection.execute(update(comparisons).where(comparisons.c.number == row.number).values(**values))


def _in_place_of(graph: PoseGraph, old: str, new: str) -> PoseGraph:
    """The poses with the one scene where the other was; what became of the other's edges is not known of the new."""
    poses = {scene: pose for scene, pose in graph.poses.items() if scene != old}
    poses[new] = replace(graph.poses[old], scene=new)
    outcomes = {pair: outcome for pair, outcome in graph.outcomes.items() if old not in pair}
    outweighed = tuple(new if scene == old else scene for scene in graph.provenance.contradicted_priors)
    provenance = replace(graph.provenance, contradicted_priors=outweighed)
    return replace(graph, poses=poses, outcomes=outcomes, provenance=provenance)
