"""Objects of the map and what was said of them, brought from one map into another; nothing is computed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sqlalchemy import delete, insert, select

from gsmap.store.catalog import now
from gsmap.store.objects import forget_sets, matched, number_of
from gsmap.store.schema import object_facts, object_places, objects
from gsmap.store.transfer import Transfer, in_order


def objects_of(transfer: Transfer) -> None:
    """The objects that the scenes that come show, with where they show them and what people said of them.

    One that this map knows at the same place of a scene keeps its number here, so that the words on it join; the others
    get new ones. What was computed of them stays behind: it is made again of the scenes that are here then.
    """
    ours, theirs = transfer.ours, transfer.theirs
    found: dict[int, dict[str, np.ndarray]] = {}
    for row in theirs.execute(select(object_places).order_by(object_places.c.object)):
        if row.scene in transfer.wanted:
            found.setdefault(row.object, {})[row.scene] = np.array(row.box, np.float64)
    numbers: dict[int, int] = {}
    for their_number, number in zip(found, matched(ours, list(found.values())), strict=True):
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
    if found:
        forget_sets(ours, transfer.wanted)
    _join_facts(transfer, numbers)


def _join_facts(transfer: Transfer, numbers: Mapping[int, int]) -> None:
    """Everything that was said of objects in either map; each map's own order stays.

    Args:
        numbers: of objects here, by their numbers there.
    """
    ours, theirs = transfer.ours, transfer.theirs
    names = ("object", "kind", "value", "author", "created_at")
    query = select(object_facts).order_by(object_facts.c.number)
    mine: dict[int, list[tuple[Any, ...]]] = {}
    for row in ours.execute(query):
        mine.setdefault(row.object, []).append(tuple(getattr(row, name) for name in names))
    said_there: dict[int, list[tuple[Any, ...]]] = {}
    for row in theirs.execute(query).all():
        if row.object not in numbers:
            continue
        value = row.value
        if row.kind == "same_as" and value:
            other = numbers.get(number_of(value) or 0)
            if other is None or other == numbers[row.object]:
                continue  # the other one stays behind, or is this one here
            value = f"o{other}"
        said = (numbers[row.object], row.kind, value, row.author, row.created_at)
        said_there.setdefault(numbers[row.object], []).append(said)
    for number, said_of_it in said_there.items():
        here = mine.get(number, [])
        joined = in_order(here, said_of_it, time=lambda said: str(said[-1]), is_new=lambda said: said not in here)  # noqa: B023
        if len(joined) > len(here):
            transfer.counts["object_facts"] += len(joined) - len(here)
            ours.execute(delete(object_facts).where(object_facts.c.object == number))
            ours.execute(insert(object_facts), [dict(zip(names, said, strict=True)) for said in joined])
