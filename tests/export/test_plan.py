from dataclasses import replace

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError, InputError
from gsmap.export import TileRecipe, dirty_reason, plan_tiles
from gsmap.export import plan as planning
from gsmap.export.cells import OrientedBoxes
from gsmap.geometry.rotations import exp_so3
from gsmap.merge import recipe_key
from gsmap.types import Sim3, Tile

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def at(x, y=0.0, z=0.0, turn_rad=0.0, scale=1.0):
    return Sim3(exp_so3([0, 0, turn_rad]), [x, y, z], scale)


VOXEL, UNION = TileRecipe(recipe_key("voxel")), TileRecipe(recipe_key("union"))


def tile_of(planned, recipe=VOXEL):
    return Tile(recipe.key(planned), planned.component, planned.bounds, planned.poses, recipe=recipe.merge.to_json())


def test_tiles_cover_every_point_of_every_scene_exactly_once():
    rng = np.random.default_rng(0)
    poses = {f"s{i}": at(*rng.uniform(-6, 6, 3), turn_rad=rng.uniform(0, 6), scale=1.5) for i in range(4)}
    tiles = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=2.0)
    for pose in poses.values():
        points = pose.apply(rng.uniform(-1, 1, (500, 3)))
        holds = [((points >= t.bounds[0]) & (points < t.bounds[1])).all(1) for t in tiles]
        np.testing.assert_array_equal(np.sum(holds, axis=0), 1)


def test_a_tile_names_the_scenes_that_reach_into_it_and_none_far_away():
    poses = {"a": at(0), "b": at(1.5), "c": at(40)}
    tiles = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=4.0)
    named = {t.name: set(t.poses) for t in tiles}
    assert named["tile_+000_+000_+000"] == {"a", "b"}
    assert named["tile_+010_+000_+000"] == {"c"}
    assert set(named["tile_-001_+000_+000"]) == {"a"}
    reaching = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=4.0, reach_m=1.0)
    assert {t.name: set(t.poses) for t in reaching}["tile_-001_+000_+000"] == {"a", "b"}


def test_an_oriented_box_leaves_out_corners_it_does_not_reach():
    # A thin plank along the diagonal: the box around it would fill the whole square.
    poses = {"a": at(5, 5, 0, turn_rad=np.pi / 4)}
    bounds = {"a": np.array([[-6, -0.1, -0.4], [6, 0.1, 0.4]])}
    names = {t.name for t in plan_tiles(poses, bounds, tile_size_m=1.0)}
    assert "tile_+005_+005_+000" in names
    assert "tile_+001_+008_+000" not in names


def by_hand(poses, bounds, edge, reach, bbox):
    """The same tiles from every cell of the box around all scenes, each tried with every scene."""

    def touches(scene, low, high):
        half = poses[scene].scale * np.ptp(bounds[scene], axis=0) / 2
        axes, middle = poses[scene].rotation, poses[scene].apply(bounds[scene].mean(0))
        around = np.abs(axes) @ half
        offset = axes.T @ ((low + high) / 2 - middle)
        return (
            (middle - around <= high).all()
            and (middle + around >= low).all()
            and (np.abs(offset) <= half + np.abs(axes.T) @ ((high - low) / 2)).all()
        )

    found = {}
    for cell in np.ndindex(12, 12, 12):
        low, high = (np.add(cell, corner) * edge - 6 * edge for corner in (0, 1))
        if bbox is not None:
            low, high = np.maximum(low, bbox[0]), np.minimum(high, bbox[1])
        if (high > low).all() and any(touches(scene, low, high) for scene in poses):
            near = {scene for scene in poses if touches(scene, low - reach, high + reach)}
            found["tile_" + "_".join(f"{c - 6:+04d}" for c in cell)] = (near, np.array([low, high]))
    return found


@pytest.mark.parametrize("seed", range(2))
def test_the_plan_is_that_of_every_cell_tried_with_every_scene(seed):
    rng = np.random.default_rng(seed)
    poses = {f"s{i}": Sim3(exp_so3(rng.normal(size=3)), rng.uniform(-6, 6, 3), rng.uniform(0.5, 1.5)) for i in range(4)}
    bounds = {scene: np.sort(rng.uniform(-3, 3, (2, 3)), axis=0) for scene in poses}
    bbox = np.array([[-7.3, -5.1, -9.0], [6.2, 8.4, 3.3]]) if seed % 2 else None
    tiles = plan_tiles(poses, bounds, tile_size_m=2.5, reach_m=1.7, bbox=bbox)
    expected = by_hand(poses, bounds, 2.5, 1.7, bbox)
    assert [tile.name for tile in tiles] == list(expected)
    for tile in tiles:
        near, box = expected[tile.name]
        assert set(tile.poses) == near
        np.testing.assert_allclose(tile.bounds, box)


def test_tiles_without_content_do_not_count():
    """A street of 16 km along the diagonal, and one scene far away: the box around them has millions of cells."""
    poses = {f"s{i:04d}": at(2.83 * i, 2.83 * i) for i in range(4000)} | {"stray": at(-3e5, 7e5, 2e5)}
    tiles = plan_tiles(poses, dict.fromkeys(poses, 4 * BOX), tile_size_m=10.0)
    assert 4_000 < len(tiles) < 16_000
    assert {scene for tile in tiles for scene in tile.poses} == set(poses)
    with raises(ConfigError, code="too_many_tiles"):
        plan_tiles(poses, dict.fromkeys(poses, 4 * BOX), tile_size_m=10.0, max_tiles=len(tiles) - 1)


def test_a_plan_takes_work_by_the_scene(monkeypatch):
    """Ten times the scenes: ten times the boxes that are compared, however much lies between them."""
    compared = []
    touch = OrientedBoxes.touch

    def counting(self, which, low, high):
        compared.append(len(which))
        return touch(self, which, low, high)

    monkeypatch.setattr(OrientedBoxes, "touch", counting)
    counts = []
    for num in (100, 1000):
        compared.clear()
        poses = {f"s{i:04d}": at(30.0 * i, 40.0 * i, turn_rad=0.1 * i) for i in range(num)}
        plan_tiles(poses, dict.fromkeys(poses, 4 * BOX), tile_size_m=10.0, reach_m=11.0)
        counts.append(sum(compared))
    assert counts[1] < 11 * counts[0]


def test_components_are_planned_apart():
    poses = {"a": at(0), "b": at(0)}
    tiles = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=0, components={"a": 0, "b": 3})
    assert [(t.component, t.name, list(t.poses)) for t in tiles] == [(0, "map", ["a"]), (3, "map", ["b"])]


def test_a_box_cuts_tiles_and_must_touch_the_map():
    poses = {"a": at(0)}
    box = np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])
    tiles = plan_tiles(poses, {"a": BOX}, tile_size_m=4.0, bbox=box)
    assert len(tiles) == 8
    assert sum(np.prod(t.bounds[1] - t.bounds[0]) for t in tiles) == pytest.approx(1.0)
    two = plan_tiles(
        poses | {"b": at(90)}, dict.fromkeys("ab", BOX), tile_size_m=4.0, components={"a": 0, "b": 1}, bbox=box
    )
    assert [t.component for t in two] == [0] * 8  # nothing of the other lies in the box
    with raises(InputError, code="box_outside_map"):
        plan_tiles(poses, {"a": BOX}, tile_size_m=4.0, bbox=box + 50)
    with raises(InputError, code="invalid_box"):
        plan_tiles(poses, {"a": BOX}, tile_size_m=4.0, bbox=box[::-1])
    with raises(InputError, code="nothing_to_export"):
        plan_tiles({}, {}, tile_size_m=4.0)
    with raises(ConfigError, code="out_of_range", match="tile size .*-1"):
        plan_tiles(poses, {"a": BOX}, tile_size_m=-1)
    with raises(ConfigError, code="too_many_tiles"):
        plan_tiles(poses, {"a": BOX}, tile_size_m=1e-4)


def test_a_tile_is_dirty_for_content_method_or_pose_but_not_for_a_hair():
    poses, bounds = {"a": at(0), "b": at(1)}, dict.fromkeys("abc", BOX)
    (planned,) = plan_tiles(poses, bounds, tile_size_m=0)
    tile = tile_of(planned)
    assert dirty_reason(planned, None, VOXEL) == "new"
    assert dirty_reason(planned, tile, VOXEL) == ""
    assert "method" in dirty_reason(planned, tile, UNION)
    (grown,) = plan_tiles({**poses, "c": at(2)}, bounds, tile_size_m=0)
    assert "scenes" in dirty_reason(grown, tile, VOXEL)
    (hair,) = plan_tiles({**poses, "b": at(1.003)}, bounds, tile_size_m=0)
    assert dirty_reason(hair, tile, VOXEL) == ""
    (moved,) = plan_tiles({**poses, "b": at(1.01)}, bounds, tile_size_m=0)
    assert "moved" in dirty_reason(moved, tile, VOXEL)
    (turned,) = plan_tiles({**poses, "b": at(1, turn_rad=0.02)}, bounds, tile_size_m=0)
    assert "moved" in dirty_reason(turned, tile, VOXEL)


def test_slow_drift_is_noticed_in_the_end():
    bounds = {"a": BOX}
    (first,) = plan_tiles({"a": at(0)}, bounds, tile_size_m=0)
    tile = tile_of(first)
    reasons = []
    for x in np.arange(1, 5) * 0.002:
        (now,) = plan_tiles({"a": at(x)}, bounds, tile_size_m=0)
        reasons.append(dirty_reason(now, tile, VOXEL))
    assert reasons[0] == reasons[1] == ""
    assert "moved" in reasons[-1]


@pytest.mark.parametrize("unit", [0.1, 0.3, 10.0])
def test_a_plan_is_that_of_metres_whatever_the_unit(unit):
    """``unit`` metres a unit: the same tiles, scenes within the same reach, and a move counts by its metres."""
    metric = {"a": at(0), "b": at(4.5), "c": at(-7.3, 2.0)}
    poses = {s: Sim3(S.rotation, S.translation / unit, S.scale / unit) for s, S in metric.items()}
    options = {"tile_size_m": 2.0, "reach_m": 1.1}
    one = plan_tiles(metric, dict.fromkeys(metric, BOX), **options)
    two = plan_tiles(poses, dict.fromkeys(poses, BOX), **options, metres_per_unit={0: unit})
    assert [(t.name, sorted(t.poses)) for t in two] == [(t.name, sorted(t.poses)) for t in one]
    np.testing.assert_allclose([unit * t.bounds for t in two], [t.bounds for t in one], atol=1e-9)
    planned = two[0]
    made = tile_of(planned)
    for moved_m, dirty in ((0.004, False), (0.006, True)):
        moved = replace(planned, poses={s: at(moved_m / unit) @ S for s, S in planned.poses.items()})
        assert bool(dirty_reason(moved, made, VOXEL, 0.005)) == dirty
    assert dirty_reason(replace(planned, metres_per_unit=2 * unit), made, VOXEL)


def test_a_tile_of_a_map_in_metres_is_named_as_it_always_was():
    (planned,) = plan_tiles({"a": at(0)}, {"a": BOX}, tile_size_m=0, metres_per_unit={0: 1.0})
    inputs = ["export 1", "format ply", "provenance False", "budget_s None", "component 0"]
    assert VOXEL.key(planned) == VOXEL.merge.of(*inputs, "extent [0, null, null]", "scene a").digest


# --- automatic sizes -------------------------------------------------------------------------------------------------


def test_a_component_that_viewers_load_at_once_is_one_tile_and_a_larger_one_is_not():
    poses = {"a": at(0), "b": at(1.0), "c": at(0), "d": at(22.0)}
    sizes = {"a": 700_000, "b": planning.MAX_WHOLE_GAUSSIANS - 700_000, "c": 1_000_000, "d": 500_001}
    components = {"a": 0, "b": 0, "c": 1, "d": 1}
    tiles = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=None, num_gaussians=sizes, components=components)
    assert [(t.name, t.is_cut, t.num_input) for t in tiles if t.component == 0] == [
        ("map", False, pytest.approx(planning.MAX_WHOLE_GAUSSIANS))
    ]
    cut = {t.name: t for t in tiles if t.component == 1}
    # A storey, or a house, around the origin is in one tile: cells are centred on it.
    assert set(cut) == {"tile_+000_+000_+000", "tile_+002_+000_+000"}
    np.testing.assert_allclose(cut["tile_+000_+000_+000"].bounds, [[-5] * 3, [5] * 3])
    assert {name: round(t.num_input) for name, t in cut.items()} == {
        "tile_+000_+000_+000": 1_000_000,
        "tile_+002_+000_+000": 500_001,
    }
    asked = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=10.0, components=components)
    assert not {t.extent for t in asked} & {t.extent for t in tiles}


def test_centred_tiles_cover_every_point_exactly_once():
    rng = np.random.default_rng(1)
    poses = {f"s{i}": at(*rng.uniform(-30, 30, 3), turn_rad=rng.uniform(0, 6), scale=1.5) for i in range(4)}
    sizes = dict.fromkeys(poses, planning.MAX_WHOLE_GAUSSIANS)
    tiles = plan_tiles(poses, dict.fromkeys(poses, BOX), tile_size_m=None, num_gaussians=sizes)
    assert len(tiles) > 3
    for pose in poses.values():
        points = pose.apply(rng.uniform(-1, 1, (500, 3)))
        holds = [((points >= t.bounds[0]) & (points < t.bounds[1])).all(1) for t in tiles]
        np.testing.assert_array_equal(np.sum(holds, axis=0), 1)
    assert sum(t.num_input for t in tiles) == pytest.approx(sum(sizes.values()), rel=0.01)


# --- axes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("format", "up"), [("ply", "z"), ("3dtiles", "z"), ("streamed-sog", "z"), ("spz", "y"), ("glb", "y"), ("sog", "y")]
)
def test_the_vertical_axis_is_that_of_the_format(format, up):
    assert TileRecipe(recipe_key("union"), format, up=None).up == up


def test_another_axis_is_another_file_of_the_same_merge():
    (planned,) = plan_tiles({"a": at(0)}, {"a": BOX}, tile_size_m=0)
    recipes = [TileRecipe(recipe_key("union"), format, up=up) for format in ("ply", "spz") for up in ("y", "z")]
    assert len({recipe.key(planned) for recipe in recipes}) == 4
    assert len({recipe.merge_key(planned) for recipe in recipes}) == 1
    (moved,) = plan_tiles({"a": at(1e-6)}, {"a": BOX}, tile_size_m=0)
    assert moved.extent == planned.extent
    assert recipes[0].merge_key(moved) != recipes[0].merge_key(planned)
    assert recipes[0].key(moved) == recipes[0].key(planned)
    with raises(ConfigError, code="unsupported_output"):
        TileRecipe(recipe_key("union"), "3dtiles", up="y")
    with raises(ConfigError, code="invalid_choice"):
        TileRecipe(recipe_key("union"), "spz", up="x")
