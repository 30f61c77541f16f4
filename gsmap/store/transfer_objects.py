"""Copy objects and facts about them between maps, without computing anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sqlalchemy import delete, insert, select

from gsmap.store.catalog import now
from gsmap.store.objects import forget_sets, match_objects, number_of
from gsmap.store.schema import object_facts, object_places, objects
from gsmap.store.transfer import Transfer, merge_by_time


def transfer_objects(transfer: Transfer) -> None:
    """Copy the objects seen in the copied scenes, with their boxes and their recorded names and notes.

    An object with overlapping boxes in this map takes its number here, so that the facts are merged; others get new
    numbers. Computed object sets are not copied.
    """
    ours, theirs = transfer.ours, transfer.theirs
    found: dict[int, dict[str, np.ndarray]] = {}
    for row in theirs.execute(select(object_places).order_by(object_places.c.object)):
        if row.scene in transfer.wanted:
            found.setdefault(row.object, {})[row.scene] = np.array(row.box, np.float64)
    numbers: dict[int, int] = {}
    is_new = False
    for their_number, number in zip(found, match_objects(ours, list(found.values())), strict=True):
        if number is None:
            made = insert(objects).returning(objects.c.number)
            number = int(ours.execute(made, {"created_at": now()}).scalar_one())
            transfer.counts["objects"] += 1
        numbers[their_number] = number
        mine = object_places.c.object == number
        here = set(ours.execute(select(object_places.c.scene).where(mine)).scalars())
        for scene, box in found[their_number].items():
            if scene not in here:
                ours.execute(insert(object_places), {"object": number, "scene": scene, "box": box.tolist()})
                is_new = True
    if is_new:
        forget_sets(ours, transfer.wanted)
    _join_facts(transfer, numbers)


def _join_facts(transfer: Transfer, numbers: Mapping[int, int]) -> None:
    """Merge the facts of both maps about objects, keeping the order within each map.

    Args:
        numbers: object numbers in this map, by those in the other map.
    """
    ours, theirs = transfer.ours, transfer.theirs
    names = ("object", "kind", "value", "author", "created_at")
    query = select(object_facts).order_by(object_facts.c.number)
    mine: dict[int, list[tuple[Any, ...]]] = {}
    for row in ours.execute(query):
        mine.setdefault(row.object, []).append(tuple(getattr(row, name) for name in names))
    their_facts: dict[int, list[tuple[Any, ...]]] = {}
    for row in theirs.execute(query).all():
        if row.object not in numbers:
            continue
        value = row.value
        if row.kind == "same_as" and value:
            other = numbers.get(number_of(value) or 0)
            if other is None or other == numbers[row.object]:
                continue  # the other object is not copied, or is this one
            value = f"o{other}"
        fact = (numbers[row.object], row.kind, value, row.author, row.created_at)
        their_facts.setdefault(numbers[row.object], []).append(fact)
    for number, there in their_facts.items():
        here = mine.get(number, [])
        joined = merge_by_time(here, there, time=lambda fact: str(fact[-1]), is_new=lambda fact: fact not in here)  # noqa: B023
        if len(joined) > len(here):
            transfer.counts["object_facts"] += len(joined) - len(here)
            ours.execute(delete(object_facts).where(object_facts.c.object == number))
            ours.execute(insert(object_facts), [dict(zip(names, fact, strict=True)) for fact in joined])
