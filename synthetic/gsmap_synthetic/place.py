"""A synthetic place: a furnished flat built from a seed.

The plan is a rectangle cut into rooms; every two rooms that share enough wall get a doorway, so the first three form a
cycle. Each room is decorated and furnished from its own seed: two seeds give two clearly different places, one seed
always the same. With ``twin=True`` the whole flat is built a second time beside the first and both open onto a
corridor: two wings that nothing but the corridor tells apart.

Place frame: metres, z up, floor at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError
from gsmap_synthetic.bake import Skin, bake
from gsmap_synthetic.plan import Door, Room, make_plan, with_twin
from gsmap_synthetic.rooms import CEILING_M, build_door, build_room
from gsmap_synthetic.surfaces import PlaceObject, Surfaces

__all__ = ["CEILING_M", "Door", "Place", "Room", "make_place"]


@dataclass(frozen=True, eq=False)
class Place:
    """A built place: the plan, its surfaces, and the skin of them (quads, baked colours, ray casting).

    The quads of an object are those with its id in ``skin.owners``.
    """

    seed: int
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    skin: Skin
    surfaces: Surfaces

    @property
    def objects(self) -> list[PlaceObject]:
        """All things that are or were in the place, by id."""
        return self.surfaces.objects

    def door_between(self, a: int, b: int) -> Door | None:
        return next((d for d in self.doors if {d.a, d.b} == {a, b}), None)


def make_place(
    seed: int = 0,
    *,
    rooms: int = 3,
    twin: bool = False,
    texel_m: float = 0.008,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build the place of a seed: plan, walls, furniture, light.

    Args:
        seed: which place.
        rooms: how many rooms a wing has, 3 or more; the flat grows with them.
        twin: build the wing twice, side by side, joined by a corridor (the last room).
        texel_m: how fine the baked colours are.

    Raises:
        ConfigError: fewer than 3 rooms.
    """
    if rooms < 3:
        raise ConfigError(f"a synthetic place has at least 3 rooms, got rooms={rooms}")
    plan, doors = make_plan(np.random.default_rng([seed, 1]), rooms)
    if twin:
        plan, doors = with_twin(plan, doors, seed)
    return build_place(seed, plan, doors, texel_m=texel_m, progress=progress)


def build_place(
    seed: int,
    plan: Sequence[Room],
    doors: Sequence[Door],
    *,
    texel_m: float = 0.008,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build the rooms of a plan and the doors between them; ``seed`` decides the look of the doors."""
    surfaces = Surfaces()
    built = [build_room(surfaces, room, i, list(doors)) for i, room in enumerate(plan)]
    for index, door in enumerate(doors):
        build_door(surfaces, door, index, seed)
    skin = bake(surfaces, texel_m=texel_m, progress=progress)
    return Place(seed, tuple(built), tuple(doors), skin, surfaces)
