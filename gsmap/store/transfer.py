"""Scenes of one map, with all that is known of them, brought into another; nothing is computed."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from sqlalchemy import Connection, Row, delete, insert, select, update

from gsmap.durable import open_file, write_whole
from gsmap.errors import ConfigError, StoreError
from gsmap.store import facts
from gsmap.store.arrays import Staged, StoredFile, link_or_copy
from gsmap.store.boxes import get_boxes, put_boxes
from gsmap.store.change_rows import named_groups
from gsmap.store.graphs import KIND as GRAPHS
from gsmap.store.groups import drop_graphs, has_group, manifest, name, publish
from gsmap.store.models import model_path
from gsmap.store.photos import KIND as PHOTOS
from gsmap.store.scene_refs import free_name
from gsmap.store.scenes import KIND as SCENES
from gsmap.store.schema import (
    graphs,
    groups,
    models,
    observations,
    photo_sightings,
    priors,
    purges,
    recipes,
    registrations,
    reviews,
    scene_facts,
    scenes,
)
from gsmap.store.store import Store
from gsmap.types.plain import canonical

Content = dict[str, Any]
Item = TypeVar("Item")
_MERGE = "merge"  # author of a name that a scene got because its own was taken: nobody's word


@contextlib.contextmanager
def between(
    into: Store, source: Store, only: Collection[str] | None = None, *, mend: bool = False
) -> Iterator[Transfer]:
    """One transaction on ``into``, in which scenes come from one state of ``source``; committed when the block ends.

    Their arrays are linked or copied beside their places first, so that the transaction is short.

    Args:
        only: ids of the scenes to bring; None for all, the removed ones included.
        mend: read the arrays of these that are here, too, and bring those that are damaged again.

    Raises:
        ConfigError: a map into itself.
        CorruptError: arrays of the source are missing or damaged; nothing was changed.
    """
    same_home = into.home.samefile(source.home)
    if same_home and into.folder.samefile(source.folder):
        raise ConfigError(f"{into.location} and {source.location} are the same map: name two", code="same_map")
    with contextlib.ExitStack() as stack:
        staged: dict[tuple[str, str], Staged] = {}
        if not same_home:
            with source.arrays.lock():  # what this state of it names is not reclaimed until it is ours, too
                theirs = stack.enter_context(source.catalog.read())
                with into.catalog.read() as ours:
                    missing = _missing_groups(into, ours, theirs, only, mend)
                staged = stack.enter_context(into.arrays.stage_copies(source.arrays, missing))
        ours = stack.enter_context(into.catalog.write())
        into.catalog.hold(into.arrays.lock())
        if same_home:
            theirs = stack.enter_context(source.catalog.read())
        yield Transfer(into, source, ours, theirs, only, None if same_home else staged)


class Transfer:
    """What is open while scenes go from one map into another; see `between`.

    Attributes:
        counts: how much was new, by noun.
        notes: what a person should know.
        renamed: (old, new) names of scenes whose name was taken.
    """

    def __init__(
        self,
        into: Store,
        source: Store,
        ours: Connection,
        theirs: Connection,
        only: Collection[str] | None,
        staged: dict[tuple[str, str], Staged] | None,
    ) -> None:
        self.into, self.source = into, source
        self.ours, self.theirs = ours, theirs
        self.counts: Counter[str] = Counter()
        self.notes: list[str] = []
        self.renamed: list[tuple[str, str]] = []
        self._staged = staged
        self._whole = only is None
        rows = theirs.execute(select(scenes).order_by(scenes.c.number)).all()
        self._rows = [row for row in rows if only is None or row.id in only]
        self._forgotten = _forgotten(ours) & {row.id for row in self._rows}
        self.wanted = {row.id for row in self._rows} - self._forgotten

    # --- scenes ------------------------------------------------------------------------------------------------------

    def scenes(self) -> None:
        """The scenes, their facts, arrays and chunk boxes. Of a scene in both maps, what was said later holds."""
        for scene in sorted(self._forgotten):
            self.notes.append(f"scene {scene} was forgotten here on demand, so it stays away")
        for row in self._rows:
            if row.id in self._forgotten:
                continue
            mine = self.ours.execute(select(scenes).where(scenes.c.id == row.id)).first()
            if mine is None or mine.group_id in (None, row.group_id) or mine.thinned is not None:
                self.bring_group(SCENES, row.group_id)
            if mine is None:
                self._add_scene(row)
                self._join_facts(row.id, arrives=True)
            else:
                self._join_facts(row.id, arrives=self._meet_scene(mine, row))

    def _add_scene(self, row: Row[Any]) -> None:
        content = _content(row)
        if row.removed_at is None:
            content["name"] = self._free_name(row.name)
        number = self.ours.execute(insert(scenes).returning(scenes.c.number), content).scalar_one()
        self._copy_boxes(row, number)
        self.counts["scenes" if row.removed_at is None else "removed"] += 1

    def _meet_scene(self, mine: Row[Any], row: Row[Any]) -> bool:
        """A scene that both maps know: the later of its arrivals and removals decides whether it lives.

        Returns whether it arrives again.
        """
        self.counts["known"] += 1
        values: Content = {}
        if mine.group_id is None and row.group_id is not None:
            values |= _kept(row)
            self._copy_boxes(row, mine.number)
        elif mine.thinned is not None and row.group_id is not None and row.thinned is None:
            values |= _kept(row)
            self._copy_boxes(row, mine.number)
            drop_graphs(self.ours, mine.id)  # made of the compact Gaussians, which have other rows
            self.notes.append(f"scene {mine.name} is whole again: it was thinned here, and not there")
        returns = mine.removed_at is not None and row.removed_at is None and row.ingested_at > mine.removed_at
        leaves = mine.removed_at is None and row.removed_at is not None and row.removed_at > mine.ingested_at
        if returns:
            values |= {"removed_at": None, "ingested_at": row.ingested_at, "name": self._free_name(row.name)}
            self.counts["scenes"] += 1
            self.notes.append(f"scene {row.name} is back: it was ingested there after it was removed here")
        elif leaves:
            values["removed_at"] = row.removed_at
            self.counts["removed"] += 1
            self.notes.append(f"scene {mine.name} is removed: it was removed there after it was ingested here")
        elif mine.removed_at is not None and row.removed_at is None:
            self.notes.append(f"scene {mine.name} stays removed: it was removed here after it was ingested there")
        if mine.scale_policy != row.scale_policy:
            self.notes.append(
                f"scene {mine.name} keeps the scale policy {mine.scale_policy} (there: {row.scale_policy})"
            )
        if values:
            self.ours.execute(update(scenes).where(scenes.c.id == mine.id).values(**values))
        return returns

    def _join_facts(self, scene: str, *, arrives: bool) -> None:
        """Everything that was said of a scene in either map, in the order of time.

        Args:
            arrives: it comes from the other map with its name and date; else they change where that said so later.
        """
        query = select(scene_facts).where(scene_facts.c.scene == scene).order_by(scene_facts.c.number)
        mine = [_content(row) for row in self.ours.execute(query)]
        theirs = [_content(row) for row in self.theirs.execute(query)]
        known = {canonical(fact) for fact in mine}
        joined = in_order(mine, theirs, time=_time, is_new=lambda fact: canonical(fact) not in known)
        if len(joined) > len(mine):
            self.counts["facts"] += len(joined) - len(mine)
            self.ours.execute(delete(scene_facts).where(scene_facts.c.scene == scene))
            self.ours.execute(insert(scene_facts), joined)
            if not arrives:
                self._take_later_words(scene, mine, theirs)
        row = self.ours.execute(select(scenes).where(scenes.c.id == scene)).one()
        names = [row.value for row in self.ours.execute(query) if row.kind == "name"]
        if row.removed_at is None and names and names[-1] != row.name:
            facts.say(self.ours, scene, [("name", row.name)], _MERGE)

    def _take_later_words(self, scene: str, mine: Sequence[Content], theirs: Sequence[Content]) -> None:
        """Name and date of a scene, where they were said in the other map after they were here.

        What it was called and dated by its files when it arrived there is no later word on what was said here.
        """
        arrived_at = min(fact["created_at"] for fact in theirs)
        values: Content = {}
        for kind in ("name", "captured_at"):
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
            values["name"] = self._free_name(values["name"])
        if values:
            self.ours.execute(update(scenes).where(scenes.c.id == scene).values(**values))

    def _free_name(self, wanted: str) -> str:
        free = free_name(self.ours, wanted)
        if free != wanted:
            self.renamed.append((wanted, free))
        return free

    def _copy_boxes(self, row: Row[Any], number: int) -> None:
        boxes = get_boxes(self.theirs, row.number)
        if len(boxes):
            put_boxes(self.ours, number, boxes)

    def bring_group(self, kind: str, group: str | None) -> None:
        staged = None if self._staged is None or group is None else self._staged.pop((kind, group), None)
        if group is None or (staged is None and has_group(self.ours, group)):
            return
        files = manifest(self.theirs, group)
        if self._staged is None:
            name(self.ours, kind, group, files)  # of the same map: it lies there already
        elif staged is not None:
            publish(self.into.catalog, self.ours, self.into.arrays, staged, kind, group)
            self.counts["bytes"] += sum(file.size_bytes for file in files)
        else:
            raise StoreError(
                f"{self.into.location} was pruned meanwhile; nothing was changed: try again", code="changed_meanwhile"
            )

    # --- what was made of scenes, and said of pairs ------------------------------------------------------------------

    def graphs(self) -> None:
        """Their scene graphs; where both maps have one under a key, this map's stays."""
        here = {row.key: row.group_id for row in self.ours.execute(select(graphs.c.key, graphs.c.group_id))}
        for row in self.theirs.execute(select(graphs).order_by(graphs.c.created_at)).all():
            if row.scene not in self.wanted:
                continue
            if row.key not in here or row.group_id == here[row.key]:
                self.bring_group(GRAPHS, row.group_id)
            if row.key not in here:
                self.recipe(row.recipe)
                self.ours.execute(insert(graphs), dict(row._mapping))
                self.counts["graphs"] += 1

    def recipe(self, digest: str | None) -> None:
        """The recipe that a row of theirs names."""
        same = recipes.c.digest == digest
        if digest is not None and self.ours.execute(select(recipes.c.digest).where(same)).first() is None:
            self.ours.execute(insert(recipes), dict(self.theirs.execute(select(recipes).where(same)).one()._mapping))
            self.counts["recipes"] += 1

    def pairs(self) -> None:
        """Registrations and reviews of the pairs whose scenes are both here now.

        Of a pair that both maps know all is kept, in the order of time, so that the newest registration and the last
        word count.
        """
        here = set(self.ours.execute(select(scenes.c.id)).scalars())
        said = _by_pair(self.theirs.execute(select(reviews).order_by(reviews.c.number)))
        for pair, rows in _by_pair(self.theirs.execute(select(registrations).order_by(registrations.c.number))).items():
            ends = set(pair.split(":"))
            if ends <= here and ends & self.wanted:
                self._join_pair(pair, rows, said.get(pair, []))

    def _join_pair(self, pair: str, theirs: Sequence[Row[Any]], said: Sequence[Row[Any]]) -> None:
        of_pair, of_review = registrations.c.pair == pair, reviews.c.pair == pair
        mine = self.ours.execute(select(registrations).where(of_pair).order_by(registrations.c.number)).all()
        spoken = self.ours.execute(select(reviews).where(of_review).order_by(reviews.c.number)).all()
        names = {(side, row.number): _identity(row) for side, rows in (("a", mine), ("b", theirs)) for row in rows}
        rows = {names["a", row.number]: ("a", row) for row in mine}
        new = {names["b", row.number]: ("b", row) for row in theirs if names["b", row.number] not in rows}
        words = {_word(row): ("a", row) for row in spoken}
        new_words = {_word(row): ("b", row) for row in said if _word(row) not in words}
        if not new and not new_words:
            return
        self.counts["registrations"] += len(new)
        self.counts["reviews"] += len(new_words)
        # Their numbers say what came after what, so that all of the pair get new ones.
        self.ours.execute(delete(reviews).where(of_review))
        self.ours.execute(delete(registrations).where(of_pair))
        numbers: dict[str, int] = {}
        joined = in_order(
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
        told = in_order(
            words.values(),
            [("b", row) for row in said],
            time=lambda item: str(item[1].created_at),
            is_new=lambda item: _word(item[1]) in new_words,
        )
        for side, row in told:
            number = numbers[names[side, row.registration]]
            self.ours.execute(insert(reviews), _content(row) | {"registration": number})

    def priors(self) -> None:
        """What was told of where the scenes lie; of two that stand, the later one."""
        query = select(priors).order_by(priors.c.number)
        mine: dict[str, dict[str, Row[Any]]] = {}
        for row in self.ours.execute(query):
            mine.setdefault(row.scene, {})[_identity(row, "removed_at")] = row
        standing_here = any(row.removed_at is None for rows in mine.values() for row in rows.values())
        for row in self.theirs.execute(query).all():
            if row.scene not in self.wanted:
                continue
            known = mine.get(row.scene, {}).get(_identity(row, "removed_at"))
            if known is None:
                self.ours.execute(insert(priors), _content(row))
                self.counts["priors"] += 1
            elif row.removed_at is not None and known.removed_at is None:
                taken_back = priors.c.number == known.number
                self.ours.execute(update(priors).where(taken_back).values(removed_at=row.removed_at))
        if not self.counts["priors"]:
            return
        if standing_here:
            self.notes.append("both maps were told where scenes lie: that fits only if both mean the same frame")
        for scene in self.wanted:
            standing = (priors.c.scene == scene) & priors.c.removed_at.is_(None)
            rows = self.ours.execute(select(priors).where(standing).order_by(priors.c.created_at)).all()
            for row in rows[:-1]:
                earlier = priors.c.number == row.number
                self.ours.execute(update(priors).where(earlier).values(removed_at=rows[-1].created_at))

    def observations(self) -> None:
        """What was observed of the world by these scenes, and the control points that their photos show.

        Of two that stand under a name the later one holds; the world frame of this map stays where it has one.
        """
        theirs = self.theirs.execute(select(observations).order_by(observations.c.number)).all()
        here = set(self.ours.execute(select(scenes.c.id)).scalars())
        shown = {row.value.get("point") for row in theirs if row.kind == "image" and row.scene in self.wanted}
        everything = self._whole

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
                    self.notes.append("both maps are tied to the world: this one's frame stays")
                continue
            if known is None:
                self.ours.execute(insert(observations), _content(row))
                self.counts["observations"] += 1
            elif row.removed_at is not None and known.removed_at is None:
                taken_back = observations.c.number == known.number
                self.ours.execute(update(observations).where(taken_back).values(removed_at=row.removed_at))
        standing: dict[tuple[Any, ...], list[Row[Any]]] = {}
        query = select(observations).where(observations.c.removed_at.is_(None)).order_by(observations.c.created_at)
        for row in self.ours.execute(query):
            standing.setdefault((row.kind, row.name, row.scene), []).append(row)
        for rows in standing.values():
            for row in rows[:-1]:
                earlier = observations.c.number == row.number
                self.ours.execute(update(observations).where(earlier).values(removed_at=rows[-1].created_at))

    def photos(self) -> None:
        """Photographs that are kept of these scenes; one that either map took back stays so."""
        mine = {_identity(row, "removed_at", "group_id"): row for row in self.ours.execute(select(photo_sightings))}
        standing = {row.digest for row in mine.values() if row.removed_at is None}
        for row in self.theirs.execute(select(photo_sightings).order_by(photo_sightings.c.number)).all():
            known = mine.get(_identity(row, "removed_at", "group_id"))
            if row.scene not in self.wanted:
                continue
            if known is not None:
                if row.removed_at is not None and known.removed_at is None:
                    taken_back = photo_sightings.c.number == known.number
                    self.ours.execute(update(photo_sightings).where(taken_back).values(removed_at=row.removed_at))
            elif row.removed_at is None and row.digest not in standing:
                self.bring_group(PHOTOS, row.group_id)
                self.ours.execute(insert(photo_sightings), _content(row))
                self.counts["photos"] += 1

    def models(self) -> None:
        """Models of kinds that this map lacks; where both have one under a name, this map's stays."""
        here = self.ours.execute(select(models).order_by(models.c.number)).all()
        standing = {row.name: row for row in here if row.removed_at is None}
        taken_back = {(row.name, row.sha256): row.removed_at for row in here if row.removed_at is not None}
        for row in self.theirs.execute(select(models).where(models.c.removed_at.is_(None))).all():
            mine = standing.get(row.name)
            if mine is not None:
                if mine.sha256 != row.sha256:
                    self.notes.append(
                        f"model {row.name} stays the one of this map: graphs made with the other are stale"
                    )
            elif taken_back.get((row.name, row.sha256), "") < row.created_at:
                place = model_path(self.into.home, row)  # the other map may be a stranger's
                if row.copied and not place.is_file():
                    place.parent.mkdir(exist_ok=True)
                    source = model_path(self.source.home, row)
                    self.source.arrays.bring_model(row.path)
                    os.close(open_file(source))  # a plain file
                    write_whole(place, partial(link_or_copy, source))
                    self.into.arrays.send_model(row.path)
                self.ours.execute(insert(models), _content(row))
                self.counts["models"] += 1
                self.notes.append(f"model {row.name} came along: graphs made without it are out of date")


def _missing_groups(
    into: Store, ours: Connection, theirs: Connection, only: Collection[str] | None, mend: bool
) -> dict[tuple[str, str], tuple[StoredFile, ...]]:
    """Manifests of the groups that wanted scenes need and this map lacks (or has damaged), by (kind, id)."""
    named = [(SCENES, row.id, row.group_id) for row in theirs.execute(select(scenes.c.id, scenes.c.group_id))]
    of_whole = graphs.join(scenes, scenes.c.id == graphs.c.scene)
    kept = select(graphs.c.key, graphs.c.group_id).select_from(of_whole).where(scenes.c.thinned.is_(None))
    known = {row.key: row.group_id for row in ours.execute(kept)}
    made = theirs.execute(select(graphs.c.key, graphs.c.scene, graphs.c.group_id))
    named += [(GRAPHS, row.scene, row.group_id) for row in made if known.get(row.key, row.group_id) == row.group_id]
    named += named_groups(ours, theirs, only)
    kept = select(photo_sightings).where(photo_sightings.c.removed_at.is_(None))
    named += [(PHOTOS, row.scene, row.group_id) for row in theirs.execute(kept)]
    here, forgotten = set(ours.execute(select(groups.c.id)).scalars()), _forgotten(ours)

    def is_lacking(kind: str, group: str) -> bool:
        return group not in here or (mend and bool(into.arrays.problems(kind, group, manifest(ours, group))))

    return {
        (kind, group): manifest(theirs, group)
        for kind, scene, group in named
        if group is not None and scene not in forgotten and (only is None or scene in only) and is_lacking(kind, group)
    }


def _forgotten(connection: Connection) -> set[str]:
    """Scenes that were purged, and have not been ingested again."""
    purged = set(connection.execute(select(purges.c.scene)).scalars())
    return purged - set(connection.execute(select(scenes.c.id)).scalars())


def _content(row: Row[Any]) -> Content:
    """A row without its number, which is each map's own."""
    return {column: value for column, value in row._mapping.items() if column != "number"}


def _kept(row: Row[Any]) -> Content:
    """How a scene's arrays are kept."""
    return {name: getattr(row, name) for name in ("group_id", "num_gaussians", "thinned")}


def _identity(row: Row[Any], *besides: str) -> str:
    """What is equal where two maps hold the same row."""
    return canonical({k: v for k, v in _content(row).items() if k not in ("adopts", *besides)})


def _word(row: Row[Any]) -> tuple[str, str, str]:
    return row.review, row.note, row.created_at


def in_order(
    mine: Iterable[Item],
    theirs: Iterable[Item],
    *,
    time: Callable[[Item], str],
    is_new: Callable[[Item], bool] = lambda item: True,
) -> list[Item]:
    """What was written in two maps as one sequence: by time, and each map's own in the order in which it was written.

    Args:
        mine, theirs: all that either map has, as it was written.
        time: when an item was written.
        is_new: whether an item of theirs is not among mine.
    """
    joined = [*timed(mine, time), *(one for one in timed(theirs, time) if is_new(one[1]))]
    return [item for _, item in sorted(joined, key=lambda one: one[0])]


def timed(items: Iterable[Item], time: Callable[[Item], str]) -> list[tuple[str, Item]]:
    """Items with their times; where a clock went back, an item has the latest time before it."""
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
