"""Copy scenes with all their data from one map to another, without computing anything."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from sqlalchemy import Connection, Row, Table, delete, insert, select, update

from gsmap.durable import open_file, write_whole
from gsmap.errors import ConfigError, CorruptError, StoreError
from gsmap.store import facts
from gsmap.store.array_groups import forget_derived, has_group, manifest, name, publish
from gsmap.store.arrays import StagedGroup, StoredFile, link_or_copy
from gsmap.store.change_rows import named_groups
from gsmap.store.chunk_boxes import get_boxes, put_boxes
from gsmap.store.models import model_path
from gsmap.store.photos import KIND as PHOTOS
from gsmap.store.result_rows import GRAPHS
from gsmap.store.scene_refs import unused_name
from gsmap.store.scenes import KIND as SCENES
from gsmap.store.schema import (
    FACT_COLUMNS,
    groups,
    models,
    observations,
    photo_sightings,
    priors,
    purges,
    recipes,
    registrations,
    results,
    reviews,
    scene_facts,
    scenes,
)
from gsmap.store.store import Store
from gsmap.types.plain import canonical

Content = dict[str, Any]
Item = TypeVar("Item")
_MERGE = "merge"  # author of names that a merge assigned because the scene's own was in use


@contextlib.contextmanager
def open_transfer(
    into: Store, source: Store, only: Collection[str] | None = None, *, mend: bool = False
) -> Iterator[Transfer]:
    """Open a transaction on ``into``, committed when the block ends, for copying from a snapshot read of ``source``.

    Arrays are linked or copied to the staging folder first, so that the transaction is short.

    Args:
        only: ids of the scenes to copy; None for all, including removed ones.
        mend: also verify the arrays of scenes that ``into`` has, and repair damaged ones.

    Raises:
        ConfigError: both are the same map.
        CorruptError: arrays of the source are missing or damaged; nothing was changed.
    """
    same_home = into.home.samefile(source.home)
    if same_home and into.folder.samefile(source.folder):
        raise ConfigError(
            f"{into.location} and {source.location} are the same map: name two different maps", code="same_map"
        )
    with contextlib.ExitStack() as stack:
        staged: dict[tuple[str, str], StagedGroup] = {}
        damaged: set[str] = set()
        if not same_home:
            with source.arrays.lock():  # groups of this snapshot must not be reclaimed before they are copied
                theirs = stack.enter_context(source.catalog.read())
                with into.catalog.read() as ours:
                    missing, derived = _missing_groups(into, ours, theirs, only, mend)
                try:
                    staged = stack.enter_context(into.arrays.stage_copies(source.arrays, missing))
                except CorruptError:
                    lost = {group for group in derived if source.arrays.problems(*group, missing[group])}
                    if not lost:
                        raise
                    damaged = {group for _, group in lost}
                    sound = {group: files for group, files in missing.items() if group not in lost}
                    staged = stack.enter_context(into.arrays.stage_copies(source.arrays, sound))
        ours = stack.enter_context(into.catalog.write())
        into.catalog.hold_until_commit(into.arrays.lock())
        if same_home:
            theirs = stack.enter_context(source.catalog.read())
        made = Transfer(into, source, ours, theirs, only, None if same_home else staged, damaged)
        if damaged:
            made.notes.append(f"{len(damaged)} damaged results are not copied: gsmap computes them again")
        yield made


class Transfer:
    """The state of copying scenes between maps; see `open_transfer`.

    Attributes:
        counts: numbers of new rows, by noun.
        notes: remarks for the user.
        renamed: (old, new) names of scenes whose name was in use.
    """

    def __init__(
        self,
        into: Store,
        source: Store,
        ours: Connection,
        theirs: Connection,
        only: Collection[str] | None,
        staged: dict[tuple[str, str], StagedGroup] | None,
        damaged: Collection[str],
    ) -> None:
        self.into, self.source = into, source
        self.ours, self.theirs = ours, theirs
        self.counts: Counter[str] = Counter()
        self.notes: list[str] = []
        self.renamed: list[tuple[str, str]] = []
        self._staged = staged
        self._damaged = damaged  # groups of the other map that are computed again, so they are not copied
        self._is_whole_map = only is None
        rows = theirs.execute(select(scenes).order_by(scenes.c.number)).all()
        self._rows = [row for row in rows if only is None or row.id in only]
        self._forgotten = _forgotten(ours) & {row.id for row in self._rows}
        self.wanted = {row.id for row in self._rows} - self._forgotten

    # --- scenes ------------------------------------------------------------------------------------------------------

    def scenes(self) -> None:
        """Copy scenes, facts, arrays and chunk boxes; for a scene in both maps, the later facts are in force."""
        for scene in sorted(self._forgotten):
            self.notes.append(f"scene {scene} was purged from this map, so it is not copied")
        for row in self._rows:
            if row.id in self._forgotten:
                continue
            mine = self.ours.execute(select(scenes).where(scenes.c.id == row.id)).first()
            if mine is None or mine.group_id in (None, row.group_id) or mine.thinned is not None:
                self.transfer_group(SCENES, row.group_id)
            if mine is None:
                self._add_scene(row)
                self._join_facts(row.id, arrives=True)
            else:
                self._join_facts(row.id, arrives=self._merge_scene(mine, row))

    def _add_scene(self, row: Row[Any]) -> None:
        content = _content(row)
        if row.removed_at is None:
            content["name"] = self._unused_name(row.name)
        number = self.ours.execute(insert(scenes).returning(scenes.c.number), content).scalar_one()
        self._copy_boxes(row, number)
        self.counts["scenes" if row.removed_at is None else "removed"] += 1

    def _merge_scene(self, mine: Row[Any], row: Row[Any]) -> bool:
        """Merge a scene that both maps have; its latest ingest or removal decides whether it is removed.

        Returns True if it is restored.
        """
        self.counts["known"] += 1
        values: Content = {}
        if mine.group_id is None and row.group_id is not None:
            values |= _kept(row)
            self._copy_boxes(row, mine.number)
        elif mine.thinned is not None and row.group_id is not None and row.thinned is None:
            values |= _kept(row)
            self._copy_boxes(row, mine.number)
            forget_derived(self.ours, mine.id)  # computed from the compact Gaussians, which have other rows
            self.notes.append(f"scene {mine.name} has all Gaussians again: it was thinned in this map only")
        returns = mine.removed_at is not None and row.removed_at is None and row.ingested_at > mine.removed_at
        leaves = mine.removed_at is None and row.removed_at is not None and row.removed_at > mine.ingested_at
        if returns:
            values |= {"removed_at": None, "ingested_at": row.ingested_at, "name": self._unused_name(row.name)}
            self.counts["scenes"] += 1
            self.notes.append(
                f"scene {row.name} is restored: it was ingested in the other map after it was removed here"
            )
        elif leaves:
            values["removed_at"] = row.removed_at
            self.counts["removed"] += 1
            self.notes.append(
                f"scene {mine.name} is removed: it was removed from the other map after it was ingested here"
            )
        elif mine.removed_at is not None and row.removed_at is None:
            self.notes.append(
                f"scene {mine.name} stays removed: it was removed here after it was ingested in the other map"
            )
        if mine.scale_policy != row.scale_policy:
            self.notes.append(
                f"scene {mine.name} keeps the scale policy {mine.scale_policy} (in the other map: {row.scale_policy})"
            )
        if values:
            self.ours.execute(update(scenes).where(scenes.c.id == mine.id).values(**values))
        return returns

    def _join_facts(self, scene: str, *, arrives: bool) -> None:
        """Merge the facts about a scene from both maps in the order of time.

        Args:
            arrives: the scene is copied with its name and date; otherwise these change only if the other map has later
                facts.
        """
        query = select(scene_facts).where(scene_facts.c.scene == scene).order_by(scene_facts.c.number)
        mine = [_content(row) for row in self.ours.execute(query)]
        theirs = [_content(row) for row in self.theirs.execute(query)]
        known = {canonical(fact) for fact in mine}
        joined = merge_by_time(mine, theirs, time=_time, is_new=lambda fact: canonical(fact) not in known)
        if len(joined) > len(mine):
            self.counts["facts"] += len(joined) - len(mine)
            self.ours.execute(delete(scene_facts).where(scene_facts.c.scene == scene))
            self.ours.execute(insert(scene_facts), joined)
            if not arrives:
                self._adopt_later_facts(scene, mine, theirs)
        row = self.ours.execute(select(scenes).where(scenes.c.id == scene)).one()
        names = [row.value for row in self.ours.execute(query) if row.kind == "name"]
        if row.removed_at is None and names and names[-1] != row.name:
            facts.add_facts(self.ours, scene, [("name", row.name)], _MERGE)

    def _adopt_later_facts(self, scene: str, mine: Sequence[Content], theirs: Sequence[Content]) -> None:
        """Update the columns of a scene that facts change, such as its name, if the other map has later facts.

        Names and dates from its files at its ingest there are not later facts.
        """
        arrived_at = min(fact["created_at"] for fact in theirs)
        values: Content = {}
        for kind in FACT_COLUMNS:
            here, there = (
                [(when, fact) for when, fact in timed(side, _time) if fact["kind"] == kind and fact["author"] != _MERGE]
                for side in (mine, theirs)
            )
            new = [(when, fact) for when, fact in there if fact not in mine]
            if not new or (here and not (new[-1][0] >= here[-1][0] and new[-1][0] > arrived_at)):
                continue
            values[kind] = new[-1][1]["value"] or None
        row = self.ours.execute(select(scenes).where(scenes.c.id == scene)).one()
        if values.get("name", row.name) == row.name or row.removed_at is not None:
            values.pop("name", None)
        else:
            values["name"] = self._unused_name(values["name"])
        if values:
            self.ours.execute(update(scenes).where(scenes.c.id == scene).values(**values))

    def _unused_name(self, wanted: str) -> str:
        free = unused_name(self.ours, wanted)
        if free != wanted:
            self.renamed.append((wanted, free))
        return free

    def _copy_boxes(self, row: Row[Any], number: int) -> None:
        boxes = get_boxes(self.theirs, row.number)
        if len(boxes):
            put_boxes(self.ours, number, boxes)

    def transfer_group(self, kind: str, group: str | None) -> None:
        staged = None if self._staged is None or group is None else self._staged.pop((kind, group), None)
        if group is None or (staged is None and has_group(self.ours, group)):
            return
        of_kind = select(groups.c.kind).where(groups.c.id == group)
        if self.theirs.execute(of_kind).scalar() != kind:
            raise CorruptError(
                f"{self.source.location}: the arrays {group[:12]} are not of the kind {kind}; nothing was changed",
                code="catalog_invalid",
            )
        files = manifest(self.theirs, group)
        if self._staged is None:
            name(self.ours, kind, group, files)  # of the same map: the group exists already
        elif staged is not None:
            publish(self.into.catalog, self.ours, self.into.arrays, staged, kind, group)
            self.counts["bytes"] += sum(file.size_bytes for file in files)
        else:
            raise StoreError(
                f"{self.into.location} was pruned meanwhile, so nothing was changed: try again",
                code="changed_meanwhile",
            )

    # --- results and reviews -----------------------------------------------------------------------------------------

    def results(self) -> None:
        """Copy the results of single scenes; if both maps have one with the same key, keep that of this map.

        Graphs are identified by their keys; of a scene that is thinned there only, they are copied where this map has
        none. Of other kinds a scene has one result, which holds for its stored Gaussians: it is copied where this map
        has none, and only for the same Gaussians. Damaged ones but graphs are left out.
        """
        whose = self.ours.execute(select(results).where(results.c.scene.is_not(None))).all()
        here = {(row.kind, row.key): row.group_id for row in whose}
        has_one = {(row.kind, row.scene) for row in whose}
        stored = {row.id: row.group_id for row in self.ours.execute(select(scenes.c.id, scenes.c.group_id))}
        their_scenes = {row.id: row for row in self._rows}
        theirs = select(results).where(results.c.scene.is_not(None)).order_by(results.c.created_at, results.c.number)
        for row in self.theirs.execute(theirs).all():
            if row.scene not in self.wanted:
                continue
            is_known = (row.kind, row.key) in here
            scene, has_any = their_scenes[row.scene], (row.kind, row.scene) in has_one
            if stored[row.scene] == scene.group_id:
                is_useful = row.kind == GRAPHS.kind or not has_any
            else:
                is_useful = row.kind == GRAPHS.kind and not (scene.thinned is not None and has_any)
            if not is_known and (not is_useful or row.group_id in self._damaged):
                continue
            if not is_known or row.group_id == here[row.kind, row.key]:
                self.transfer_group(row.kind, row.group_id)
            if not is_known:
                self.recipe(row.recipe)
                self.ours.execute(insert(results), _content(row))
                has_one.add((row.kind, row.scene))
                self.counts[row.kind] += 1

    def recipe(self, digest: str | None) -> None:
        """Copy the recipe that a row of the other map names."""
        same = recipes.c.digest == digest
        if digest is not None and self.ours.execute(select(recipes.c.digest).where(same)).first() is None:
            self.ours.execute(insert(recipes), dict(self.theirs.execute(select(recipes).where(same)).one()._mapping))
            self.counts["recipes"] += 1

    def pairs(self) -> None:
        """Copy registrations and reviews of the pairs whose scenes are both in this map now.

        For a pair in both maps all rows are kept in the order of time, so that the newest registration and the last
        review are in force.
        """
        here = set(self.ours.execute(select(scenes.c.id)).scalars())
        their_reviews = _by_pair(self.theirs.execute(select(reviews).order_by(reviews.c.number)))
        for pair, rows in _by_pair(self.theirs.execute(select(registrations).order_by(registrations.c.number))).items():
            ends = set(pair.split(":"))
            if ends <= here and ends & self.wanted:
                self._join_pair(pair, rows, their_reviews.get(pair, []))

    def _join_pair(self, pair: str, theirs: Sequence[Row[Any]], their_reviews: Sequence[Row[Any]]) -> None:
        of_pair, of_review = registrations.c.pair == pair, reviews.c.pair == pair
        mine = self.ours.execute(select(registrations).where(of_pair).order_by(registrations.c.number)).all()
        our_reviews = self.ours.execute(select(reviews).where(of_review).order_by(reviews.c.number)).all()
        names = {(side, row.number): _identity(row) for side, rows in (("a", mine), ("b", theirs)) for row in rows}
        rows = {names["a", row.number]: ("a", row) for row in mine}
        new = {names["b", row.number]: ("b", row) for row in theirs if names["b", row.number] not in rows}
        known_reviews = {_review_key(row): ("a", row) for row in our_reviews}
        new_reviews = {_review_key(row): ("b", row) for row in their_reviews if _review_key(row) not in known_reviews}
        if not new and not new_reviews:
            return
        self.counts["registrations"] += len(new)
        self.counts["reviews"] += len(new_reviews)
        # Numbers give the order, so that all rows of the pair are renumbered.
        self.ours.execute(delete(reviews).where(of_review))
        self.ours.execute(delete(registrations).where(of_pair))
        numbers: dict[str, int] = {}
        joined = merge_by_time(
            rows.values(),
            [("b", row) for row in theirs],
            time=lambda item: str(item[1].created_at),
            is_new=lambda item: names["b", item[1].number] in new,
        )
        for side, row in joined:
            content = _content(row)
            if side == "b":
                self.recipe(row.recipe)
            if row.adopts is not None:
                content["adopts"] = numbers[names[side, row.adopts]]
            query = insert(registrations).returning(registrations.c.number)
            numbers[names[side, row.number]] = self.ours.execute(query, content).scalar_one()
        joined_reviews = merge_by_time(
            known_reviews.values(),
            [("b", row) for row in their_reviews],
            time=lambda item: str(item[1].created_at),
            is_new=lambda item: _review_key(item[1]) in new_reviews,
        )
        for side, row in joined_reviews:
            number = numbers[names[side, row.registration]]
            self.ours.execute(insert(reviews), _content(row) | {"registration": number})

    def priors(self) -> None:
        """Copy pose priors of the scenes; if both maps have a current prior of a scene, keep the later prior."""
        query = select(priors).order_by(priors.c.number)
        mine: dict[str, dict[str, Row[Any]]] = {}
        for row in self.ours.execute(query):
            mine.setdefault(row.scene, {})[_identity(row, "removed_at")] = row
        has_current = any(row.removed_at is None for rows in mine.values() for row in rows.values())
        for row in self.theirs.execute(query).all():
            if row.scene not in self.wanted:
                continue
            known = mine.get(row.scene, {}).get(_identity(row, "removed_at"))
            if known is None:
                self.ours.execute(insert(priors), _content(row))
                self.counts["priors"] += 1
            elif row.removed_at is not None and known.removed_at is None:
                self._take_back(priors, known.number, row.removed_at)
        if not self.counts["priors"]:
            return
        if has_current:
            self.notes.append("both maps have pose priors: they agree only if both use the same frame")
        self._keep_latest(priors, lambda row: row.scene)

    def observations(self) -> None:
        """Copy the world observations of the scenes, and the control points in their photos.

        Of two current observations with the same name the later one stays; this map's world frame stays if it has one.
        """
        theirs = self.theirs.execute(select(observations).order_by(observations.c.number)).all()
        here = set(self.ours.execute(select(scenes.c.id)).scalars())
        shown = {row.value.get("point") for row in theirs if row.kind == "image" and row.scene in self.wanted}
        everything = self._is_whole_map

        def comes(row: Row[Any]) -> bool:
            ends = {end for end in (row.scene, row.other) if end is not None}
            if ends:
                return ends <= here and bool(ends & self.wanted)
            return everything or row.kind == "frame" or row.name in shown

        mine = {_identity(row, "removed_at"): row for row in self.ours.execute(select(observations))}
        has_frame = any(row.kind == "frame" and row.removed_at is None for row in mine.values())
        for row in filter(comes, theirs):
            known = mine.get(_identity(row, "removed_at"))
            if known is None and row.kind == "frame" and has_frame:
                if row.removed_at is None:
                    self.notes.append("both maps are georeferenced: this map keeps its frame")
                continue
            if known is None:
                self.ours.execute(insert(observations), _content(row))
                self.counts["observations"] += 1
            elif row.removed_at is not None and known.removed_at is None:
                self._take_back(observations, known.number, row.removed_at)
        self._keep_latest(observations, lambda row: (row.kind, row.name, row.scene, row.other))

    def _take_back(self, table: Table, number: int, removed_at: str) -> None:
        self.ours.execute(update(table).where(table.c.number == number).values(removed_at=removed_at))

    def _keep_latest(self, table: Table, subject: Callable[[Row[Any]], Any]) -> None:
        """Take back all current rows about each subject except the latest."""
        latest: dict[Any, Row[Any]] = {}
        current = select(table).where(table.c.removed_at.is_(None))
        for row in self.ours.execute(current.order_by(table.c.created_at.desc(), table.c.number.desc())).all():
            if (later := latest.setdefault(subject(row), row)) is not row:
                self._take_back(table, row.number, later.created_at)

    def photos(self) -> None:
        """Copy the photos of the scenes; a photo that either map removed stays removed."""
        mine = {_identity(row, "removed_at", "group_id"): row for row in self.ours.execute(select(photo_sightings))}
        current = {row.digest for row in mine.values() if row.removed_at is None}
        for row in self.theirs.execute(select(photo_sightings).order_by(photo_sightings.c.number)).all():
            known = mine.get(_identity(row, "removed_at", "group_id"))
            if row.scene not in self.wanted:
                continue
            if known is not None:
                if row.removed_at is not None and known.removed_at is None:
                    self._take_back(photo_sightings, known.number, row.removed_at)
            elif row.removed_at is None and row.digest not in current:
                self.transfer_group(PHOTOS, row.group_id)
                self.ours.execute(insert(photo_sightings), _content(row))
                self.counts["photos"] += 1

    def models(self) -> None:
        """Copy models whose names this map lacks; if both maps have a model of a name, keep the model of this map."""
        here = self.ours.execute(select(models).order_by(models.c.number)).all()
        current = {row.name: row for row in here if row.removed_at is None}
        taken_back = {(row.name, row.sha256): row.removed_at for row in here if row.removed_at is not None}
        for row in self.theirs.execute(select(models).where(models.c.removed_at.is_(None))).all():
            mine = current.get(row.name)
            if mine is not None:
                if mine.sha256 != row.sha256:
                    self.notes.append(
                        f"model {row.name} of this map is kept: graphs computed with the other map's model are stale"
                    )
            elif taken_back.get((row.name, row.sha256), "") < row.created_at:
                place = model_path(self.into.home, row)  # validates the path, which may come from an untrusted map
                if row.copied and not place.is_file():
                    place.parent.mkdir(exist_ok=True)
                    source = model_path(self.source.home, row)
                    self.source.arrays.fetch_model(row.path)
                    os.close(open_file(source))  # a plain file
                    write_whole(place, partial(link_or_copy, source))
                    self.into.arrays.upload_model(row.path)
                self.ours.execute(insert(models), _content(row))
                self.counts["models"] += 1
                self.notes.append(f"model {row.name} was copied: graphs computed without it are stale")


def _missing_groups(
    into: Store, ours: Connection, theirs: Connection, only: Collection[str] | None, mend: bool
) -> tuple[dict[tuple[str, str], tuple[StoredFile, ...]], set[tuple[str, str]]]:
    """Return manifests, by (kind, id), of groups that the scenes need and that are missing or damaged in this map; and
    the groups among them that gsmap computes again if they are lost."""
    named = [(SCENES, row.id, row.group_id) for row in theirs.execute(select(scenes.c.id, scenes.c.group_id))]
    of_whole = results.join(scenes, scenes.c.id == results.c.scene)
    kept = select(results).select_from(of_whole).where(scenes.c.thinned.is_(None))
    mine = ours.execute(kept).all()
    known = {(row.kind, row.key): row.group_id for row in mine}
    has_one = {(row.kind, row.scene) for row in mine if row.kind != GRAPHS.kind}
    for row in theirs.execute(select(results).where(results.c.scene.is_not(None))):
        group = known.get((row.kind, row.key))
        if group == row.group_id or (group is None and (row.kind, row.scene) not in has_one):
            named.append((row.kind, row.scene, row.group_id))
    named += named_groups(ours, theirs, only)
    kept = select(photo_sightings).where(photo_sightings.c.removed_at.is_(None))
    named += [(PHOTOS, row.scene, row.group_id) for row in theirs.execute(kept)]
    here, forgotten = set(ours.execute(select(groups.c.id)).scalars()), _forgotten(ours)

    def is_lacking(kind: str, group: str) -> bool:
        return group not in here or (mend and bool(into.arrays.problems(kind, group, manifest(ours, group))))

    missing = {
        (kind, group): manifest(theirs, group)
        for kind, scene, group in named
        if group is not None and scene not in forgotten and (only is None or scene in only) and is_lacking(kind, group)
    }
    computed = set(theirs.execute(select(results.c.group_id).where(results.c.kind != GRAPHS.kind)).scalars())
    return missing, {group for group in missing if group[1] in computed}


def _forgotten(connection: Connection) -> set[str]:
    """Return scenes that were purged and have not been ingested again."""
    purged = set(connection.execute(select(purges.c.scene)).scalars())
    return purged - set(connection.execute(select(scenes.c.id)).scalars())


def _content(row: Row[Any]) -> Content:
    """Return the values of a row without its number, which differs between maps."""
    return {column: value for column, value in row._mapping.items() if column != "number"}


def _kept(row: Row[Any]) -> Content:
    """Return the columns that describe a scene's arrays."""
    return {name: getattr(row, name) for name in ("group_id", "num_gaussians", "thinned")}


def _identity(row: Row[Any], *besides: str) -> str:
    """Return a text that is equal for equal rows of two maps."""
    return canonical({k: v for k, v in _content(row).items() if k not in ("adopts", *besides)})


def _review_key(row: Row[Any]) -> tuple[str, str, str]:
    return row.review, row.note, row.created_at


def merge_by_time(
    mine: Iterable[Item],
    theirs: Iterable[Item],
    *,
    time: Callable[[Item], str],
    is_new: Callable[[Item], bool] = lambda item: True,
) -> list[Item]:
    """Merge rows of two maps by time, keeping the order within each map.

    Args:
        mine, theirs: rows of each map, in the order they were written.
        time: time of a row.
        is_new: True for rows of theirs that are not among mine.
    """
    joined = [*timed(mine, time), *(one for one in timed(theirs, time) if is_new(one[1]))]
    return [item for _, item in sorted(joined, key=lambda one: one[0])]


def timed(items: Iterable[Item], time: Callable[[Item], str]) -> list[tuple[str, Item]]:
    """Return rows with their times, which are made non-decreasing in case a clock was set back."""
    out, newest = [], ""
    for item in items:
        newest = max(newest, time(item))
        out.append((newest, item))
    return out


def _time(fact: Mapping[str, Any]) -> str:
    return str(fact["created_at"])


def _by_pair(rows: Iterable[Row[Any]]) -> dict[str, list[Row[Any]]]:
    found: dict[str, list[Row[Any]]] = {}
    for row in rows:
        found.setdefault(row.pair, []).append(row)
    return found
