"""Comparisons of scenes, the changes that they found, and reviews of changes; rows are never overwritten."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from sqlalchemy import insert, select

from gsmap.errors import ConfigError, CorruptError, InputError, NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.array_groups import manifest, publish, unless_pruned
from gsmap.store.arrays import Arrays, digest
from gsmap.store.catalog import Catalog, next_timestamp
from gsmap.store.change_rows import (
    KIND,
    OPEN,
    ChangeReview,
    Comparison,
    StoredChange,
    match_changes,
    newest,
    newest_of_all,
    pair_of,
    read_comparison,
    read_comparisons,
    review_notes,
)
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.layout import Shape
from gsmap.store.matrices import from_array, from_pose
from gsmap.store.row_index_maps import RowIndexMaps
from gsmap.store.scene_refs import living_ids, resolve, scene_name
from gsmap.store.schema import change_reviews, changes, comparisons, scenes
from gsmap.types import Sim3
from gsmap.types.change import Change, ChangeReport
from gsmap.types.plain import plain

REVIEWS = ("confirm", "reject", "withdraw")
_NUMBER = re.compile(r"c(\d{1,9})")


def number_of(text: str) -> int | None:
    """Parse the number of a change from its id (``c12``); None for other texts."""
    found = _NUMBER.fullmatch(text)
    return None if found is None else int(found[1])


class Changes:
    """The changes of a map. The newest comparison of a pair is current, even if the scenes' dates were swapped since.

    A change keeps its number and reviews when its pair is compared again: it is matched to the earlier change of the
    same kind whose box overlaps most.
    """

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays
        self._rows = RowIndexMaps(catalog, arrays)

    def save(
        self,
        report: ChangeReport,
        key: RecipeKey,
        *,
        older: str,
        newer: str,
        S_newer_older: Sim3,
        S_frame_newer: Sim3,
        num_at_comparison: tuple[int, int] | None = None,
    ) -> Comparison:
        """Store a comparison; saving the same comparison again repairs its damaged arrays.

        Args:
            key: its recipe; its inputs begin with the two scenes, the older one first.
            older, newer: scene ids.
            S_newer_older, S_frame_newer: see `Comparison`.
            num_at_comparison: numbers of Gaussians of the older and newer scene when they were compared, to which the
                rows of the report refer; default: the current numbers.

        Raises:
            InputError: the key has other scenes, both scenes are the same, or a scene was thinned or ingested again
                since the comparison.
            NotFoundError: a scene is not in the map.
        """
        if key.inputs[:2] != (older, newer) or older == newer:
            raise InputError(
                f"the key of a comparison must have its two scenes {older} and {newer} as its first inputs",
                code="key_input_mismatch",
            )
        whole = self._whole(report.changes, older, newer, num_at_comparison)
        arrays = _to_arrays(whole)
        text = f"{key.digest}{from_pose(S_newer_older)}{from_pose(S_frame_newer)}"
        group_id = digest(*arrays.values(), text=text) if report.changes else None
        row = {
            "older": older,
            "newer": newer,
            "pair": pair_of(older, newer),
            "key": key.digest,
            "S_newer_older": from_pose(S_newer_older),
            "S_frame_newer": from_pose(S_frame_newer),
            "seen_share": float(report.seen_share),
            "gains": from_array(np.asarray(report.gains)),
            "group_id": group_id,
        }
        staging = self._arrays.stage(arrays, KIND, group_id) if group_id is not None else contextlib.nullcontext()
        with translate_errors(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            for scene in (older, newer):
                resolve(connection, scene)
            known = manifest(connection, group_id or "")
            if group_id is not None and staged and (not known or self._arrays.problems(KIND, group_id, known)):
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
            before = newest(connection, pair_of(older, newer))
            same = ("older", "newer", "key", "group_id", "S_newer_older", "S_frame_newer")
            if before is not None and all(getattr(before, name) == row[name] for name in same):
                return read_comparison(connection, before)
            boxes = [(change.kind, np.asarray(change.box)) for change in report.changes]
            known_numbers = match_changes(connection, older, newer, S_frame_newer, boxes)
            made = {
                "recipe": recipes.save_recipe(connection, key),
                "notes": [*report.notes, *review_notes(connection, pair_of(older, newer), known_numbers)],
                "created_at": next_timestamp(
                    connection, comparisons.c.created_at, comparisons.c.pair == pair_of(older, newer)
                ),
            }
            number = connection.execute(insert(comparisons).returning(comparisons.c.number), row | made).scalar_one()
            lines = [
                {
                    "comparison": number,
                    "place": i,
                    "same_as": known_numbers.get(i),
                    "kind": change.kind,
                    "box": from_array(change.box),
                    "S_after_before": from_pose(change.S_after_before),
                    "symmetry": change.symmetry,
                    "confidence": float(change.confidence),
                    **{f"num_{name}": len(getattr(whole[i], name)) for name in _PARTS},
                    "evidence": {name: float(value) for name, value in plain(dict(change.evidence)).items()},
                }
                for i, change in enumerate(report.changes)
            ]
            if lines:
                connection.execute(insert(changes), lines)
            stored = connection.execute(select(comparisons).where(comparisons.c.number == number)).one()
            return read_comparison(connection, stored)

    def current(self) -> list[Comparison]:
        """Return the current comparison of every pair of living scenes, in the order of comparison."""
        with self._catalog.read() as connection:
            living = living_ids(connection)
            rows = [row for row in newest_of_all(connection) if {row.older, row.newer} <= living]
            return read_comparisons(connection, rows)

    def comparison(self, number: int) -> Comparison:
        """Return a comparison by its number.

        Raises:
            NotFoundError: no such comparison.
        """
        with self._catalog.read() as connection:
            row = connection.execute(select(comparisons).where(comparisons.c.number == number)).first()
            if row is None:
                raise NotFoundError(f"this map has no comparison {number}", code="change_not_found")
            return read_comparison(connection, row)

    def load(self, comparison: int) -> ChangeReport:
        """Load a comparison with its arrays; row numbers refer to the Gaussians of the scenes as they are stored now.

        Raises:
            NotFoundError: no such comparison, or it has no arrays (pruned, or a capture was ingested again).
            CorruptError: bytes on disk are missing or differ, or are not valid results of a comparison.
        """
        with self._catalog.read() as connection:
            found = self.comparison(comparison)
            group = select(comparisons.c.group_id).where(comparisons.c.number == comparison)
            group_id = connection.execute(group).scalar_one() or ""
            files = manifest(connection, group_id)
            # Stored rows refer to the whole capture (`gsmap.store.row_index_maps`).
            sizes = {
                row.id: row.num_gaussians if row.thinned is None else row.thinned["num_gaussians"]
                for row in connection.execute(select(scenes))
            }
        if not found.whole:
            raise NotFoundError(
                f"the changes of comparison {comparison} have no arrays, because they were pruned or one of the "
                "captures was ingested again: run gsmap changes MAP, which compares them again",
                code="arrays_pruned",
            )
        parts: list[dict[str, np.ndarray]] = []
        if found.changes:
            counts = _counts(found.changes)
            shapes: dict[str, Shape] = {name: (sum(counts[name]), *_PARTS[name][0][1:]) for name in _PARTS}
            with unless_pruned(self._catalog, group_id, f"comparison {comparison} was dropped or computed again"):
                arrays = self._arrays.read(KIND, group_id, files, only=tuple(shapes), shapes=shapes)
            where = f"{KIND}/{group_id}"
            parts = _parts(arrays, found.changes, sizes[found.older], sizes[found.newer], where)
            before, after = self._rows.of(found.older), self._rows.of(found.newer)
            parts = [
                part | {"before": before.kept(part["before"]), "after": after.kept(part["after"])} for part in parts
            ]
        of_type = (_change(stored, part) for stored, part in zip(found.changes, parts, strict=True))
        return ChangeReport(tuple(of_type), found.seen_share, found.gains, found.notes)

    def _whole(
        self, found: Sequence[Change], older: str, newer: str, num_at_comparison: tuple[int, int] | None
    ) -> list[Change]:
        """Convert row numbers of changes to rows of the whole captures; see `gsmap.store.row_index_maps`."""
        if not found:
            return []
        before, after = self._rows.of(older), self._rows.of(newer)
        of_older, of_newer = (None, None) if num_at_comparison is None else num_at_comparison
        return [
            replace(one, before=before.whole(one.before, of_older), after=after.whole(one.after, of_newer))
            for one in found
        ]

    def damaged(self, numbers: Iterable[int]) -> set[int]:
        """Return the numbers of the comparisons whose arrays differ from their digests; reads every byte."""
        with self._catalog.read() as connection:
            query = select(comparisons.c.number, comparisons.c.group_id).where(comparisons.c.group_id.is_not(None))
            groups = {row.number: row.group_id for row in connection.execute(query)}
            return {
                number
                for number in numbers
                if number in groups
                and self._arrays.problems(KIND, groups[number], manifest(connection, groups[number]))
            }

    def get(self, number: int) -> StoredChange:
        """Return a change by its number, as the newest comparison found it.

        Raises:
            NotFoundError: no such change, its scenes were removed, or the newest comparison of its pair did not find
                it.
        """
        with self._catalog.read() as connection:
            row = connection.execute(
                select(comparisons.c.pair)
                .join(changes, changes.c.comparison == comparisons.c.number)
                .where(changes.c.number == number, changes.c.same_as.is_(None))
            ).first()
            if row is None:
                raise NotFoundError(
                    f"this map has no change c{number}: gsmap changes MAP lists them", code="change_not_found"
                )
            found = newest(connection, row.pair)
            assert found is not None
            for change in read_comparison(connection, found).changes:
                if change.number == number:
                    return change
            names = " and ".join(scene_name(connection, scene) for scene in (found.older, found.newer))
        raise NotFoundError(
            f"change c{number} no longer exists: {names} were compared again on {found.created_at}",
            code="change_not_found",
        )

    def review(self, number: int, review: str, note: str = "") -> StoredChange:
        """Store a person's review of a change: ``confirm``, ``reject``, or ``withdraw`` the last review.

        Raises:
            NotFoundError: see `get`.
            InputError: there is no review to withdraw.
            ConfigError: an unknown review.
        """
        if review not in REVIEWS:
            raise ConfigError(f"a review must be one of {', '.join(REVIEWS)}, got {review!r}", code="invalid_choice")
        with self._catalog.write() as connection:
            if review == "withdraw" and self.get(number).status == OPEN:
                raise InputError(f"c{number} has no review to withdraw", code="nothing_to_withdraw")
            self.get(number)
            when = next_timestamp(connection, change_reviews.c.created_at, change_reviews.c.change == number)
            row = {"change": number, "review": review, "note": note, "created_at": when}
            connection.execute(insert(change_reviews), row)
            return self.get(number)

    def reviews(self, number: int) -> list[ChangeReview]:
        """Return all reviews of a change, oldest first."""
        query = select(change_reviews).where(change_reviews.c.change == number)
        with self._catalog.read() as connection:
            rows = connection.execute(query.order_by(change_reviews.c.created_at, change_reviews.c.number))
            return [ChangeReview(row.review, row.note, row.created_at) for row in rows]


def _change(stored: StoredChange, part: Mapping[str, np.ndarray]) -> Change:
    return Change(
        stored.kind,
        stored.box,
        **part,
        S_after_before=stored.S_after_before,
        symmetry=stored.symmetry,
        confidence=stored.confidence,
        evidence=stored.evidence,
    )


_PARTS = {"voxels": ((0, 3), np.float32), "before": ((0,), np.int32), "after": ((0,), np.int32)}


def _to_arrays(found: Sequence[Change]) -> dict[str, np.ndarray]:
    """Concatenate the arrays of changes."""
    return {
        name: np.concatenate([np.zeros(shape, kind), *(np.asarray(getattr(one, name), dtype=kind) for one in found)])
        for name, (shape, kind) in _PARTS.items()
    }


def _parts(
    arrays: Mapping[str, np.ndarray], found: Sequence[StoredChange], older: int, newer: int, where: str
) -> list[dict[str, np.ndarray]]:
    """Split concatenated arrays by change: the inverse of `_to_arrays`.

    Args:
        older, newer: number of Gaussians of each scene.
        where: name of the group for messages.
    """
    most = {"before": older, "after": newer}
    fits = all(((arrays[name] >= 0) & (arrays[name] < count)).all() for name, count in most.items())
    if not fits or not np.isfinite(arrays["voxels"]).all():
        raise CorruptError(f"{where} is not a valid result of a comparison: run gsmap check", code="catalog_invalid")
    cut = {name: np.split(arrays[name], np.cumsum(counts)[:-1]) for name, counts in _counts(found).items()}
    return [{name: cut[name][i] for name in _PARTS} for i in range(len(found))]


def _counts(found: Sequence[StoredChange]) -> dict[str, list[int]]:
    return {name: [getattr(one, f"num_{name}") for one in found] for name in _PARTS}
