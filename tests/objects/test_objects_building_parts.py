"""Segments that are no objects: rooms, corners, doors, patches of walls, trims and debris."""

import numpy as np
import pytest

from gsmap.objects.building_parts import CELL_M, is_building_part
from gsmap.objects.outlines import Outline

WOOD, WALL = np.array([45.0, 15, 25]), np.array([80.0, 0, 3])


def sheet(origin, along, across) -> np.ndarray:
    """Samples of a rectangle, one per cell."""
    along, across = np.array(along, float), np.array(across, float)
    n, m = (max(1, round(np.linalg.norm(v) / CELL_M)) for v in (along, across))
    u, v = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m, indexing="ij")
    return np.array(origin) + u.reshape(-1, 1) * along + v.reshape(-1, 1) * across


def block(low, size) -> np.ndarray:
    """Samples of the sides and the top of a block."""
    (x, y, z), (a, b, c) = size, low
    return np.concatenate(
        [
            sheet((a, b, c), (x, 0, 0), (0, 0, z)),
            sheet((a, b + y, c), (x, 0, 0), (0, 0, z)),
            sheet((a, b, c), (0, y, 0), (0, 0, z)),
            sheet((a + x, b, c), (0, y, 0), (0, 0, z)),
            sheet((a, b, c + z), (x, 0, 0), (0, y, 0)),
        ]
    )


def coloured(points, *colours) -> np.ndarray:
    return np.array(colours)[np.random.default_rng(0).integers(0, len(colours), len(points))]


def is_part(points, *colours, turn_deg=30.0, outline=None) -> bool:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turned = points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return is_building_part(turned, coloured(points, *colours), 0.0, 2.5, outline)


@pytest.mark.parametrize(
    ("name", "low", "size"),
    [
        ("chair", (0, 0, 0), (0.5, 0.5, 0.9)),
        ("sofa", (0, 0, 0), (2.2, 0.9, 0.8)),
        ("bookshelf", (0, 0, 0), (0.9, 0.35, 2.0)),
        ("lamp that hangs", (0, 0, 2.2), (0.5, 0.5, 0.3)),
        ("vase", (0, 0, 0.8), (0.2, 0.2, 0.35)),
    ],
)
def test_furniture_and_things_are_objects(name, low, size):
    assert not is_part(block(low, size), WOOD)


def test_a_picture_is_an_object_and_a_patch_of_the_wall_is_not():
    picture = sheet((0, 0, 1.2), (0.8, 0, 0), (0, 0, 0.6))
    assert not is_part(picture, WOOD, WALL)
    assert is_part(picture, WALL)
    assert is_part(sheet((0, 0, 0.1), (0.9, 0, 0), (0, 0, 2.0)), WOOD, WALL), "a door"
    assert is_part(sheet((0, 0, 1.5), (0.8, 0, 0), (0, 0, 0.85)), WOOD, WALL), "a patch below the ceiling"
    assert is_part(sheet((0, 0, 0), (1.5, 0, 0), (0, 1.0, 0)), WOOD, WALL), "a rug"


@pytest.mark.parametrize(
    ("name", "points"),
    [
        ("room", block((0, 0, 0), (6, 4, 2.2))),
        ("row of kitchen cabinets", block((0, 0, 0), (3.4, 0.6, 0.9))),
        ("wall up to the ceiling", block((0, 0, 0.1), (1.0, 0.3, 2.38))),
        (
            "corner",
            np.concatenate([sheet((0, 0, 0), (1.2, 0, 0), (0, 0, 2)), sheet((0, 0, 0), (0, 1.2, 0), (0, 0, 2))]),
        ),
        ("trim", block((0, 0, 0.9), (1.4, 0.06, 0.1))),
        ("debris", block((0, 0, 0), (1.0, 0.6, 1.0))[::6]),
    ],
)
def test_rooms_corners_trims_and_debris_are_none(name, points):
    assert is_part(points, WALL, WOOD)


@pytest.mark.parametrize(
    ("outline", "solid", "flat"),
    [
        (Outline(60, 30, 10, 0, 0, 900), False, False),
        (Outline(10, 20, 70, 0, 0, 900), True, True),  # the surface continues
        (Outline(10, 70, 20, 0, 0, 900), True, False),  # hangs on a wall, or lies in one
        (Outline(5, 50, 0, 45, 0, 900), True, True),  # behind the surface around it
        (Outline(20, 10, 10, 0, 60, 900), False, False),  # behind other objects
        (Outline(2, 2, 9, 0, 0, 900), False, False),  # too short to judge
        (Outline(60, 30, 10, 0, 0, 12), True, True),  # nearly invisible
        (Outline(0, 0, 0, 0, 0, 0), False, False),  # no view looks at it
        (Outline(0, 300, 0, 0, 0, 900), False, False),  # stands among other things
    ],
)
def test_what_is_cut_out_of_a_surface_is_a_part_of_the_building(outline, solid, flat):
    assert is_part(block((0, 0, 0), (2.2, 0.9, 0.8)), WOOD, outline=outline) == solid
    assert is_part(sheet((0, 0, 1.2), (0.8, 0, 0), (0, 0, 0.6)), WOOD, WALL, outline=outline) == flat
