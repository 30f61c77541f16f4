"""Captures that are bent, merged with --nonrigid: beside the shape of the place that they show."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from furnished_room import furnished_room
from raising import raises

import gsmap.map
from gsmap import formats
from gsmap.errors import InputError
from gsmap.export import PlannedTile, TileRecipe
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.warps import Warp
from gsmap.map import Map
from gsmap.map.jobs import _warped
from gsmap.map.stages.nonrigid import WarpedCaptures, deformed_pairs
from gsmap.merge.tile import LazyScene
from gsmap.methods import RecipeKey
from gsmap.types import EdgeOutcome, Gaussians, PoseGraph, Registration, ScenePose, Sim3
from gsmap.types.registration import DEFORMATION_NOTES

SAG_M = 0.12  # 2 % of six metres
BENT = {"left": False, "right": False, "bent": True, "after": True}
EDGES = {
    ("left", "right"): (0.8, False),
    ("left", "bent"): (0.6, True),
    ("right", "bent"): (0.7, True),
    ("bent", "after"): (0.5, False),
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    """A room captured four times, straight twice and bent twice; the last capture has an edge to a bent one only."""
    folder = tmp_path_factory.mktemp("nonrigid")
    rng = np.random.default_rng(0)
    with pytest.MonkeyPatch.context() as patch, gsmap.map.create(folder / "site.gsmap") as m:
        patch.setenv("GSMAP_CACHE", str(folder / "cache"))
        poses = {name: Sim3(exp_so3(rng.normal(size=3)), rng.normal(0, 2, 3)) for name in BENT}
        for seed, (name, is_bent) in enumerate(BENT.items()):
            points = bend(room(seed)) if is_bent else room(seed)
            m.ingest(gaussians(poses[name].inverse().apply(points), seed), name=name, scale="known")
        m.describe()
        ids = {scene.name: scene.id for scene in m.scenes()}
        for (a, b), (overlap, is_deformed) in EDGES.items():
            S = poses[a].inverse() @ poses[b]
            notes = (f"{DEFORMATION_NOTES[0]}to fit",) if is_deformed else ()
            made = Registration(ids[a], ids[b], "accepted", "", S, np.eye(7), 99, 99, overlap, "test", notes=notes)
            m.store.registrations.save(made, RecipeKey("register", "pair", {"register": 1}).of(a, b))
        placed = {ids[name]: ScenePose(ids[name], S, 0, "placed") for name, S in poses.items()}
        m.store.revisions.save(PoseGraph(placed, {(ids[a], ids[b]): EdgeOutcome("used") for a, b in EDGES}))
        yield m


def room(seed: int) -> np.ndarray:
    return furnished_room(seed, noise_m=0.003, per_m2=250)


def bend(points: np.ndarray) -> np.ndarray:
    return points + SAG_M * (points[:, :1] / 3) ** 2 * [0, 0, 1]


def gaussians(means: np.ndarray, seed: int) -> Gaussians:
    n, sh = len(means), np.random.default_rng(seed).normal(size=(len(means), 1, 3))
    return Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -4.5), np.full(n, 3.0), sh)


def exported(m: Map, out: Path, **options: object) -> tuple[dict[str, np.ndarray], gsmap.map.ExportReport]:
    """Return the exported means of each capture, in the order of its stored Gaussians."""
    report = m.export(out, format="ply", merge="union", provenance=True, **options)
    (tile,) = report.tiles
    path = out / tile.path
    means, data = formats.read(path).means, path.read_bytes()
    start = data.index(b"end_header\n") + 11
    names = [line.split()[-1] for line in data[:start].decode().splitlines() if line.startswith("property")]
    origin = np.frombuffer(data[start:], [(name, "<f4") for name in names])["scene"]
    return {scene.scene_name: means[origin == k] for k, scene in enumerate(tile.scenes)}, report


def off_m(means: np.ndarray) -> float:
    """Return the 95th percentile of the distances of points from the surfaces of the straight room."""
    boxes = np.array([((0, 0, 0), (6, 5, 2.5)), ((1, 1, 0), (2, 2.5, 0.8)), ((4, 3, 0), (5.2, 3.6, 1.9))]) - [
        3,
        2.5,
        1.25,
    ]
    apart = []
    for low, high in boxes:
        outside = np.maximum(np.maximum(low - means, means - high), 0)
        inside = np.minimum(means - low, high - means).min(1)
        apart.append(np.where((outside > 0).any(1), np.linalg.norm(outside, axis=1), np.abs(inside)))
    return float(np.percentile(np.min(apart, axis=0), 95))


@pytest.mark.guards("answers")
def test_bent_captures_are_warped_onto_those_that_agree(site: Map, tmp_path: Path) -> None:
    before, rigid = exported(site, tmp_path / "rigid")
    assert "2 pairs (left:bent, right:bent)" in " ".join(rigid.notes)
    after, report = exported(site, tmp_path / "nonrigid", nonrigid=True)
    for name in ("left", "right"):  # keep pose and shape
        np.testing.assert_array_equal(after[name], before[name])
    for name in ("bent", "after"):
        assert len(after[name]) == len(before[name])
        assert off_m(before[name]) > 0.08
        assert off_m(after[name]) < 0.015  # 6 mm are noise
    # Right agrees with left as left does with right, and overlaps more with bent.
    assert report.notes == (
        "component 0: capture right keeps its shape",
        "capture bent is warped onto right",
        "capture after is warped onto bent",
    )


def test_pairs_are_deformed_by_their_edge_or_those_between_them(site: Map) -> None:
    ids = {scene.name: scene.id for scene in site.scenes()}
    graph = site.store.revisions.get()
    assert graph is not None
    pairs = [(ids[a], ids[b]) for a, b in itertools.combinations(BENT, 2)]
    found = deformed_pairs(site.store, site.settings, graph, pairs)
    assert set(found) == {(ids[a], ids[b]) for a in ("left", "right") for b in ("bent", "after")}


def test_a_tile_is_made_again_for_another_warp(site: Map, tmp_path: Path) -> None:
    _, first = exported(site, tmp_path / "out", nonrigid=True)
    _, again = exported(site, tmp_path / "out", nonrigid=True)
    assert (first.recomputed, again.recomputed) == (1, 0)
    tile = PlannedTile(0, "map", np.array([[0.0] * 3, [1.0] * 3]), {"a": Sim3.identity()}, "whole")
    merge = RecipeKey("merge", "union", {"union": 1})
    recipes = [TileRecipe(merge, warps=warps) for warps in ({}, {"a": "1"}, {"a": "2"}, {"b": "1"})]
    for keys in ([one.key(tile) for one in recipes], [one.merge_key(tile) for one in recipes]):
        assert len(set(keys)) == 3  # b does not reach into the tile
        assert keys[3] == keys[0]


def test_what_a_warp_moves_into_a_box_is_read() -> None:
    whole, bounds = gaussians(room(0), 0), np.array([[-2.5, -3.0, -0.6], [0.0, 3.0, 1.0]])
    warp = Warp(np.zeros(3), 2.0, np.zeros((3, 3)), np.zeros((3, 3, 3)))
    warp.bend[0, 1, 1] = warp.bend[2, 0, 0] = 0.05

    def load(box: np.ndarray | None) -> Gaussians:
        return whole if box is None else whole[((whole.means >= box[0]) & (whole.means <= box[1])).all(1)]

    scene = LazyScene("a", Sim3.identity(), load, load_within=load)
    warped = _warped(scene, warp, warp.largest_motion(np.array([whole.means.min(0), whole.means.max(0)])))
    wanted = warp.apply(whole.means.astype(np.float64)).astype(np.float32)
    np.testing.assert_allclose(warped.load(None).means, wanted, atol=1e-6)
    wanted = wanted[((wanted >= bounds[0]) & (wanted <= bounds[1])).all(1)]
    found = (warped.load_within or warped.load)(bounds).means
    found = found[((found >= bounds[0]) & (found <= bounds[1])).all(1)]
    np.testing.assert_array_equal(found, wanted)


def test_a_map_without_bends_is_merged_as_it_is(site: Map, tmp_path: Path) -> None:
    ids = {scene.name: scene.id for scene in site.scenes()}
    revision = site.store.revisions.newest_number()
    graph = site.store.revisions.get(revision)
    assert graph is not None
    unused = {pair: EdgeOutcome("unused" if ids["bent"] in pair else "used") for pair in graph.outcomes}
    other = site.store.revisions.save(PoseGraph(graph.poses, unused))
    try:
        report = site.export(tmp_path / "out", format="ply", merge="union", nonrigid=True, revision=other)
    finally:
        site.store.revisions.save(PoseGraph(graph.poses, graph.outcomes))
    assert report.notes == ("no capture is stretched or bent: --nonrigid changes nothing",)


def test_an_undescribed_capture_is_refused(site: Map, tmp_path: Path) -> None:
    with raises(InputError, code="no_graph"):
        site.with_settings({"describe.landmarks": False}).export(tmp_path / "out", nonrigid=True)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_a_warp_is_named_by_what_it_does_in_any_unit(unit: float) -> None:
    rng = np.random.default_rng(3)
    warp = Warp(rng.uniform(1, 2, 3) / unit, 3.0 / unit, 0.02 * np.eye(3), np.zeros((3, 3, 3)))

    def digest(**changed: np.ndarray) -> str:
        return WarpedCaptures({}, {"a": replace(warp, **changed)}, ()).digests()["a"]

    assert digest(centre=warp.centre + 1e-6 * warp.radius, bend=np.full((3, 3, 3), -1e-9)) == digest()
    assert len({digest(), digest(strain=0.021 * np.eye(3)), digest(bend=np.full((3, 3, 3), 1e-3))}) == 3
