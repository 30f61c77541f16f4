"""Maps as values: one merged into another, part of one as a map of its own, a scene brought back."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, func, select

from gsmap.errors import CorruptError, NotFoundError
from gsmap.settings import FILE_NAME, load
from gsmap.store.groups import manifest
from gsmap.store.joint import joined, restricted
from gsmap.store.revisions import newest_poses, put, stored_lines
from gsmap.store.scenes import KIND as SCENES
from gsmap.store.schema import about, revisions, scenes
from gsmap.store.store import Store
from gsmap.store.transfer import Transfer, between
from gsmap.store.transfer_changes import comparisons_of
from gsmap.store.transfer_objects import objects_of

Identity = tuple[str, int, str | None]


@dataclass(frozen=True)
class Merged:
    """What a merge brought.

    Args:
        scenes, removed, known: scenes that are new here and live, that are new or now removed, and that both maps had.
        graphs, registrations, reviews, facts, priors, observations, photos, models, recipes, revisions, comparisons,
            change_reviews, objects, object_facts: rows that are new here.
        renamed: (old, new) names of scenes whose name was taken.
        revision: number of the joint revision; None where none was needed.
        num_bytes: of the arrays that are new here, linked or copied.
        notes: what a person should know.
    """

    scenes: int = 0
    removed: int = 0
    known: int = 0
    graphs: int = 0
    registrations: int = 0
    reviews: int = 0
    facts: int = 0
    priors: int = 0
    observations: int = 0
    photos: int = 0
    models: int = 0
    recipes: int = 0
    revisions: int = 0
    comparisons: int = 0
    change_reviews: int = 0
    objects: int = 0
    object_facts: int = 0
    renamed: tuple[tuple[str, str], ...] = ()
    revision: int | None = None
    num_bytes: int = 0
    notes: tuple[str, ...] = field(default=())


def merge(into: Store, source: Store) -> Merged:
    """Take all that another map knows; that map stays as it is, and nothing is computed. Again it adds nothing.

    Scenes are the same where their content is. Revisions travel as history (`revisions.origin` says which map solved
    them), followed by one revision of the newest poses of both, as `gsmap.store.joint` puts them together; where this
    map's newest poses are part of the other's history, the other's newest count as they are.

    Raises:
        ConfigError: a map into itself.
        CorruptError: arrays of the other map are missing or damaged; nothing was changed.
    """
    with between(into, source) as transfer:
        transfer.scenes()
        transfer.graphs()
        transfer.pairs()
        comparisons_of(transfer)
        objects_of(transfer)
        transfer.priors()
        transfer.observations()
        transfer.photos()
        transfer.models()
        number = _revisions(transfer)
        transfer.notes += _other_settings(into, source)
        return _merged(transfer, number)


def split(source: Store, out: Store, chosen: Collection[str]) -> Merged:
    """Bring some scenes of a map, with all that is known of and among them, into a map that is new and empty.

    Of the history the newest poses come along, restricted to these scenes, as revision 1.

    Raises:
        CorruptError: arrays of the map are missing or damaged; nothing was changed.
    """
    with between(out, source, only=chosen) as transfer:
        transfer.scenes()
        transfer.graphs()
        transfer.pairs()
        comparisons_of(transfer)
        objects_of(transfer)
        transfer.priors()
        transfer.observations()
        transfer.photos()
        transfer.models()
        number = None
        newest = newest_poses(transfer.theirs)
        if newest is not None and set(newest.poses) & set(chosen):
            number = out.revisions.save(restricted(newest, chosen), note=f"part of {source.location}")
            row = transfer.theirs.execute(select(revisions).order_by(revisions.c.number.desc()).limit(1)).one()
            map_id, its_number, part = _identity(row, _id(transfer.theirs))
            origin = {"map": map_id, "number": its_number, "part": part or _id(transfer.ours)}
            transfer.ours.execute(revisions.update().where(revisions.c.number == number).values(origin=origin))
        return _merged(transfer, number)


def bring_scene(into: Store, source: Store, scene: str) -> Merged:
    """Bring one scene of another map (by id), its graphs, and its edges to scenes that are here.

    Where it is here already, arrays of it that are damaged are mended.

    Raises:
        NotFoundError: it was forgotten here on demand.
        CorruptError: its arrays are missing or damaged there; nothing was changed.
    """
    with between(into, source, only={scene}, mend=True) as transfer:
        if scene not in transfer.wanted:
            raise NotFoundError(
                f"scene {scene} was forgotten in {into.location} on demand: ingest its capture if it is to come back",
                code="scene_removed",
            )
        transfer.scenes()
        if into.home.samefile(source.home):
            _check_shared(transfer, scene)
        if into.scenes.removed_at(scene) is not None:  # whatever was said before: it is asked for now
            into.scenes.restore(scene)
        transfer.graphs()
        transfer.pairs()
        comparisons_of(transfer)
        objects_of(transfer)
        transfer.priors()
        transfer.observations()
        transfer.photos()
        return replace(_merged(transfer, None), notes=())


def _check_shared(transfer: Transfer, scene: str) -> None:
    """Refuse a scene whose arrays are damaged, where both catalogs are of one map and there are no others."""
    group = transfer.ours.execute(select(scenes.c.group_id).where(scenes.c.id == scene)).scalar_one()
    if group is None:
        return
    problems = transfer.into.arrays.problems(SCENES, group, manifest(transfer.ours, group))
    if problems:
        raise CorruptError(
            f"the arrays of scene {scene} are damaged, and {transfer.source.location} has the very same: bring them "
            f"from another map or a restored backup ({problems[0]})",
            code="arrays_corrupt",
        )


def _merged(transfer: Transfer, revision: int | None) -> Merged:
    counted = {field.name for field in fields(Merged) if field.type == "int"} - {"num_bytes"}
    return Merged(
        **{noun: transfer.counts[noun] for noun in counted},
        renamed=tuple(transfer.renamed),
        revision=revision,
        num_bytes=transfer.counts["bytes"],
        notes=tuple(dict.fromkeys(transfer.notes)),
    )


# --- revisions -------------------------------------------------------------------------------------------------------


def _revisions(transfer: Transfer) -> int | None:
    """Their revisions as history, and then one of the newest poses of both; its number, None where none is needed."""
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
        return None  # ours is part of their history: theirs is what comes after it
    living = {row.id: np.array(row.bounds) for row in ours.execute(select(scenes).where(scenes.c.removed_at.is_(None)))}
    joint = joined(mine, newest, living, living)
    transfer.notes += joint.notes
    return transfer.into.revisions.save(joint, note=f"joined with {transfer.source.location}")


def _append(transfer: Transfer, row: Row[Any], identity: Identity) -> None:
    number = 1 + (transfer.ours.execute(select(func.max(revisions.c.number))).scalar() or 0)
    map_id, its_number, part = identity
    origin = {"map": map_id, "number": its_number, **({"part": part} if part else {})}
    here = set(transfer.ours.execute(select(scenes.c.id)).scalars())  # all but those that were forgotten
    lines = stored_lines(transfer.theirs, row)
    if lines is not None:
        lines = {name: {k: v for k, v in of_table.items() if here.issuperset(k)} for name, of_table in lines.items()}
    put(transfer.ours, dict(row._mapping) | {"number": number, "origin": origin}, lines)


def _identity(row: Row[Any], map_id: str) -> Identity:
    """What a revision is called in whichever map it lies: the map that solved it, its number there, and which part."""
    if row.origin is None:
        return map_id, row.number, None
    return str(row.origin["map"]), int(row.origin["number"]), row.origin.get("part")


def _is_known(identity: Identity, known: Collection[Identity]) -> bool:
    """Whether a revision, or the whole of which it is a part, is among those that are known."""
    return identity in known or (*identity[:2], None) in known


def _id(connection: Connection) -> str:
    return str(connection.execute(select(about.c.id)).scalar_one())


# --- settings --------------------------------------------------------------------------------------------------------


def _other_settings(into: Store, source: Store) -> list[str]:
    """A note on each setting that differs; those of the map that is merged into hold."""
    mine, theirs = load(into.folder / FILE_NAME), load(source.folder / FILE_NAME)
    return [
        f"setting {name} stays {_shown(mine, name)} (there: {_shown(theirs, name)}): what that made is out of date here"
        for name in sorted({*mine, *theirs})
        if mine.get(name) != theirs.get(name)
    ]


def _shown(values: Mapping[str, Any], name: str) -> str:
    return str(values[name]) if name in values else "its default"
