"""Read rows of comparisons and changes, and match changes between comparisons."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, select

from gsmap.geometry.boxes import box_overlaps, moved_box
from gsmap.store.matrices import to_array, to_pose
from gsmap.store.schema import change_reviews, changes, comparisons, scenes
from gsmap.types import Sim3
from gsmap.types.change import ChangeKind, Symmetry

KIND = "changes"
OPEN = "open"
_STATUS = {None: OPEN, "confirm": "confirmed", "reject": "rejected"}

# Minimum intersection over union of the boxes of one change in two comparisons, each padded by half a voxel of 10 cm
# because the box of a picture on a wall has almost no thickness.
_MIN_OVERLAP = 0.1
_PAD_M = 0.05


@dataclass(frozen=True, eq=False)
class StoredChange:
    """A change as the newest comparison of its pair found it.

    Args:
        number: of the change; kept when its pair is compared again.
        older, newer: scene ids.
        kind, box, S_after_before, symmetry, confidence, evidence: as in `gsmap.types.change.Change`, with lengths and
            frames of the comparison.
        num_voxels, num_before, num_after: lengths of its arrays.
        status: review status: ``open``, ``confirmed`` or ``rejected``.
        comparison: number of the comparison, and ``place`` in it.
    """

    number: int
    older: str
    newer: str
    kind: ChangeKind
    box: np.ndarray
    S_after_before: Sim3 | None
    symmetry: Symmetry
    confidence: float
    evidence: Mapping[str, float]
    num_voxels: int
    num_before: int
    num_after: int
    status: str
    comparison: int
    place: int


@dataclass(frozen=True, eq=False)
class Comparison:
    """A comparison of two scenes, without its arrays (`Changes.load`).

    Args:
        number: unique in the map, growing.
        older, newer: scene ids.
        key: `RecipeKey.digest`; the two scenes are its inputs.
        recipe: digest of its recipe.
        S_newer_older: the relative pose used for it.
        S_frame_newer: transforms the newer scene to the frame of the boxes; in metres if the map is metric.
        seen_share, gains, notes: as in `gsmap.types.change.ChangeReport`.
        changes: the changes, most confident first.
        whole: its arrays are still stored.
    """

    number: int
    older: str
    newer: str
    key: str
    recipe: str | None
    S_newer_older: Sim3
    S_frame_newer: Sim3
    seen_share: float
    gains: np.ndarray
    notes: tuple[str, ...]
    changes: tuple[StoredChange, ...]
    whole: bool
    created_at: str


@dataclass(frozen=True)
class ChangeReview:
    """A person's review of a change: ``confirm``, ``reject`` or ``withdraw``."""

    review: str
    note: str
    created_at: str


def pair_of(older: str, newer: str) -> str:
    """Return the ids of a pair joined by a colon, the lower id first."""
    return ":".join(sorted((older, newer)))


def newest(connection: Connection, pair: str) -> Row[Any] | None:
    """Return the current comparison of a pair; None if there is none."""
    query = select(comparisons).where(comparisons.c.pair == pair)
    return connection.execute(query.order_by(comparisons.c.created_at.desc(), comparisons.c.number.desc())).first()


def newest_of_all(connection: Connection) -> list[Row[Any]]:
    """Return the current comparison of every pair, also of removed scenes, in the order of comparison."""
    query = select(comparisons).order_by(comparisons.c.created_at, comparisons.c.number)
    return list({row.pair: row for row in connection.execute(query)}.values())


def named_groups(
    ours: Connection, theirs: Connection, only: Collection[str] | None
) -> Iterator[tuple[str, str, str | None]]:
    """Yield (kind, scene, group) of the change arrays to copy between maps: those of current comparisons of scenes that
    are present or copied along.

    Args:
        only: ids of the scenes to copy; None for all.
    """
    here = set(ours.execute(select(scenes.c.id)).scalars())
    for row in newest_of_all(theirs):
        ends = {row.older, row.newer}
        if only is None or ends <= here | set(only):
            yield from ((KIND, end, row.group_id) for end in ends)


def match_changes(
    connection: Connection, older: str, newer: str, S_frame_newer: Sim3, found: Sequence[tuple[str, np.ndarray]]
) -> dict[int, int]:
    """Match new changes of a pair (``found``) to its earlier changes; return the change numbers by index in ``found``.

    Args:
        found: kind and box of each change, in the frame that ``S_frame_newer`` transforms the newer scene to.
    """
    boxes: list[tuple[float, int, int]] = []
    for number, old, pose in latest_changes(connection, pair_of(older, newer)):
        if old.older != older:
            continue  # the dates were corrected, so that appeared and disappeared are swapped
        moved = moved_box(old.box, S_frame_newer @ pose.inverse())
        for i, (kind, box) in enumerate(found):
            if (
                kind == old.kind
                and (share := float(box_overlaps(moved[None], box[None], _PAD_M)[0, 0])) >= _MIN_OVERLAP
            ):
                boxes.append((-share, number, i))
    same: dict[int, int] = {}
    for _, number, i in sorted(boxes):
        if i not in same and number not in same.values():
            same[i] = number
    return same


def latest_changes(connection: Connection, pair: str) -> list[tuple[int, StoredChange, Sim3]]:
    """Return every change that a pair ever had as it was last found, with its number and its ``S_frame_newer``."""
    query = select(comparisons).where(comparisons.c.pair == pair)
    rows = connection.execute(query.order_by(comparisons.c.created_at, comparisons.c.number)).all()
    latest: dict[int, tuple[int, StoredChange, Sim3]] = {}
    for one in read_comparisons(connection, rows):
        latest |= {change.number: (change.number, change, one.S_frame_newer) for change in one.changes}
    return list(latest.values())


def review_notes(connection: Connection, pair: str, same: Mapping[int, int]) -> list[str]:
    """Return notes on the reviewed changes of a pair that was compared again."""
    notes = []
    for number, change, _ in latest_changes(connection, pair):
        if change.status == OPEN:
            continue
        if number in same.values():
            notes.append(f"c{number} was {change.status} before this comparison, and stays {change.status}")
        else:
            notes.append(f"c{number}, which was {change.status}, was not detected again")
    return notes


def read_comparison(connection: Connection, row: Row[Any]) -> Comparison:
    return read_comparisons(connection, [row])[0]


def read_comparisons(connection: Connection, rows: Sequence[Row[Any]]) -> list[Comparison]:
    """Return comparisons with their changes and the status of each change."""
    wanted = {row.number: row for row in rows}
    query = select(changes).order_by(changes.c.comparison, changes.c.place)
    if len(wanted) == 1:
        query = query.where(changes.c.comparison == next(iter(wanted)))
    in_force: dict[int, str | None] = {}
    ordered = select(change_reviews).order_by(change_reviews.c.created_at, change_reviews.c.number)
    for review in connection.execute(ordered):
        in_force[review.change] = None if review.review == "withdraw" else review.review
    of: dict[int, list[StoredChange]] = {number: [] for number in wanted}
    for line in connection.execute(query):
        if line.comparison in wanted:
            of[line.comparison].append(_stored(line, wanted[line.comparison], in_force))
    return [
        Comparison(
            number=row.number,
            older=row.older,
            newer=row.newer,
            key=row.key,
            recipe=row.recipe,
            S_newer_older=to_pose(row.S_newer_older),
            S_frame_newer=to_pose(row.S_frame_newer),
            seen_share=row.seen_share,
            gains=to_array(row.gains),
            notes=tuple(row.notes),
            changes=tuple(of[row.number]),
            whole=row.group_id is not None or not of[row.number],
            created_at=row.created_at,
        )
        for row in rows
    ]


def _stored(line: Row[Any], row: Row[Any], in_force: Mapping[int, str | None]) -> StoredChange:
    number = line.number if line.same_as is None else line.same_as
    return StoredChange(
        number=number,
        older=row.older,
        newer=row.newer,
        kind=line.kind,
        box=to_array(line.box),
        S_after_before=to_pose(line.S_after_before),
        symmetry=line.symmetry,
        confidence=line.confidence,
        evidence=line.evidence,
        num_voxels=line.num_voxels,
        num_before=line.num_before,
        num_after=line.num_after,
        status=_STATUS[in_force.get(number)],
        comparison=row.number,
        place=line.place,
    )
