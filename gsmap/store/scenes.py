"""Scenes: who is in the map, what is said of them, and reading them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import Connection, Row, Text, insert, select, true, type_coerce, update

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.geometry.boxes import inside
from gsmap.geometry.transforms import transform_cameras
from gsmap.store import compact, facts
from gsmap.store.arrays import Arrays, StoredFile, digest
from gsmap.store.boxes import chunk_boxes, put_boxes, row_ranges, touching
from gsmap.store.catalog import Catalog, now
from gsmap.store.explained import NOT_KEPT, explained
from gsmap.store.facts import SceneFact
from gsmap.store.groups import drop_graphs, has_group, manifest, num_bytes, publish, unless_pruned, unname
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.packed import Column
from gsmap.store.scene_content import (
    GaussianBlocks,
    StoredGaussians,
    camera_arrays,
    scene_id,
    scene_of,
    shapes_of,
    thinning_of,
)
from gsmap.store.scene_refs import alive, by_id, find, find_removed, free_name, name_taken
from gsmap.store.schema import scenes
from gsmap.stream import about, in_morton_order
from gsmap.stream import bounds as bounds_of
from gsmap.types import Cameras, Gaussians, GaussianSource, Scene, Sim3, Thinning
from gsmap.types.gaussians import FIELDS
from gsmap.types.progress import Progress
from gsmap.types.source import origin_of_source

KIND = "scenes"
_SIGMAS = 3.0


class BriefScene(NamedTuple):  # made of all scenes several times an update: a tuple is made in a fifth of the time
    """What every update asks of all scenes; as in `Scene`, of which the rest takes ten times as long to read."""

    id: str
    name: str
    scale_policy: str
    captured_at: str | None
    thinning: Thinning | None


class Scenes:
    """The scenes of a map. A *ref* is a scene's name, its id, or the beginning of its id where only one begins so.

    A name is unique among living scenes, not empty, and has no control characters. It may hold a colon: who reads
    ``A:B`` must try every colon as the one between two scenes.
    """

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def add(
        self,
        gaussians: GaussianSource,
        cameras: Cameras,
        *,
        name: str,
        scale_policy: str = "auto",
        captured_at: str | None = None,
        source: str = "",
        antialiased: bool = False,
        notes: tuple[str, ...] = (),
        dated_by: str = "",
        rename: bool = True,
        progress: Progress | None = None,
    ) -> tuple[Scene, bool]:
        """Add a scene; durable when it returns.

        Args:
            gaussians, cameras: in the scene's own frame, whose origin is that of the Gaussians; validated before
                (`gsmap.ingest.validate`). Gaussians that are not in memory need no more of it than
                `gsmap.stream.order.BUCKET_BYTES` and a few bytes each.
            captured_at: ISO 8601; UTC where it has no zone.
            dated_by: what the date was read from; empty where a person said it.
            rename: where another scene has the name, take ``name-2`` and so on; else refuse.

        Returns:
            The scene, and whether its content was written. Content that the map has already is not (False), though a
            date that a person gives becomes the scene's, and one that was read somewhere does where the scene never had
            any; content that was removed comes back under the new name, and content
            whose bytes were damaged is mended.

        Raises:
            InputError: no Gaussians, a name or date that cannot be, or the name is taken and ``rename`` is off.
        """
        facts.checked_text("the name of a scene", name)
        captured_at = None if captured_at is None else facts.checked_date(captured_at)
        if not gaussians.num_gaussians:
            raise InputError(f"scene {name!r} has no Gaussians", code="no_gaussians")
        new_id = scene_id(gaussians, cameras)
        with self._catalog.read() as connection:
            row = by_id(connection, new_id)
            files = manifest(connection, new_id)
        stored = bool(files) and not self._arrays.problems(KIND, new_id, files)
        if row is not None and row.removed_at is None and stored:
            return self._dated(row.id, captured_at, dated_by), False
        box, origin = bounds_of(gaussians), origin_of_source(gaussians)
        if origin.any() and row is None:
            # What gsmap knew no origins of lies in the map as it came, rounded to single precision.
            before = scene_id(about(gaussians, np.zeros(3)), transform_cameras(cameras, Sim3(np.eye(3), origin)))
            with self._catalog.read() as connection:
                row = by_id(connection, before)
            if row is not None and row.removed_at is None:
                return self._dated(before, captured_at, dated_by), False
        fields: dict[str, Any] = {
            "name": name,
            "num_gaussians": gaussians.num_gaussians,
            "sh_degree": gaussians.sh_degree,
            "num_cameras": len(cameras),
            "bounds": box.astype(np.float64).tolist(),
            "scale_policy": scale_policy,
            "captured_at": captured_at,
            "source": source,
            "cameras_synthesised": int(cameras.synthesised),
            "antialiased": int(antialiased),
            "notes": list(notes),
            "origin": origin.tolist() if origin.any() else None,
        }
        if stored:  # removed, but not yet pruned
            with self._catalog.write() as connection:
                if has_group(connection, new_id):
                    return self._enter(connection, new_id, fields, rename, dated_by), True
        if progress:
            progress(0.1, f"sorting {name}")
        with contextlib.ExitStack() as until_end:
            until_end.enter_context(explained(self._catalog.folder, NOT_KEPT))
            with self._arrays.scratch() as scratch, in_morton_order(gaussians, box, scratch) as ordered:
                if progress:
                    progress(0.4, f"writing {name}")
                content = GaussianBlocks(ordered, CHUNK_ROWS)
                arrays: dict[str, np.ndarray | Column] = {**content.arrays, **camera_arrays(cameras)}
                staging = self._arrays.stage(arrays, KIND, new_id)
                staged = until_end.enter_context(staging)
            connection = until_end.enter_context(self._catalog.write())
            row = by_id(connection, new_id)
            if row is not None and row.removed_at is None:
                scene = self._dated(new_id, captured_at, dated_by)
                if manifest(connection, new_id) != files:  # another process was faster
                    return scene, False
                # else its bytes are damaged
            else:
                scene = self._enter(connection, new_id, fields, rename, dated_by)
            publish(self._catalog, connection, self._arrays, staged, KIND, new_id)
            if row is not None and row.thinned is not None:
                drop_graphs(connection, new_id)  # made since of the compact Gaussians, which have other rows
            number = connection.execute(select(scenes.c.number).where(scenes.c.id == new_id)).scalar_one()
            put_boxes(connection, number, content.boxes())
            whole = {"group_id": new_id, "num_gaussians": gaussians.num_gaussians, "thinned": None}
            connection.execute(update(scenes).where(scenes.c.id == new_id).values(**whole))
            scene = _with_tags(connection, find(connection, new_id))
        return scene, True

    def brief(self) -> list[BriefScene]:
        """The living scenes in the order they came, without what takes long to read."""
        columns = (scenes.c.id, scenes.c.name, scenes.c.scale_policy, scenes.c.captured_at, scenes.c.thinned)
        query = select(*columns).where(scenes.c.removed_at.is_(None)).order_by(scenes.c.number)
        with self._catalog.read() as connection:
            rows = connection.execute(query).all()
        return [
            BriefScene(scene, name, policy, captured_at, thinning_of(thinned))
            for scene, name, policy, captured_at, thinned in rows
        ]

    def bounds(self) -> dict[str, np.ndarray]:
        """(2, 3) of every living scene by its id, as of `Scene`."""
        living = scenes.c.removed_at.is_(None)
        query = select(scenes.c.id, type_coerce(scenes.c.bounds, Text).label("bounds")).where(living)
        with self._catalog.read() as connection:
            rows = connection.execute(query).all()
            try:  # all at once: a tenth of the time
                boxes = np.array(json.loads(f"[{','.join(row.bounds for row in rows)}]"))
                if boxes.shape == (len(rows), 2, 3) and boxes.dtype == np.float64:
                    return {row.id: box for row, box in zip(rows, boxes, strict=True)}
            except (ValueError, TypeError, RecursionError):
                pass  # one of them is no box: which one it is, its type tells
            boxed = connection.execute(select(scenes.c.id, scenes.c.bounds).where(living))
            return {row.id: np.array(row.bounds, dtype=np.float64) for row in boxed}

    def list(self, *, removed: bool = False, among: Collection[str] | None = None) -> list[Scene]:
        """The living scenes (or the removed ones) in the order they came.

        Args:
            among: only those of these ids.
        """
        condition = scenes.c.removed_at.is_not(None) if removed else scenes.c.removed_at.is_(None)
        among_these = true() if among is None else scenes.c.id.in_(sorted(among))
        with self._catalog.read() as connection:
            tags = facts.tags(connection)
            rows = connection.execute(select(scenes).where(condition, among_these).order_by(scenes.c.number))
            return [scene_of(row, tags.get(row.id, ())) for row in rows]

    def names(self) -> dict[str, str]:
        """The name of every scene by its id, removed ones included."""
        with self._catalog.read() as connection:
            return {row[0]: row[1] for row in connection.execute(select(scenes.c.id, scenes.c.name)).all()}

    def get(self, ref: str) -> Scene:
        """One scene by name, id or the beginning of its id; a removed one by its id only.

        Raises:
            NotFoundError: none, or several begin so.
        """
        with self._catalog.read() as connection:
            return _with_tags(connection, find(connection, ref))

    def edit(
        self,
        ref: str,
        *,
        name: str | None = None,
        captured_at: str | None = None,
        note: str | None = None,
        tags_add: Iterable[str] = (),
        tags_remove: Iterable[str] = (),
        metres_per_unit: float | None = None,
        author: str = "",
    ) -> Scene:
        """Change what is said of a living scene; what was said before stays in its `facts`.

        Args:
            name: free among living scenes.
            captured_at: ISO 8601, UTC where it has no zone; empty to take the date back.
            note: added to the notes that there are.
            tags_add, tags_remove: single words or short phrases.
            metres_per_unit: metres in a unit of its frame; 0 to take that back.
            author: who says so.

        Raises:
            NotFoundError: no such scene, it was removed, or it lacks a tag that is to go.
            InputError: an empty text, one with control characters, no date, no length, or a name that is taken.
        """
        new = facts.checked(name, captured_at, note, metres_per_unit)
        new += [("tag", facts.checked_text("a tag", tag).strip()) for tag in tags_add]
        new += [("untag", facts.checked_text("a tag", tag).strip()) for tag in tags_remove]
        if author:
            facts.checked_text("an author", author)
        with self._catalog.write() as connection:
            row = alive(connection, ref)
            tags = set(facts.tags(connection, row.id).get(row.id, ()))
            same = {("name", row.name), ("captured_at", row.captured_at or ""), *(("tag", tag) for tag in tags)}
            same |= {("metres_per_unit", facts.told_metres(connection).get(row.id, ""))}
            new = [fact for fact in dict.fromkeys(new) if fact not in same]
            for kind, value in new:
                if kind == "name" and name_taken(connection, value):
                    raise InputError(
                        f"another scene is called {value!r}: choose another name, or rename that one", code="name_taken"
                    )
                if kind == "untag" and value not in tags:
                    raise NotFoundError(
                        f"scene {row.name!r} has no tag {value!r}: it has {sorted(tags) or 'none'}",
                        code="tag_not_found",
                    )
            facts.say(connection, row.id, new, author)
            columns = {kind: value or None for kind, value in new if kind in ("name", "captured_at")}
            if columns:
                connection.execute(update(scenes).where(scenes.c.id == row.id).values(**columns))
            return _with_tags(connection, find(connection, row.id))

    def facts(self, ref: str) -> Sequence[SceneFact]:
        """Everything people said of a scene since it was ingested, oldest first."""
        with self._catalog.read() as connection:
            return facts.said(connection, find(connection, ref).id)

    def told_metres(self) -> dict[str, float]:
        """Metres per unit that people gave of scenes, by id; scenes of which nobody said any are left out."""
        with self._catalog.read() as connection:
            return {scene: float(value) for scene, value in facts.told_metres(connection).items()}

    def latest_notes(self) -> dict[str, str]:
        """The last note that people made of each scene, by its id; scenes without one are left out."""
        with self._catalog.read() as connection:
            return facts.latest_notes(connection)

    def notes(self, ref: str) -> tuple[str, ...]:
        """What a person should know about how it was ingested."""
        with self._catalog.read() as connection:
            return tuple(find(connection, ref).notes)

    def removed_at(self, ref: str) -> str | None:
        """When it was removed; None while it lives."""
        with self._catalog.read() as connection:
            when: str | None = find(connection, ref).removed_at
            return when

    def gaussians(self, ref: str, bounds: np.ndarray | None = None, without: np.ndarray | None = None) -> Gaussians:
        """Read a scene's Gaussians (Morton order).

        Args:
            bounds: (2, 3) lowest and highest corner in the scene's frame: only Gaussians within three standard
                deviations (the largest) of it are returned, and only the chunks that touch it are read.
            without: (N,) bool, those that are left out.

        Raises:
            CorruptError: bytes on disk are missing or differ.
            NotFoundError: no such scene, or its bytes were pruned.
        """
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)
            chunks = None if bounds is None else touching(connection, row.number, np.asarray(bounds, np.float64))
        rows = None if chunks is None else row_ranges(chunks, row.num_gaussians)
        with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
            out = self._read(row, files, rows)
        if without is not None:
            spans = [(0, row.num_gaussians)] if rows is None else rows
            out = out[~_rows_of(without, spans)]
        if bounds is None:
            return out
        low, high = np.asarray(bounds, np.float64)
        a, b, c = out.log_scales.T
        reach = _SIGMAS * np.exp(np.maximum(np.maximum(a, b), c))
        x, y, z = ((p >= low[k] - reach) & (p <= high[k] + reach) for k, p in enumerate(out.means.T))
        near = x & y & z
        return out if near.all() else out[near]

    def gaussians_within(self, ref: str, bounds: np.ndarray, without: np.ndarray | None = None) -> Gaussians:
        """Read the Gaussians of a scene whose means lie in a box: of chunks without any, only means are read.

        Args:
            bounds: (2, 3) lowest and highest corner in the scene's frame.
            without: (N,) bool, those that are left out.

        Raises:
            CorruptError, NotFoundError: as `gaussians`.
        """
        bounds = np.asarray(bounds, np.float64)
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)
            chunks = touching(connection, row.number, bounds)
        if row.thinned is not None:
            out = self.gaussians(row.id, bounds, without)
            return out[inside(out.means, bounds)]
        spans = row_ranges(chunks, row.num_gaussians)
        read = partial(self._arrays.read, KIND, row.group_id, files, shapes=shapes_of(row))
        with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
            means = read(only=("means",), rows=spans)["means"]
            within = inside(means, bounds)
            if without is not None:
                within &= ~_rows_of(without, spans)
            begins = np.cumsum([0, *(min(CHUNK_ROWS, row.num_gaussians - chunk * CHUNK_ROWS) for chunk in chunks)])
            holds = np.logical_or.reduceat(within, begins[:-1]) if chunks else np.zeros(0, bool)
            held = np.repeat(holds, np.diff(begins))
            spans = row_ranges([chunk for chunk, some in zip(chunks, holds, strict=True) if some], row.num_gaussians)
            others = read(only=[name for name in FIELDS if name != "means"], rows=spans)
        out = Gaussians(means if held.all() else means[held], **others)
        return out if within.all() else out[within[held]]

    def source(self, ref: str) -> GaussianSource:
        """A scene's Gaussians (Morton order), read a few chunks at a time.

        Raises:
            CorruptError, NotFoundError: as `gaussians`, now or when they are read.
        """
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)

        def read(start: int, stop: int) -> Gaussians:
            with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
                return self._read(row, files, [(start, stop)])

        def column(name: str, start: int, stop: int) -> np.ndarray:
            if row.thinned is not None:
                values: np.ndarray = getattr(read(start, stop), name)
                return values
            with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
                shapes = shapes_of(row)
                span = [(start, stop)]
                return self._arrays.read(KIND, row.group_id, files, only=[name], rows=span, shapes=shapes)[name]

        return StoredGaussians(row.num_gaussians, row.sh_degree, read, column)

    def _read(
        self, row: Row[Any], files: tuple[StoredFile, ...], ranges: Sequence[tuple[int, int]] | None
    ) -> Gaussians:
        """The Gaussians in ranges of rows, all where None."""
        shapes = shapes_of(row)
        if row.thinned is None:
            read = self._arrays.read(KIND, row.group_id, files, only=FIELDS, rows=ranges, shapes=shapes)
            return Gaussians(**read)
        by_row = [name for name in compact.shapes(0, 0) if name not in compact.WHOLE]
        read = self._arrays.read(KIND, row.group_id, files, only=by_row, rows=ranges, shapes=shapes)
        read |= self._arrays.read(KIND, row.group_id, files, only=compact.WHOLE, shapes=shapes)
        spans = [(0, row.num_gaussians)] if ranges is None else ranges
        rows = np.concatenate([np.arange(*span) for span in spans]) if spans else np.zeros(0, dtype=np.int64)
        return compact.unpack(read, rows)

    def thin(self, ref: str, shown: np.ndarray, *, up: Sequence[float] | None = None) -> Scene:
        """Keep a living scene compact, and its graphs no longer; durable when it returns.

        What it had before goes with the next prune, unless a branch names it. A scene that is compact already stays.

        Args:
            shown: (N,) bool, which of its Gaussians to keep, in the order they are read.
            up: (3,) against gravity in its frame, as its graph said.

        Raises:
            InputError: another number of Gaussians, or none to keep.
            NotFoundError: no such scene.
        """
        before = self.get(ref)
        if before.thinning is not None:
            return before
        if len(shown) != before.num_gaussians or not shown.any():
            counts = f"{int(shown.sum())} of {len(shown)} Gaussians"
            raise InputError(
                f"cannot keep {counts} of scene {before.name}, which has {before.num_gaussians}", code="cannot_keep"
            )
        own = self.gaussians(before.id)[shown]
        content = compact.pack(own) | compact.pack_kept(shown) | camera_arrays(self.cameras(before.id))
        boxes = chunk_boxes(own, CHUNK_ROWS, sigmas=_SIGMAS)
        group_id = digest(*content.values(), text=f"compact {before.id}")
        staging = self._arrays.stage(content, KIND, group_id)
        with explained(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            row = alive(connection, before.id)
            if row.thinned is None:
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
                about = {
                    "at": now(),
                    "num_gaussians": row.num_gaussians,
                    "up": None if up is None else list(up),
                    "row_map": True,
                }
                values = {"group_id": group_id, "num_gaussians": len(own), "thinned": about}
                connection.execute(update(scenes).where(scenes.c.id == row.id).values(**values))
                put_boxes(connection, row.number, boxes)
                drop_graphs(connection, row.id)
                unname(connection, row.group_id)
            return _with_tags(connection, find(connection, row.id))

    def num_bytes(self, ref: str) -> int:
        """Of a scene's arrays, as they were written."""
        with self._catalog.read() as connection:
            return num_bytes(connection, find(connection, ref).group_id)

    def cameras(self, ref: str) -> Cameras:
        """Read a scene's cameras.

        Raises:
            CorruptError, NotFoundError: as `gaussians`.
        """
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)
        names = ("cameras.T_frame_camera", "cameras.intrinsics_px", "cameras.sizes_px", "cameras.names")
        with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
            arrays = self._arrays.read(KIND, row.group_id, files, only=names, shapes=shapes_of(row))
        pose, intrinsics, sizes, text_bytes = arrays.values()
        try:
            image_names = tuple(text_bytes.tobytes().decode().split("\n")) if len(pose) else ()
        except UnicodeDecodeError as error:
            raise CorruptError(
                f"scene {row.name}: the names of its cameras are no text: ingest it again", code="catalog_invalid"
            ) from error
        return Cameras(pose, intrinsics, sizes, image_names, bool(row.cameras_synthesised))

    def remove(self, ref: str) -> Scene:
        """Leave a tombstone: gone from lists and from the next revision, its bytes kept until they are pruned."""
        with self._catalog.write() as connection:
            row = alive(connection, ref)
            connection.execute(update(scenes).where(scenes.c.id == row.id).values(removed_at=now()))
            return _with_tags(connection, row)

    def restore(self, ref: str) -> Scene:
        """Let a removed scene live again, with all that is known of it; where its name is taken now it is ``name-2``.

        Args:
            ref: its id, the beginning of it, or its last name.

        Raises:
            NotFoundError: no removed scene is called so, several are, or its arrays were pruned.
            InputError: it was not removed.
            CorruptError: its arrays are damaged.
        """
        with self._catalog.write() as connection:
            row = find_removed(connection, ref)
            files = manifest(connection, row.group_id or "")
            if not files:
                raise NotFoundError(
                    f"the arrays of scene {row.name} ({row.id}) were pruned: bring them from another map, a branch or "
                    "a restored backup with --from, or ingest its capture again",
                    code="arrays_pruned",
                )
            problems = self._arrays.problems(KIND, row.group_id, files)
            if problems:
                raise CorruptError(
                    f"scene {row.name} stays removed, its arrays are damaged: {problems[0]}", code="arrays_corrupt"
                )
            name = free_name(connection, row.name)
            back = {"removed_at": None, "ingested_at": now(), "name": name}
            connection.execute(update(scenes).where(scenes.c.id == row.id).values(**back))
            if name != row.name:
                facts.say(connection, row.id, [("name", name)])
            return _with_tags(connection, find(connection, row.id))

    def find_any(self, ref: str) -> Scene:
        """A scene by name, id or the beginning of its id, living or else removed.

        Raises:
            NotFoundError: none, or several are called so.
        """
        with self._catalog.read() as connection:
            with contextlib.suppress(NotFoundError):
                return _with_tags(connection, find(connection, ref))
            return _with_tags(connection, find_removed(connection, ref))

    def _dated(self, known_id: str, captured_at: str | None, dated_by: str) -> Scene:
        """A living scene that was ingested again, with the date that came this time.

        What a file says does not overrule what was said before: a person may have corrected it or taken it back.
        """
        if captured_at is None or (dated_by and any(fact.kind == "captured_at" for fact in self.facts(known_id))):
            return self.get(known_id)
        return self.edit(known_id, captured_at=captured_at, author=dated_by)

    def _enter(self, connection: Connection, new_id: str, fields: dict[str, Any], rename: bool, dated_by: str) -> Scene:
        """The row of a new or returning scene, under a name that is free."""
        wanted, name = fields["name"], free_name(connection, fields["name"])
        if name != wanted and not rename:
            raise InputError(
                f"another scene is called {wanted!r}: choose another name, or remove that one first", code="name_taken"
            )
        fields = fields | {"name": name, "ingested_at": now(), "removed_at": None}
        before = by_id(connection, new_id)
        if before is None:
            connection.execute(insert(scenes), fields | {"id": new_id})
        else:
            connection.execute(update(scenes).where(scenes.c.id == new_id).values(**fields))
        facts.say(connection, new_id, [("name", name)])
        if fields["captured_at"] or (before is not None and before.captured_at):
            facts.say(connection, new_id, [("captured_at", fields["captured_at"] or "")], dated_by)
        return _with_tags(connection, find(connection, new_id))


def _rows_of(column: np.ndarray, spans: Sequence[tuple[int, int]]) -> np.ndarray:
    """The rows of a column that lie in ranges, in order."""
    return np.concatenate([column[:0], *(column[start:stop] for start, stop in spans)])


def _manifest(connection: Connection, row: Row[Any]) -> tuple[StoredFile, ...]:
    if row.group_id is None:
        raise NotFoundError(
            f"scene {row.name!r} was removed and its arrays were pruned: ingest it again", code="scene_removed"
        )
    return manifest(connection, row.group_id)


def _with_tags(connection: Connection, row: Row[Any]) -> Scene:
    return scene_of(row, facts.tags(connection, row.id).get(row.id, ()))
