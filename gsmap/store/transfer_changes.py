"""Copy comparisons, changes and their reviews between maps, without computing anything."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from gsmap.store.change_rows import KIND, match_changes, newest_of_all
from gsmap.store.matrices import to_array, to_pose
from gsmap.store.schema import change_reviews, changes, comparisons, scenes
from gsmap.store.transfer import Transfer


def transfer_comparisons(transfer: Transfer) -> None:
    """Copy comparisons of the pairs whose scenes are both in this map now, with the reviews of their changes.

    For a pair compared in both maps all comparisons are kept, and the latest is current. A change of theirs that
    matches one of ours takes our number, so that their reviews are merged.
    """
    ours, theirs = transfer.ours, transfer.theirs
    here = set(ours.execute(select(scenes.c.id)).scalars())
    newest = {row.number for row in newest_of_all(theirs)}
    numbers: dict[int, int] = {}  # our change number by theirs
    query = select(comparisons).order_by(comparisons.c.created_at, comparisons.c.number)
    for row in theirs.execute(query).all():
        ends = {row.older, row.newer}
        if not (ends <= here and ends & transfer.wanted):
            continue
        group = row.group_id if row.number in newest else None
        transfer.transfer_group(KIND, group)
        mine = ours.execute(select(comparisons).where(*_same(row))).first()
        if mine is None:
            _add(transfer, row, group, numbers)
            continue
        if mine.group_id is None and group is not None:
            ours.execute(update(comparisons).where(comparisons.c.number == mine.number).values(group_id=group))
        numbers |= {
            _first(their_line): _first(line)
            for their_line, line in zip(_lines(theirs, row.number), _lines(ours, mine.number), strict=True)
        }
    _join_reviews(transfer, numbers)


def _same(row: Row[Any]) -> tuple[Any, ...]:
    """Return conditions by which the same comparison is found in another map."""
    return tuple(getattr(comparisons.c, name) == getattr(row, name) for name in ("older", "newer", "key", "created_at"))


def _add(transfer: Transfer, row: Row[Any], group: str | None, numbers: dict[int, int]) -> None:
    transfer.recipe(row.recipe)
    content = {name: value for name, value in row._mapping.items() if name != "number"} | {"group_id": group}
    lines = _lines(transfer.theirs, row.number)
    taken = {numbers[_first(line)] for line in lines if _first(line) in numbers}
    boxes = [(line.kind, to_array(line.box)) for line in lines]
    ours_by_place = match_changes(transfer.ours, row.older, row.newer, to_pose(row.S_frame_newer), boxes)
    number = transfer.ours.execute(insert(comparisons).returning(comparisons.c.number), content).scalar_one()
    transfer.counts["comparisons"] += 1
    for place, line in enumerate(lines):
        same = numbers.get(_first(line))
        if same is None and ours_by_place.get(place) not in taken:
            same = ours_by_place.get(place)
        values = {name: value for name, value in line._mapping.items() if name != "number"}
        values |= {"comparison": number, "same_as": same}
        new = transfer.ours.execute(insert(changes).returning(changes.c.number), values).scalar_one()
        numbers[_first(line)] = new if same is None else same


def _lines(connection: Connection, comparison: int) -> list[Row[Any]]:
    query = select(changes).where(changes.c.comparison == comparison).order_by(changes.c.place)
    return list(connection.execute(query).all())


def _first(line: Row[Any]) -> int:
    """Return the number of a row's change."""
    return int(line.number if line.same_as is None else line.same_as)


def _join_reviews(transfer: Transfer, numbers: dict[int, int]) -> None:
    known = {(r.change, r.review, r.note, r.created_at) for r in transfer.ours.execute(select(change_reviews))}
    query = select(change_reviews).order_by(change_reviews.c.created_at, change_reviews.c.number)
    for row in transfer.theirs.execute(query).all():
        word = (numbers.get(row.change), row.review, row.note, row.created_at)
        if word[0] is not None and word not in known:
            names = ("change", "review", "note", "created_at")
            transfer.ours.execute(insert(change_reviews), dict(zip(names, word, strict=True)))
            transfer.counts["change_reviews"] += 1
