"""Streets: what of a room comes again in the room that is decorated alike, and what does not."""

from functools import cache

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap_synthetic.capture import unused_doors, walk
from gsmap_synthetic.streets import make_street, shared_rooms, street_routes

_DECORATION = ("floor", "ceiling", "wall", "window", "picture", "trim")


@cache
def _street(repeats):
    return make_street(3, rooms=4, decorations=2, repeats=repeats, texel_m=0.1)


def _things(place, room, kinds):
    """(name, corners of its quads in the room's frame) of the things in a room, sorted."""
    corner = np.r_[place.rooms[room].rect_m[:2], 0.0]
    found = []
    for thing in place.objects:
        if thing.room == room and (thing.name in _DECORATION) == (kinds == "decoration"):
            quads = place.skin.corners[place.skin.owners == thing.id]
            found.append((thing.name, np.round(quads - corner, 4) + 0.0))
    return found


def _same(a, b):
    return len(a) == len(b) and all(
        m == n and p.shape == q.shape and np.allclose(p, q) for (m, p), (n, q) in zip(a, b, strict=True)
    )


def test_the_decoration_comes_again_exactly_and_the_furniture_stands_elsewhere():
    place = _street("decoration")
    one, again, next_door = (_things(place, room, "decoration") for room in (0, 2, 1))
    assert {name for name, _ in one} >= {"floor", "wall", "window", "picture"}
    assert _same(one, again)
    assert not _same(one, next_door)
    one, again = (dict(_things(place, room, "furniture")) for room in (0, 2))
    both = (set(one) & set(again)) - {"pendant"}
    assert len(both) >= 3
    moved = [name for name in both if one[name].shape != again[name].shape or not np.allclose(one[name], again[name])]
    assert len(moved) >= len(both) - 1


def test_another_floor_has_the_decorations_and_its_furniture_elsewhere():
    first = _street("decoration")
    above = make_street(3, rooms=4, decorations=2, floor=1, texel_m=0.1)
    for room in (0, 1):
        assert _same(_things(first, room, "decoration"), _things(above, room, "decoration"))
        assert not _same(_things(first, room, "furniture"), _things(above, room, "furniture"))


def test_pictures_show_the_same_paint():
    place = _street("decoration")

    def paints(room):
        quads = [q for q in range(len(place.skin.corners)) if _is_picture(place, q, room)]
        return [place.surfaces.materials[q](np.full((1, 1), 0.1), np.full((1, 1), 0.1), (0.5, 0.4)) for q in quads]

    assert paints(0)
    assert all(np.allclose(a, b) for a, b in zip(paints(0), paints(2), strict=True))


def _is_picture(place, quad, room):
    owner = place.skin.owners[quad]
    return owner >= 0 and place.objects[owner].name == "picture" and place.objects[owner].room == room


def test_whole_rooms_come_again_or_nothing_does():
    twins = _street("room")
    assert _same(*(_things(twins, room, "furniture") for room in (0, 2)))
    plain = _street("nothing")
    assert not _same(*(_things(plain, room, "decoration") for room in (0, 2)))


def test_a_walk_passes_one_door_and_all_others_are_shut():
    place, routes = _street("decoration"), street_routes(4)
    assert routes == [(0, 1), (1, 2), (2, 3)]
    assert [shared_rooms(routes[0], other) for other in routes] == [2, 1, 0]
    assert len(unused_doors(place, routes[0])) == len(place.doors) - 1 == 4
    poses = walk(place, routes[0], 12)
    inside = (poses[:, 0, 3] > place.rooms[0].rect_m[0]) & (poses[:, 0, 3] < place.rooms[1].rect_m[2])
    assert inside.all()


def test_streets_that_cannot_be_are_refused():
    for wrong in ({"rooms": 1}, {"decorations": 0}, {"repeats": "doors"}):
        with pytest.raises(ConfigError, match="a street has 2 rooms or more"):
            make_street(0, **wrong)
