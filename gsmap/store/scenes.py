"""The scenes of a map: adding, editing, thinning, removing and reading them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, Unpack

import numpy as np
from sqlalchemy import Connection, Row, Text, insert, select, true, type_coerce, update

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.geometry.boxes import inside
from gsmap.geometry.transforms import transform_cameras
from gsmap.store import compact, facts
from gsmap.store.array_archive import StreamedArray
from gsmap.store.array_groups import forget_derived, has_group, manifest, num_bytes, publish, unless_pruned, unname
from gsmap.store.arrays import Arrays, StoredFile, digest
from gsmap.store.catalog import Catalog, next_timestamp, now
from gsmap.store.chunk_boxes import chunk_boxes, chunks_touching, get_boxes, put_boxes, row_ranges
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.facts import Fact
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.scene_content import (
    LENSES,
    GaussianBlocks,
    StoredGaussians,
    UnreadGaussians,
    camera_arrays,
    fields_of,
    lenses_of,
    scene_id,
    scene_of,
    shapes_of,
    stored_names,
    thinning_of,
)
from gsmap.store.scene_refs import by_id, find, find_any, find_living, find_removed, name_taken, unused_name
from gsmap.store.schema import FACT_COLUMNS, scenes
from gsmap.stream import bounds as bounds_of
from gsmap.stream import shift_origin, sorted_along_morton_curve
from gsmap.types import Cameras, Gaussians, GaussianSource, Scene, Sim3, Thinning
from gsmap.types.gaussians import FIELDS
from gsmap.types.scene import SceneEdits
from gsmap.types.source import ChunkSource, origin_of_source

KIND = "scenes"
_SIGMAS = 3.0


class SceneSummary(NamedTuple):  # created for all scenes several times per update: faster than a dataclass
    """The fields of a scene that every update needs; reading a whole `Scene` takes ten times as long."""

    id: str
    name: str
    scale_policy: str
    captured_at: str | None
    thinning: Thinning | None


class Scenes:
    """The scenes of a map. A *reference* is a scene's id, its name, or a unique prefix of its id of 6 digits and more.

    Names are unique among living scenes, not empty, and have no control characters. A name may contain a colon: parsers
    of ``A:B`` must try every colon as the separator.
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
    ) -> tuple[Scene, bool]:
        """Add a scene; durable when it returns.

        Args:
            gaussians, cameras: in the scene frame, whose origin is that of the Gaussians; already validated
                (`gsmap.ingest.validate`). Gaussians that are not in memory need no more of it than
                `gsmap.stream.morton_sort.BUCKET_BYTES` and a few bytes each.
            captured_at: ISO 8601; default time zone UTC.
            dated_by: source of the date; empty if the user specified it.
            name: if it is in use, ``name-2`` and so on is taken.

        Returns:
            The scene, and True if its content was written. Content that is already in the map is not written, though a
                date from the user replaces the scene's, and a date read from a file is taken if the scene never had
                one. Removed content returns under the new name, and damaged content is repaired.

        Raises:
            InputError: no Gaussians, or an invalid name or date.
        """
        facts.validated_scene_name(name)
        captured_at = None if captured_at is None else facts.validated_date(captured_at)
        if not gaussians.num_gaussians:
            raise InputError(f"scene {name!r} has no Gaussians", code="no_gaussians")
        new_id = scene_id(gaussians, cameras)
        with self._catalog.read() as connection:
            row = by_id(connection, new_id)
            files = manifest(connection, new_id)
        stored = bool(files) and not self._arrays.problems(KIND, new_id, files)
        if row is not None and row.removed_at is None and stored:
            return self._update_date(row.id, captured_at, dated_by), False
        box, origin = bounds_of(gaussians), origin_of_source(gaussians)
        if origin.any() and row is None:
            # Releases without origins stored large coordinates rounded to single precision.
            before = scene_id(shift_origin(gaussians, np.zeros(3)), transform_cameras(cameras, Sim3(np.eye(3), origin)))
            with self._catalog.read() as connection:
                row = by_id(connection, before)
            if row is not None and row.removed_at is None:
                return self._update_date(before, captured_at, dated_by), False
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
        if stored:  # removed but not pruned
            with self._catalog.write() as connection:
                if has_group(connection, new_id):
                    return self._insert_scene(connection, new_id, fields, dated_by), True
        with contextlib.ExitStack() as until_end:
            until_end.enter_context(translate_errors(self._catalog.folder, NOT_KEPT))
            with self._arrays.scratch() as scratch, sorted_along_morton_curve(gaussians, box, scratch) as ordered:
                content = GaussianBlocks(ordered, CHUNK_ROWS)
                arrays: dict[str, np.ndarray | StreamedArray] = {**content.arrays, **camera_arrays(cameras)}
                staging = self._arrays.stage(arrays, KIND, new_id)
                staged = until_end.enter_context(staging)
            connection = until_end.enter_context(self._catalog.write())
            row = by_id(connection, new_id)
            if row is not None and row.removed_at is None:
                scene = self._update_date(new_id, captured_at, dated_by)
                if manifest(connection, new_id) != files:  # added by another process meanwhile
                    return scene, False
                # otherwise its bytes are damaged
            else:
                scene = self._insert_scene(connection, new_id, fields, dated_by)
            publish(self._catalog, connection, self._arrays, staged, KIND, new_id)
            if row is not None and row.thinned is not None:
                forget_derived(connection, new_id)  # computed from the compact Gaussians, which have other rows
            number = connection.execute(select(scenes.c.number).where(scenes.c.id == new_id)).scalar_one()
            put_boxes(connection, number, content.boxes())
            whole = {"group_id": new_id, "num_gaussians": gaussians.num_gaussians, "thinned": None}
            connection.execute(update(scenes).where(scenes.c.id == new_id).values(**whole))
            scene = _with_tags(connection, find(connection, new_id))
        return scene, True

    def summaries(self) -> list[SceneSummary]:
        """Return summaries of the living scenes, in the order of ingest."""
        columns = (scenes.c.id, scenes.c.name, scenes.c.scale_policy, scenes.c.captured_at, scenes.c.thinned)
        query = select(*columns).where(scenes.c.removed_at.is_(None)).order_by(scenes.c.number)
        with self._catalog.read() as connection:
            rows = connection.execute(query).all()
        return [
            SceneSummary(scene, name, policy, captured_at, thinning_of(thinned))
            for scene, name, policy, captured_at, thinned in rows
        ]

    def bounds(self) -> dict[str, np.ndarray]:
        """Return the (2, 3) bounds of every living scene by its id, as in `Scene`."""
        living = scenes.c.removed_at.is_(None)
        query = select(scenes.c.id, type_coerce(scenes.c.bounds, Text).label("bounds")).where(living)
        with self._catalog.read() as connection:
            rows = connection.execute(query).all()
            try:  # parsed at once: ten times faster
                boxes = np.array(json.loads(f"[{','.join(row.bounds for row in rows)}]"))
                if boxes.shape == (len(rows), 2, 3) and boxes.dtype == np.float64:
                    return {row.id: box for row, box in zip(rows, boxes, strict=True)}
            except (ValueError, TypeError, RecursionError):
                pass  # one of them is not a box: the column type below reports it
            boxed = connection.execute(select(scenes.c.id, scenes.c.bounds).where(living))
            return {row.id: np.array(row.bounds, dtype=np.float64) for row in boxed}

    def list(self, *, removed: bool = False, among: Collection[str] | None = None) -> list[Scene]:
        """Return the living scenes, or the removed scenes, in the order of ingest.

        Args:
            among: only scenes with these ids.
        """
        condition = scenes.c.removed_at.is_not(None) if removed else scenes.c.removed_at.is_(None)
        among_these = true() if among is None else scenes.c.id.in_(sorted(among))
        with self._catalog.read() as connection:
            tags = facts.current_tags(connection)
            rows = connection.execute(select(scenes).where(condition, among_these).order_by(scenes.c.number))
            return [scene_of(row, tags.get(row.id, ())) for row in rows]

    def names(self) -> dict[str, str]:
        """Return the name of every scene by its id, including removed scenes."""
        with self._catalog.read() as connection:
            return {row[0]: row[1] for row in connection.execute(select(scenes.c.id, scenes.c.name)).all()}

    def get(self, ref: str) -> Scene:
        """Return a scene by name, id or unique id prefix, and a removed scene by its full id only.

        Raises:
            NotFoundError: no scene matches, or several do.
        """
        with self._catalog.read() as connection:
            return _with_tags(connection, find(connection, ref))

    def edit(
        self,
        ref: str,
        *,
        tags_add: Iterable[str] = (),
        tags_remove: Iterable[str] = (),
        author: str = "",
        **edits: Unpack[SceneEdits],
    ) -> Scene:
        """Edit a living scene; earlier values stay in its `facts`.

        Args:
            tags_add, tags_remove: single words or short phrases.
            author: of the facts.
            edits: new values.

        Raises:
            NotFoundError: no such scene, it was removed, or it lacks a tag to remove.
            InputError: an empty text, control characters, an invalid date or scale, or a name in use.
        """
        new = facts.validated_facts(edits)
        new += [("tag", facts.validated_text("a tag", tag).strip()) for tag in tags_add]
        new += [("untag", facts.validated_text("a tag", tag).strip()) for tag in tags_remove]
        if author:
            facts.validated_text("an author", author)
        with self._catalog.write() as connection:
            row = find_living(connection, ref)
            tags = set(facts.current_tags(connection, row.id).get(row.id, ()))
            same = {(kind, getattr(row, kind) or "") for kind in FACT_COLUMNS} | {("tag", tag) for tag in tags}
            same |= {("metres_per_unit", facts.specified_metres(connection).get(row.id, ""))}
            new = [fact for fact in dict.fromkeys(new) if fact not in same]
            for kind, value in new:
                if kind == "name" and name_taken(connection, value):
                    raise InputError(
                        f"another scene has the name {value!r}: choose another name, or rename that scene",
                        code="name_taken",
                    )
                if kind == "untag" and value not in tags:
                    raise NotFoundError(
                        f"scene {row.name!r} has no tag {value!r}: it has {sorted(tags) or 'none'}",
                        code="tag_not_found",
                    )
            facts.add_facts(connection, row.id, new, author)
            columns = {kind: value or None for kind, value in new if kind in FACT_COLUMNS}
            if columns:
                connection.execute(update(scenes).where(scenes.c.id == row.id).values(**columns))
            return _with_tags(connection, find(connection, row.id))

    def facts(self, ref: str) -> Sequence[Fact]:
        """Return all facts about a scene, oldest first."""
        with self._catalog.read() as connection:
            return facts.list_facts(connection, find(connection, ref).id)

    def specified_metres(self) -> dict[str, float]:
        """Return the metres per unit, by scene id, of scenes with a specified scale."""
        with self._catalog.read() as connection:
            return {scene: float(value) for scene, value in facts.specified_metres(connection).items()}

    def latest_notes(self) -> dict[str, str]:
        """Return the newest note, by scene id, of scenes that have notes."""
        with self._catalog.read() as connection:
            return facts.latest_notes(connection)

    def notes(self, ref: str) -> tuple[str, ...]:
        """Return the remarks from the ingest of a scene."""
        with self._catalog.read() as connection:
            return tuple(find(connection, ref).notes)

    def removed_at(self, ref: str) -> str | None:
        """Return the time at which a scene was removed; None for a living scene."""
        with self._catalog.read() as connection:
            when: str | None = find(connection, ref).removed_at
            return when

    def gaussians(self, ref: str, bounds: np.ndarray | None = None, without: np.ndarray | None = None) -> Gaussians:
        """Read a scene's Gaussians (Morton order).

        Args:
            bounds: (2, 3) lowest and highest corner in the scene frame: only Gaussians within three standard deviations
                (the largest) of the box are returned, and only the chunks that touch it are read.
            without: (N,) bool, Gaussians to leave out.

        Raises:
            CorruptError: bytes on disk are missing or differ.
            NotFoundError: no such scene, or its arrays were pruned.
        """
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)
            chunks = None if bounds is None else chunks_touching(connection, row.number, np.asarray(bounds, np.float64))
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
        """Read the Gaussians of a scene whose means lie in a box; read only means of chunks without such Gaussians.

        Args:
            bounds: (2, 3) lowest and highest corner in the scene frame.
            without: (N,) bool, Gaussians to leave out.

        Raises:
            CorruptError, NotFoundError: as `gaussians`.
        """
        bounds = np.asarray(bounds, np.float64)
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)
            chunks = chunks_touching(connection, row.number, bounds)
        spans = row_ranges(chunks, row.num_gaussians)
        with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
            means = self._fields(row, files, ["means"], spans)["means"]
            within = inside(means, bounds)
            if without is not None:
                within &= ~_rows_of(without, spans)
            begins = np.cumsum([0, *(min(CHUNK_ROWS, row.num_gaussians - chunk * CHUNK_ROWS) for chunk in chunks)])
            holds = np.logical_or.reduceat(within, begins[:-1]) if chunks else np.zeros(0, bool)
            held = np.repeat(holds, np.diff(begins))
            spans = row_ranges([chunk for chunk, some in zip(chunks, holds, strict=True) if some], row.num_gaussians)
            names = [name for name in FIELDS if name != "means"]
            others = self._fields(row, files, names, spans)
        out = Gaussians(means if held.all() else means[held], **others)
        return out if within.all() else out[within[held]]

    def source(self, ref: str) -> GaussianSource:
        """Return a scene's Gaussians (Morton order) as a source that reads a few chunks at a time.

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
            with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
                return self._fields(row, files, [name], [(start, stop)])[name]

        return StoredGaussians(row.num_gaussians, row.sh_degree, read, column)

    def chunks(self, ref: str) -> ChunkSource:
        """Return a scene's Gaussians (Morton order), to be read chunk by chunk.

        Raises:
            CorruptError, NotFoundError: as `gaussians`, now or when they are read.
        """
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)
            boxes = get_boxes(connection, row.number)
        if len(boxes) != -(-row.num_gaussians // CHUNK_ROWS):
            raise CorruptError(
                f"scene {row.name!r} lacks the boxes of its chunks: run gsmap check, and ingest it again",
                code="arrays_corrupt",
            )

        def read(fields: Sequence[str], start: int, stop: int, out: Gaussians) -> None:
            with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
                self._fields(row, files, fields, [(start, stop)], out)

        return ChunkSource(row.num_gaussians, row.sh_degree, boxes, CHUNK_ROWS, read)

    def _read(
        self, row: Row[Any], files: tuple[StoredFile, ...], ranges: Sequence[tuple[int, int]] | None
    ) -> Gaussians:
        """Read the Gaussians in ranges of rows, or all Gaussians."""
        return Gaussians(**self._fields(row, files, FIELDS, ranges))

    def _fields(
        self,
        row: Row[Any],
        files: tuple[StoredFile, ...],
        names: Sequence[str],
        ranges: Sequence[tuple[int, int]] | None = None,
        out: Gaussians | None = None,
    ) -> dict[str, np.ndarray]:
        """Read fields of the Gaussians (or ``sh0``) of a scene; into ``out`` if it is given."""
        whole = [(0, row.num_gaussians)] if ranges is None else ranges
        if row.thinned is not None:
            found = self._compact_fields(row, files, names, whole)
            for name in names if out is not None else ():
                getattr(out, name)[:] = found[name]
            return found
        only, optional = stored_names(names)
        count = sum(max(0, min(stop, row.num_gaussians) - start) for start, stop in whole)
        together: np.ndarray | None = None

        def target() -> dict[str, np.ndarray]:
            nonlocal together
            into = {} if out is None else {name: getattr(out, name) for name in names}
            if "sh" in names:
                shape = (count, (row.sh_degree + 1) ** 2, 3)
                together = np.empty(shape, np.float32) if out is None else out.sh
                into |= {"sh0": together[:, :1], "sh_rest": together[:, 1:]}
            return into

        read = self._arrays.read(
            KIND,
            row.group_id,
            files,
            only=only,
            optional=optional,
            rows=ranges,
            shapes=shapes_of(row),
            out=target,
        )
        try:
            return fields_of(read, names, together)
        except KeyError as error:
            raise CorruptError(
                f"scene {row.name!r} has no array {error}: run gsmap check, and ingest it again", code="arrays_corrupt"
            ) from error

    def _compact_fields(
        self, row: Row[Any], files: tuple[StoredFile, ...], names: Sequence[str], ranges: Sequence[tuple[int, int]]
    ) -> dict[str, np.ndarray]:
        by_row, whole = compact.arrays_of(names)
        read = partial(self._arrays.read, KIND, row.group_id, files, shapes=shapes_of(row))
        arrays = read(only=by_row, rows=ranges) | (read(only=whole) if whole else {})
        rows = np.concatenate([np.zeros(0, np.int64), *(np.arange(*span) for span in ranges)])
        return compact.unpack_fields(arrays, rows, names)

    def unread(self, ref: str) -> Gaussians:
        """Return a scene's Gaussians (Morton order), of which only the fields that are used are read.

        Raises:
            CorruptError, NotFoundError: as `gaussians`, now or when they are read.
        """
        with self._catalog.read() as connection:
            row = find(connection, ref)
            files = _manifest(connection, row)

        def read(names: Sequence[str]) -> dict[str, np.ndarray]:
            with unless_pruned(self._catalog, row.group_id, f"scene {row.name!r} was removed or thinned"):
                return self._fields(row, files, names)

        return UnreadGaussians.of(row.num_gaussians, row.sh_degree, read)

    def thin(self, ref: str, shown: np.ndarray, *, up: Sequence[float] | None = None) -> Scene:
        """Store a living scene compactly, with only some of its Gaussians, and delete its graphs; durable when it
        returns.

        The next prune reclaims the previous arrays, unless a branch names them. A scene that is compact already stays
        unchanged.

        Args:
            shown: (N,) bool, Gaussians to keep, in the order they are read.
            up: (3,) direction against gravity in the scene frame, from its graph.

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
        with translate_errors(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            row = find_living(connection, before.id)
            if row.thinned is None:
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
                about = {
                    "at": now(),
                    "num_gaussians": row.num_gaussians,
                    "up": None if up is None else list(up),
                }
                values = {"group_id": group_id, "num_gaussians": len(own), "thinned": about}
                connection.execute(update(scenes).where(scenes.c.id == row.id).values(**values))
                put_boxes(connection, row.number, boxes)
                forget_derived(connection, row.id)
                unname(connection, row.group_id)
            return _with_tags(connection, find(connection, row.id))

    def num_bytes(self, ref: str) -> int:
        """Return the size of a scene's arrays in bytes, as written."""
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
            arrays = self._arrays.read(KIND, row.group_id, files, only=names, optional=(LENSES,), shapes=shapes_of(row))
        pose, intrinsics, sizes, text_bytes = (arrays[name] for name in names)
        try:
            image_names = tuple(text_bytes.tobytes().decode().split("\n")) if len(pose) else ()
            lenses = lenses_of(arrays[LENSES], len(pose)) if LENSES in arrays else ()
        except (ValueError, TypeError, KeyError, RuntimeError, RecursionError) as error:
            raise CorruptError(
                f"scene {row.name}: the names or lenses of its cameras are not valid text: ingest it again",
                code="catalog_invalid",
            ) from error
        return Cameras(pose, intrinsics, sizes, image_names, bool(row.cameras_synthesised), lenses=lenses)

    def remove(self, ref: str) -> Scene:
        """Remove a scene from lists and the next revision, leaving a tombstone; `prune` deletes its arrays later."""
        with self._catalog.write() as connection:
            row = find_living(connection, ref)
            # A merge compares both times: the later of removing and restoring counts, whatever a clock said.
            when = next_timestamp(connection, scenes.c.ingested_at, scenes.c.id == row.id)
            connection.execute(update(scenes).where(scenes.c.id == row.id).values(removed_at=when))
            return _with_tags(connection, row)

    def restore(self, ref: str) -> Scene:
        """Restore a removed scene with all its data; append ``-2`` to its name if another scene has that name now.

        Args:
            ref: its id, an id prefix, or its last name.

        Raises:
            NotFoundError: no removed scene matches, several do, or its arrays were pruned.
            InputError: the scene was not removed.
            CorruptError: its arrays are damaged.
        """
        with self._catalog.write() as connection:
            row = find_removed(connection, ref)
            files = manifest(connection, row.group_id or "")
            if not files:
                raise NotFoundError(
                    f"the arrays of scene {row.name} ({row.id}) were pruned: restore them from another map, a "
                    "branch or a restored backup with --from, or ingest its capture again",
                    code="arrays_pruned",
                )
            problems = self._arrays.problems(KIND, row.group_id, files)
            if problems:
                raise CorruptError(
                    f"scene {row.name} stays removed because its arrays are damaged: {problems[0]}",
                    code="arrays_corrupt",
                )
            name = unused_name(connection, row.name)
            when = next_timestamp(connection, scenes.c.removed_at, scenes.c.id == row.id)
            back = {"removed_at": None, "ingested_at": when, "name": name}
            connection.execute(update(scenes).where(scenes.c.id == row.id).values(**back))
            if name != row.name:
                facts.add_facts(connection, row.id, [("name", name)])
            return _with_tags(connection, find(connection, row.id))

    def find_any(self, ref: str) -> Scene:
        """Return a scene by name, id or unique id prefix: a living scene, or else a removed scene.

        Raises:
            NotFoundError: no scene matches, or several do.
        """
        with self._catalog.read() as connection:
            return _with_tags(connection, find_any(connection, ref))

    def _update_date(self, known_id: str, captured_at: str | None, dated_by: str) -> Scene:
        """Update the date of a living scene that was ingested again.

        A date read from a file does not replace an earlier one: a person may have corrected or withdrawn it.
        """
        if captured_at is None or (dated_by and any(fact.kind == "captured_at" for fact in self.facts(known_id))):
            return self.get(known_id)
        return self.edit(known_id, captured_at=captured_at, author=dated_by)

    def _insert_scene(self, connection: Connection, new_id: str, fields: dict[str, Any], dated_by: str) -> Scene:
        """Insert the row of a new scene, or update that of a returning scene, under an unused name."""
        name = unused_name(connection, fields["name"])
        when = next_timestamp(connection, scenes.c.removed_at, scenes.c.id == new_id)
        fields = fields | {"name": name, "ingested_at": when, "removed_at": None}
        before = by_id(connection, new_id)
        if before is None:
            connection.execute(insert(scenes), fields | {"id": new_id})
        else:
            connection.execute(update(scenes).where(scenes.c.id == new_id).values(**fields))
        facts.add_facts(connection, new_id, [("name", name)])
        if fields["captured_at"] or (before is not None and before.captured_at):
            facts.add_facts(connection, new_id, [("captured_at", fields["captured_at"] or "")], dated_by)
        return _with_tags(connection, find(connection, new_id))


def _rows_of(column: np.ndarray, spans: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the rows of a column that lie in ranges, in order."""
    return np.concatenate([column[:0], *(column[start:stop] for start, stop in spans)])


def _manifest(connection: Connection, row: Row[Any]) -> tuple[StoredFile, ...]:
    if row.group_id is None:
        raise NotFoundError(
            f"scene {row.name!r} was removed and its arrays were pruned: ingest it again", code="scene_removed"
        )
    return manifest(connection, row.group_id)


def _with_tags(connection: Connection, row: Row[Any]) -> Scene:
    return scene_of(row, facts.current_tags(connection, row.id).get(row.id, ()))
