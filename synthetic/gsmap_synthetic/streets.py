"""A street: rooms in a row with doorways between them, decorated alike again and again, and its walks.

Hotels, offices and schools are built so: the walls, windows and pictures of one room are those of the fifth one on, and
only the furniture stands elsewhere, or not even that. Two captures of such a street may agree in most of what they
show and be of different rooms; what tells them apart is the furniture, and the way from one room to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np

from gsmap.errors import ConfigError
from gsmap_synthetic.place import Place, build_place
from gsmap_synthetic.plan import WALL_M, Door, Room

Repeats = Literal["decoration", "room", "nothing"]
_SIZE_M = (4.4, 4.0)
_KINDS = ("living room", "kitchen", "bedroom", "study", "bathroom")


def make_street(
    seed: int = 0,
    *,
    rooms: int = 15,
    decorations: int = 5,
    repeats: Repeats = "decoration",
    floor: int = 0,
    texel_m: float = 0.012,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build a street along x: room ``k`` looks like room ``k + decorations``.

    Args:
        seed: which street.
        rooms: how many there are; every one has a door at either end, those of the street lead nowhere.
        decorations: after this many rooms the decorations come again, in the same order.
        repeats: what comes again: the ``decoration`` exactly (with the same furniture, which stands elsewhere), the
            whole ``room``, or ``nothing``: the control.
        floor: of the building: every floor has the decorations of the others, and its furniture stands elsewhere.
        texel_m: how fine the baked colours are.

    Raises:
        ConfigError: fewer than 2 rooms, no decoration, or something else to repeat.
    """
    if rooms < 2 or decorations < 1 or repeats not in get_args(Repeats):
        raise ConfigError(
            f"a street has 2 rooms or more, a decoration or more, and repeats {', '.join(get_args(Repeats))}; got "
            f"rooms={rooms}, decorations={decorations}, repeats={repeats!r}"
        )
    rng, size = np.random.default_rng([seed, 11]), np.array(_SIZE_M)
    pitch = size[0] + WALL_M
    # Of each decoration: its seed, its depth and where its western door is.
    count = rooms if repeats == "nothing" else min(decorations, rooms)
    seeds, layouts = rng.integers(1 << 30, size=count), rng.integers(1 << 30, size=rooms)
    door_m = rng.uniform(0.25, 0.75, count) * (size[1] - 1.4) + 0.7
    if floor:
        layouts = np.random.default_rng([seed, 11, floor]).integers(1 << 30, size=rooms)
    plan, doors = [], []
    for k in range(rooms):
        at, which = k * pitch, k % count
        layout = layouts[which if repeats == "room" else k]
        rect = np.array([at, 0.0, at + size[0], size[1]])
        plan.append(Room(_KINDS[which % len(_KINDS)], rect, int(seeds[which]), layout_seed=int(layout)))
    for k in range(rooms + 1):
        xy = np.array([k * pitch - 0.5 * WALL_M, door_m[k % count]])
        doors.append(Door(k - 1, k if k < rooms else -1, xy, 1.0, False))
    return build_place(seed, plan, doors, texel_m=texel_m, progress=progress)


def street_routes(rooms: int, captures: int | None = None) -> list[tuple[int, int]]:
    """Walks through two neighbouring rooms each, along the street; each shares one room with the next."""
    return [(k, k + 1) for k in range(rooms - 1)][:captures]


def shared_rooms(a: Sequence[int], b: Sequence[int]) -> int:
    """How many rooms two walks have in common: captures without one show different places."""
    return len(set(a) & set(b))
