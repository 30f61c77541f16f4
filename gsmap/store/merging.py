"""Merge maps, split maps, and import scenes from other maps."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, func, select

from gsmap.errors import CorruptError, NotFoundError
from gsmap.settings import FILE_NAME, load
from gsmap.store.array_groups import manifest
from gsmap.store.pose_graph_join import join_pose_graphs, restrict_pose_graph
from gsmap.store.revisions import insert_revision, newest_poses, stored_rows
from gsmap.store.scenes import KIND as SCENES
from gsmap.store.schema import about, revisions, scenes
from gsmap.store.store import Store
from gsmap.store.transfer import Transfer, open_transfer
from gsmap.store.transfer_changes import transfer_comparisons
from gsmap.store.transfer_objects import transfer_objects
from gsmap.types.rows.map_operations import MergeReport

Identity = tuple[str, int, str | None]


def merge(into: Store, source: Store) -> MergeReport:
    """Merge another map into this map without computing anything; a repeated merge adds nothing.

    Scenes with equal content are the same scene. Revisions are copied as history (`revisions.origin` names the map that
    solved them), followed by one revision that joins the newest poses of both maps (`gsmap.store.pose_graph_join`).
    Where this map's newest poses are part of the other map's history, the other map's newest are used as they are.

    Raises:
        ConfigError: a map into itself.
        CorruptError: arrays of the other map are missing or damaged; nothing was changed.
    """
    with open_transfer(into, source) as transfer:
        transfer.scenes()
        _copy_results(transfer)
        transfer.models()
        number = _revisions(transfer)
        transfer.notes += _compare_settings(into, source)
        return _report(transfer, number)


def split(source: Store, out: Store, chosen: Collection[str]) -> MergeReport:
    """Copy some scenes of a map to a new and empty map, with all data about these scenes and their pairs.

    The newest poses are copied, restricted to these scenes, as revision 1.

    Raises:
        CorruptError: arrays of the map are missing or damaged; nothing was changed.
    """
    with open_transfer(out, source, only=chosen) as transfer:
        transfer.scenes()
        _copy_results(transfer)
        transfer.models()
        number = None
        newest = newest_poses(transfer.theirs)
        if newest is not None and set(newest.poses) & set(chosen):
            number = out.revisions.save(restrict_pose_graph(newest, chosen), note=f"part of {source.location}")
            row = transfer.theirs.execute(select(revisions).order_by(revisions.c.number.desc()).limit(1)).one()
            map_id, its_number, part = _identity(row, _id(transfer.theirs))
            origin = {"map": map_id, "number": its_number, "part": part or _id(transfer.ours)}
            transfer.ours.execute(revisions.update().where(revisions.c.number == number).values(origin=origin))
        return _report(transfer, number)


def import_scene(into: Store, source: Store, scene: str) -> MergeReport:
    """Import one scene of another map (by id), with its graphs and its edges to scenes of this map.

    Repairs damaged arrays of a scene that is already in this map.

    Raises:
        NotFoundError: the scene was purged from this map.
        CorruptError: its arrays are missing or damaged there; nothing was changed.
    """
    with open_transfer(into, source, only={scene}, mend=True) as transfer:
        if scene not in transfer.wanted:
            raise NotFoundError(
                f"scene {scene} was purged from {into.location}, so it is not copied: ingest its capture to add "
                "it again",
                code="scene_removed",
            )
        transfer.scenes()
        if into.home.samefile(source.home):
            _check_shared(transfer, scene)
        if into.scenes.removed_at(scene) is not None:  # an explicit request overrules the tombstone
            into.scenes.restore(scene)
        _copy_results(transfer)
        return replace(_report(transfer, None), notes=())


def _copy_results(transfer: Transfer) -> None:
    """Copy what the other map has computed from, and recorded about, the copied scenes."""
    transfer.results()
    transfer.pairs()
    transfer_comparisons(transfer)
    transfer_objects(transfer)
    transfer.priors()
    transfer.observations()
    transfer.photos()


def _check_shared(transfer: Transfer, scene: str) -> None:
    """Raise an error for a scene with damaged arrays if both catalogs share the arrays."""
    group = transfer.ours.execute(select(scenes.c.group_id).where(scenes.c.id == scene)).scalar_one()
    if group is None:
        return
    problems = transfer.into.arrays.problems(SCENES, group, manifest(transfer.ours, group))
    if problems:
        raise CorruptError(
            f"the arrays of scene {scene} are damaged here and in {transfer.source.location}: copy them "
            f"from another map or a restored backup ({problems[0]})",
            code="arrays_corrupt",
        )


def _report(transfer: Transfer, revision: int | None) -> MergeReport:
    nouns = [field.name.removeprefix("num_") for field in fields(MergeReport) if field.name.startswith("num_")]
    return MergeReport(
        map=transfer.into.location,
        from_map=transfer.source.location,
        renamed=dict(transfer.renamed),
        revision=revision,
        notes=tuple(dict.fromkeys(transfer.notes)),
        **{f"num_{noun}": transfer.counts[noun] for noun in nouns},
    )


# --- revisions -------------------------------------------------------------------------------------------------------


def _revisions(transfer: Transfer) -> int | None:
    """Copy the other map's revisions as history, and join the newest poses in a new revision; return its number."""
    ours, theirs = transfer.ours, transfer.theirs
    my_id, their_id = _id(ours), _id(theirs)
    mine, newest = newest_poses(ours), newest_poses(theirs)
    rows = ours.execute(select(revisions).order_by(revisions.c.number)).all()
    known = {_identity(row, my_id) for row in rows}
    their_rows = theirs.execute(select(revisions).order_by(revisions.c.number)).all()
    lacking = [row for row in their_rows if not _is_known(_identity(row, their_id), known)]
    for row in lacking:
        transfer.recipe(row.recipe)
        _append(transfer, row, _identity(row, their_id))
    transfer.counts["revisions"] = len(lacking)
    if not lacking or mine is None or newest is None:
        return None
    history = {_identity(row, their_id) for row in their_rows}
    if their_rows[-1].number == lacking[-1].number and _is_known(_identity(rows[-1], my_id), history):
        return None  # our newest revision is part of their history, so theirs continues it
    living = {row.id: np.array(row.bounds) for row in ours.execute(select(scenes).where(scenes.c.removed_at.is_(None)))}
    joint = join_pose_graphs(mine, newest, living, living)
    transfer.notes += joint.notes
    return transfer.into.revisions.save(joint, note=f"joined with {transfer.source.location}")


def _append(transfer: Transfer, row: Row[Any], identity: Identity) -> None:
    number = 1 + (transfer.ours.execute(select(func.max(revisions.c.number))).scalar() or 0)
    map_id, its_number, part = identity
    origin = {"map": map_id, "number": its_number, **({"part": part} if part else {})}
    here = set(transfer.ours.execute(select(scenes.c.id)).scalars())  # without purged scenes
    lines = stored_rows(transfer.theirs, row)
    if lines is not None:
        lines = {name: {k: v for k, v in of_table.items() if here.issuperset(k)} for name, of_table in lines.items()}
    insert_revision(transfer.ours, dict(row._mapping) | {"number": number, "origin": origin}, lines)


def _identity(row: Row[Any], map_id: str) -> Identity:
    """Return an identity of a revision that all maps share: the map that solved it, its number there, and its part."""
    if row.origin is None:
        return map_id, row.number, None
    return str(row.origin["map"]), int(row.origin["number"]), row.origin.get("part")


def _is_known(identity: Identity, known: Collection[Identity]) -> bool:
    """Return True if a revision is known, or if it is a part of a known revision."""
    return identity in known or (*identity[:2], None) in known


def _id(connection: Connection) -> str:
    return str(connection.execute(select(about.c.id)).scalar_one())


# --- settings --------------------------------------------------------------------------------------------------------


def _compare_settings(into: Store, source: Store) -> list[str]:
    """Return a note for each setting that differs between the maps; the target map keeps its settings."""
    mine, theirs = load(into.folder / FILE_NAME), load(source.folder / FILE_NAME)
    return [
        f"setting {name} stays {_format_setting(mine, name)} (in the other map: {_format_setting(theirs, name)}): "
        "results of the other map that depend on it are stale here"
        for name in sorted({*mine, *theirs})
        if mine.get(name) != theirs.get(name)
    ]


def _format_setting(values: Mapping[str, Any], name: str) -> str:
    return str(values[name]) if name in values else "its default"
