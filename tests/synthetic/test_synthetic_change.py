"""Places that change: an edit changes its own objects alone, and the truth about it is what rays meet."""

import hashlib
from collections import Counter

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap_synthetic import film, walk
from gsmap_synthetic.change import PIXEL_KINDS, pixel_kinds, sight, states, true_changes
from gsmap_synthetic.edits import Add, Move, Paint, Remove, apply, edit_place
from gsmap_synthetic.layout import outline, overlap
from gsmap_synthetic.script import KINDS, random_edits

ROOMS = (0, 1)


@pytest.fixture(scope="module")
def edits(place):
    return random_edits(place, np.random.default_rng(5), rooms=ROOMS)


@pytest.fixture(scope="module")
def later(place, edits):
    return edit_place(place, edits)


@pytest.fixture(scope="module")
def changes(place, later):
    return true_changes(states(place), states(later))


@pytest.fixture(scope="module")
def cameras(place):
    return film(place, walk(place, ROOMS, 30, seed=2), size_px=(96, 72)).cameras


def _named(place, name):
    return next(o for o in place.objects if o.name == name)


def _edited(place, *edits):
    surfaces = place.surfaces.copy()
    for edit in edits:
        apply(surfaces, edit)
    return surfaces


def _quads(surfaces, owner):
    return [(surfaces.corners[q], surfaces.materials[q]) for q in surfaces.of(owner)]


def _changed_owners(before, after):
    owners = {o.id for o in before.objects} | {o.id for o in after.objects}
    return {i for i in owners if not _same(_quads(before, i), _quads(after, i))}


def _same(a, b):
    return len(a) == len(b) and all(p is q and (c == d).all() for (c, p), (d, q) in zip(a, b, strict=True))


def _shifted(thing, dx):
    T = thing.T_place_object.copy()
    T[0, 3] += dx
    return T


def test_what_a_seed_builds_does_not_change(place):
    corners = np.round(place.skin.corners * 1e4).astype(np.int64)
    assert (
        hashlib.sha256(corners.tobytes()).hexdigest()
        == "03639954bbce3acf1a9512af037fa766bb9b720e20eafe79eb23bcf8d4591a9a"
    )
    assert place.skin.texels[0].mean() == pytest.approx(114.13488, rel=1e-3)  # noise differs between processors
    assert [round(float(r.obstacles_m.sum()), 3) for r in place.rooms] == [26.742, 45.342, 79.854]


def test_without_edits_a_place_stays_the_same_to_the_bit(place):
    same = edit_place(place)
    np.testing.assert_array_equal(same.skin.corners, place.skin.corners)
    np.testing.assert_array_equal(same.skin.texels[0], place.skin.texels[0])
    assert true_changes(states(place), states(same)) == []


def test_every_quad_belongs_to_one_object(place):
    assert set(place.surfaces.owners) == {o.id for o in place.objects}
    assert {o.kind for o in place.objects} == {"shell", "wall", "window", "lamp", "furniture", "rug", "picture", "door"}


def test_an_edit_changes_the_quads_of_its_object_alone(place):
    sofa, wall, picture = (_named(place, name) for name in ("sofa", "wall", "picture"))
    surfaces = place.surfaces
    moved = _edited(place, Move(sofa.id, _shifted(sofa, 0.4)))
    assert _changed_owners(surfaces, moved) == {sofa.id}
    for (before, _), (after, _) in zip(_quads(surfaces, sofa.id), _quads(moved, sofa.id), strict=True):
        np.testing.assert_allclose(after - before, np.broadcast_to([0.4, 0, 0], (4, 3)), atol=1e-12)
    for thing in (sofa, wall, picture):
        painted = _edited(place, Paint(thing.id, 3))
        assert _changed_owners(surfaces, painted) == {thing.id}
        np.testing.assert_array_equal(painted.corners, surfaces.corners)
    gone = _edited(place, Remove(sofa.id))
    assert _changed_owners(surfaces, gone) == {sofa.id}
    assert not gone.objects[sofa.id].present
    added = _edited(place, Add("vase", 0, sofa.T_place_object, (0.2, 0.2), 7))
    assert _changed_owners(surfaces, added) == {len(place.objects)}


def test_the_light_of_a_lamp_goes_with_it(place):
    lamp = _named(place, "floor lamp")
    at = [position for position, *_ in place.surfaces.lamps]
    moved = _edited(place, Move(lamp.id, _shifted(lamp, -0.3)))
    ways = np.array([position for position, *_ in moved.lamps]) - at
    theirs = np.array(moved.lamp_owners) == lamp.id
    assert theirs.sum() == 2
    np.testing.assert_allclose(ways[theirs, 0], -0.3, atol=1e-12)
    assert not ways[~theirs].any()
    assert len(_edited(place, Remove(lamp.id)).lamps) == len(at) - 2


def test_paint_is_seen(place):
    sofa, picture = _named(place, "sofa"), _named(place, "picture")
    painted = edit_place(place, [Paint(sofa.id, 3), Paint(picture.id, 4)])
    for thing in (sofa, picture):
        quad = place.surfaces.of(thing.id)[0]
        middle = [np.array([quad]), np.full(1, 0.4), np.full(1, 0.6), np.full(1, 0.3)]
        assert np.abs(painted.skin.colour(*middle) - place.skin.colour(*middle)).max() > 0.1


def test_a_script_makes_every_kind_of_change_and_nothing_collides(place, later, edits, changes):
    assert Counter(c["kind"] for c in changes) == {
        "moved": 2,
        "disappeared": 1,
        "appeared": 2,
        "recoloured": 3,
        "replaced": 1,
    }
    assert len({c["after"] if c["before"] is None else c["before"] for c in changes}) == len(changes) == 9
    assert {later.objects[c["after"]].room for c in changes if c["after"] is not None} <= set(ROOMS)
    standing = [o for o in later.objects if o.present and o.kind == "furniture" and o.room in ROOMS]
    rects = {o.id: outline(o.T_place_object, o.size_m) for o in standing}
    edited = {c["after"] for c in changes}
    assert not [
        (later.objects[a].name, later.objects[b].name)
        for a in rects.keys() & edited
        for b in rects
        if a != b and overlap(rects[a], rects[b], -0.01)
    ]
    for o in standing:
        rect = later.rooms[o.room].rect_m
        assert (rects[o.id][:2] > rect[:2] - 0.02).all()
        assert (rects[o.id][2:] < rect[2:] + 0.02).all()


def test_a_small_thing_stands_on_something(place, later):
    (thing,) = (o for o in later.objects if o.kind == "small")
    z = thing.T_place_object[2, 3]
    middle = thing.T_place_object @ [0, thing.size_m[1] / 2, 0, 1]
    distance, *_ = place.skin.cast(np.array([[*middle[:2], z + 0.3]]), np.array([[0, 0, -1.0]]))
    assert distance[0] == pytest.approx(0.3, abs=1e-3)


def test_a_share_of_the_furniture_changes(place):
    edits = random_edits(place, np.random.default_rng(1), rooms=ROOMS, share=0.5)
    furniture = [o for o in place.objects if o.kind == "furniture" and o.room in ROOMS]
    touched = {e.object for e in edits if not isinstance(e, Add)}
    assert len(touched) == round(0.5 * len(furniture))
    assert touched <= {o.id for o in furniture}


def test_the_script_is_the_same_from_the_same_seed(place, edits):
    again = random_edits(place, np.random.default_rng(5), rooms=ROOMS)
    assert [str(e) for e in again] == [str(e) for e in edits]


def test_boxes_and_moves_are_those_of_the_vertices(place, later, changes):
    for change in changes:
        for at, key in ((place, "before"), (later, "after")):
            if change[key] is None:
                assert change[f"box_{key}_m"] is None
                continue
            corners = np.stack([c for c, _ in _quads(at.surfaces, change[key])])
            np.testing.assert_allclose(change[f"box_{key}_m"], [corners.min((0, 1)), corners.max((0, 1))], atol=1e-12)
        if change["kind"] == "moved":
            before, after = (np.stack([c for c, _ in _quads(at.surfaces, change["before"])]) for at in (place, later))
            S = np.array(change["S_after_before"])
            np.testing.assert_allclose(before @ S[:3, :3].T + S[:3, 3], after, atol=1e-9)
            assert np.abs(after - before).max() > 0.2


def test_what_replaces_a_thing_stands_where_it_stood(changes):
    (change,) = (c for c in changes if c["kind"] == "replaced")
    before, after = (np.array(change[k]) for k in ("box_before_m", "box_after_m"))
    assert change["before"] != change["after"]
    assert np.abs(before.mean(0) - after.mean(0))[:2].max() < 0.15


def test_ids_and_depths_are_what_a_ray_meets(place, later, cameras):
    shut = [1]
    ids, depths_m = sight(later, cameras, shut)
    filmed = film(later, cameras.T_frame_camera, size_px=(96, 72), shut=shut).depths_m
    np.testing.assert_allclose(depths_m, filmed, atol=1e-4)
    surfaces = later.surfaces
    leaves = {later.objects[o].id for o in surfaces.owners if later.objects[o].kind == "door"}
    for row, x, y in [(3, 10, 60), (9, 50, 40), (14, 70, 30), (20, 33, 33), (26, 90, 70)]:
        fx, fy, cx, cy = cameras.intrinsics_px[row]
        T = cameras.T_frame_camera[row]
        way = T[:3, :3] @ [(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1.0]
        there = [q for q, leaf in enumerate(surfaces.leaves) if leaf in (-1, 1)]
        met, nearest = _nearest(T[:3, 3], way, [surfaces.corners[q] for q in there])
        assert depths_m[row, y, x] == pytest.approx(nearest, abs=1e-3)
        assert ids[row, y, x] == surfaces.owners[there[met]]
    assert not np.isin(ids, list(leaves)).all()


def _nearest(eye, way, quads):
    """The quad a ray meets first and its distance, by the formula of Moeller and Trumbore."""
    best = (-1, np.inf)
    for q, (a, b, c, d) in enumerate(quads):
        for p, e, f in ((a, b - a, c - a), (a, c - a, d - a)):
            cross = np.cross(way, f)
            det = e @ cross
            if abs(det) < 1e-12:
                continue
            s = (eye - p) @ cross / det
            other = np.cross(eye - p, e)
            t, distance = way @ other / det, f @ other / det
            if s >= -1e-9 and t >= -1e-9 and s + t <= 1 + 1e-9 and 1e-6 < distance < best[1]:
                best = (q, distance)
    return best


def test_kinds_of_pixels_follow_from_what_stands_there(place, later, cameras):
    (now, near), (then, far) = sight(later, cameras), sight(place, cameras)
    kinds = pixel_kinds(now, then, states(later), states(place))
    assert set(np.unique(kinds)) == {0, 1, 2, 3}
    same, new, recoloured, vacated = (kinds == k for k in range(len(PIXEL_KINDS)))
    assert (now[same] == then[same]).all()
    np.testing.assert_allclose(near[same], far[same], atol=1e-6)
    assert (near[recoloured] == far[recoloured]).mean() > 0.9  # the rest had something before them
    assert (far[vacated] < near[vacated] + 1e-6).all()
    gone = {o.id for o in place.objects if not later.objects[o.id].present}
    assert not np.isin(now, list(gone)).any()
    added = [o.id for o in later.objects[len(place.objects) :]]
    assert np.isin(now[new], added).any()
    assert not np.isin(now[~new], added).any()


def test_a_shut_door_is_there_and_an_open_one_is_not(place):
    doors = [o.id for o in place.objects if o.kind == "door"]
    assert [s["present"] for s in states(place, [1]) if s["id"] in doors] == [False, True, False]
    (change,) = true_changes(states(place, [1]), states(place))
    assert (change["kind"], change["name"]) == ("disappeared", "door")


def test_night_changes_light_alone(place, cameras):
    night = edit_place(place, light="night")
    assert true_changes(states(place), states(night)) == []
    np.testing.assert_array_equal(night.skin.corners, place.skin.corners)
    poses = cameras.T_frame_camera[::6]
    by_day, by_night = (film(p, poses, size_px=(96, 72)).images.astype(float) for p in (place, night))
    windows = [o.id for o in place.objects if o.kind == "window"]
    panes = np.isin(sight(place, cameras[::6])[0], windows)
    assert by_night[panes].mean() < 0.6 * by_day[panes].mean()
    warmth = [x[~panes][:, 0].mean() / x[~panes][:, 2].mean() for x in (by_day, by_night)]
    assert warmth[1] > 1.1 * warmth[0]
    again = edit_place(night)  # morning
    np.testing.assert_array_equal(again.skin.texels[0], place.skin.texels[0])


def test_white_balance_is_a_gain_for_each_channel(place, cameras):
    poses = cameras.T_frame_camera[:2]
    plain = film(place, poses, size_px=(48, 36)).images.astype(float)
    tinted = film(place, poses, size_px=(48, 36), gain=np.array([0.9, 0.8, 0.7])).images
    np.testing.assert_allclose(tinted, plain * [0.9, 0.8, 0.7], atol=1.0)


def test_refuses_what_makes_no_sense(place):
    sofa = _named(place, "sofa").id
    with pytest.raises(ConfigError, match="not in the place"):
        edit_place(place, [Remove(sofa), Paint(sofa, 1)])
    with pytest.raises(ConfigError, match="no piece 'piano'"):
        edit_place(place, [Add("piano", 0, np.eye(4), (1, 1), 1)])
    with pytest.raises(ConfigError, match="day, night"):
        edit_place(place, light="dusk")
    with pytest.raises(ConfigError, match="unknown kinds"):
        random_edits(place, np.random.default_rng(0), rooms=ROOMS, counts={"burnt": 1})
    with pytest.raises(ConfigError, match="nothing to be removed"):
        random_edits(place, np.random.default_rng(0), rooms=ROOMS, counts={"removed": 60})
    assert set(KINDS) >= {"moved", "removed", "added", "small", "recoloured", "repainted", "swapped", "replaced"}
