"""What georeferencing gives on made sites of 100 captures: errors of check points, digits, blunders, covariances.

    python -m tools.bench.world [--sites 10] [--nees 40] [--folder DIR]

Registrations of the made sites are as good as of a street in `large_maps` (0.2 mrad, 1 mm), control points are
surveyed to 1 cm per axis and picked to half a pixel in three photos each. Errors are against the truth, not against the
survey, which has errors of its own. CPU seconds are of one thread.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

import gsmap
from gsmap.formats import gcp_list, tiles3d
from gsmap.geodesy.crs import ECEF
from gsmap.geodesy.frame import from_frame, to_frame
from gsmap.geodesy.survey import in_frame
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.umeyama import umeyama
from gsmap.map import Map
from gsmap.map.world.georeference import Request
from gsmap.optimize import joint_covariance, optimize
from gsmap.types import PoseGraph
from gsmap.types.world import ControlPoint, Georeference, ImagePoint, Survey
from gsmap_synthetic.surveyed import Site, SiteParams, ground, surveyed_site
from tools.harness import argument_parser, timed


def survey_of(site: Site, sigma_m: float = 0.01, sigma_px: float = 0.5) -> Survey:
    """What a catalog would hold of a site's marks, in the world frame."""
    checks, row, images = set(site.checks()), {name: k for k, name in enumerate(site.names)}, []
    for mark in site.marks:
        cameras = site.cameras[row[mark.scene]]
        for photo, pixel in mark.pixels.items():
            k = cameras.names.index(photo)
            pose, intrinsics = cameras.T_frame_camera[k], cameras.intrinsics_px[k]
            images.append(ImagePoint(mark.name, photo, mark.scene, np.array(pixel), sigma_px, pose, intrinsics))
    sigmas = (sigma_m, sigma_m)
    points = [ControlPoint(m.name, site.frame.crs, m.surveyed, sigmas, m.name in checks) for m in site.marks]
    return in_frame(Survey(site.frame, tuple(points), tuple(images)))


def errors(site: Site, answer: PoseGraph, tie: Georeference, marks: str) -> np.ndarray:
    """(N, 3) m: where the map has marks of a kind (``G``, ``C``), less where they are."""
    assert tie.S_world_map is not None
    truth, out = dict(zip(site.names, site.truth, strict=True)), []
    for mark in site.marks:
        if mark.name.startswith(marks):
            local = truth[mark.scene].inverse().apply(mark.true_m)
            out.append(tie.S_world_map.apply(answer.poses[mark.scene].S_map_scene.apply(local)) - mark.true_m)
    return np.array(out)


def rms(off: np.ndarray) -> float:
    return float(np.sqrt((off**2).sum(1).mean()))


def check_points(sites: int, params: SiteParams, what: str) -> None:
    """Check points beside a similarity alone, which is what aligning a finished map does."""
    bent, rigid, axes, seconds = [], [], [], []
    for seed in range(sites):
        site = surveyed_site(seed, params)
        survey = survey_of(site)
        answer, took = timed(optimize, site.names, site.edges, survey=survey)
        seconds.append(took)
        off = errors(site, answer, answer.world[0], "C")
        bent.append(rms(off))
        axes.append(np.sqrt((off**2).mean()))
        rigid.append(_by_similarity(site, survey))
    print(
        f"{what}: check points {100 * np.mean(bent):.2f} cm RMS in 3D (worst site {100 * max(bent):.2f}), "
        f"{100 * np.mean(axes):.2f} cm per axis; by a similarity alone {100 * np.mean(rigid):.2f} cm; "
        f"{np.mean(seconds):.2f} CPU s a solve; {sites} sites"
    )


def _by_similarity(site: Site, survey: Survey) -> float:
    alone = optimize(site.names, site.edges)
    truth = dict(zip(site.names, site.truth, strict=True))
    at = np.array(
        [
            alone.poses[m.scene].S_map_scene.apply(truth[m.scene].inverse().apply(m.true_m))
            for m in site.marks
        ]
    )  # fmt: skip
    surveyed, true = np.array([p.position for p in survey.points]), np.array([m.true_m for m in site.marks])
    control = np.array([m.name.startswith("G") for m in site.marks])
    S = umeyama(surveyed[control], at[control], with_scale=True)
    return rms((S.apply(at) - true)[~control])


def blunders(sites: int, params: SiteParams) -> None:
    """One control point of five is surveyed wrongly; sites are many, sizes from 6 cm to a slipped digit."""
    rng = np.random.default_rng(1)
    for size in (0.06, 0.1, 0.3, 1.0, 10.0, 1000.0, 100_000.0):
        found = alone = tied = 0
        left = []
        for seed in range(sites):
            site = surveyed_site(1000 + seed, params)
            name = f"G{rng.integers(params.num_control)}"
            way = rng.normal(size=3)
            bad = site.with_blunder(name, size * way / np.linalg.norm(way))
            answer = optimize(bad.names, bad.edges, survey=survey_of(bad))
            tie = answer.world[0]
            out = [row.name for row in tie.residuals if row.kind == "point" and row.use == "outlier"]
            found += name in out
            alone += out == [name]
            tied += tie.S_world_map is not None
            if tie.S_world_map is not None:
                left.append(rms(errors(site, answer, tie, "C")))
        print(
            f"blunder of {size:g} m in one of {params.num_control}: named {found} of {sites}, and no other {alone}; "
            f"tied {tied}; check points {100 * np.median(left):.2f} cm RMS (median)"
        )


def honest(count: int, params: SiteParams) -> None:
    """NEES of the world poses of captures, and of check points by the residual table."""
    poses, points, false = [], [], 0
    for seed in range(count):
        site = surveyed_site(2000 + seed, params)
        survey = survey_of(site)
        answer = optimize(site.names, site.edges, survey=survey)
        tie = answer.world[0]
        assert tie.S_world_map is not None
        false += sum(row.use == "outlier" for row in tie.residuals)
        points += [row.statistic for row in tie.residuals if row.use == "check" and row.statistic is not None]
        for k in np.linspace(0, len(site.names) - 1, 4).astype(int).tolist():
            joint = joint_covariance(answer, site.edges, (), survey, [site.names[k]], 0)
            pose = answer.poses[site.names[k]].S_map_scene
            both = np.concatenate([Similarities.stack([pose]).inverse().adjoint()[0], np.eye(7)], axis=1)
            step = Similarities.stack([(tie.S_world_map @ pose).inverse() @ site.truth[k]]).log()[0]
            poses.append(float(step @ np.linalg.solve(both @ joint @ both.T, step)))
    for what, values, dof in (("world poses of captures", poses, 7), ("check points", points, 3)):
        middle = np.median(values) / chi2.ppf(0.5, dof)
        inside = 100 * np.mean(np.array(values) < chi2.ppf(0.95, dof))
        print(
            f"NEES of {what} ({dof} dof): mean {np.mean(values) / dof:.2f} and median {middle:.2f} of expectation, "
            f"{inside:.0f} % within 95 %; {len(values)} of them on {count} sites of {params.rows * params.columns}"
        )
    print(f"good observations called outliers: {false}")


def through_a_map(folder: Path, params: SiteParams) -> None:
    """One site as a map on disk: digits through store, poses and 3D Tiles, and what the verbs cost."""
    site = surveyed_site(0, params)
    gcp_list.write(folder / "gcp_list.txt", site.frame.crs, site.gcp_lines())
    with gsmap.map.create(folder / "site.gsmap") as m:
        _fill(m, site, params)
        m.optimize()
        start = time.process_time()
        report = m.georeference(Request(gcp=folder / "gcp_list.txt", check=site.checks()))
        took = time.process_time() - start
        (row,) = report.components
        print(
            f"georeference of {len(site.names)} captures on disk: {took:.2f} CPU s; RMS of control {row.rms_m:.4f} m, "
            f"of check points against their survey {row.rms_check_m:.4f} m; {row.num_outliers} outliers"
        )
        before = {pose.scene_name: pose.world for pose in m.pose_rows()}
        m.write_poses(folder / "poses.json", "json")
        m.export(folder / "tiles", tile_size_m=40, format="3dtiles", merge="union")
        tie = m.store.revisions.world()[0]
        start = time.process_time()
        measured = m.measure(f"{site.names[0]}:0,0,0", f"{site.names[-1]}:0,0,0")
        true = float(np.linalg.norm(site.truth[0].translation - site.truth[-1].translation))
        print(
            f"measure across the site: {measured.distance_m:.4f} +- {measured.sigma_m:.4f} m, truly {true:.4f}; "
            f"{time.process_time() - start:.2f} CPU s"
        )
    with gsmap.map.open(folder / "site.gsmap") as m:
        again = {pose.scene_name: pose.world for pose in m.pose_rows()}
    exported = {
        row["scene_name"]: np.array(row["world"]) for row in json.loads((folder / "poses.json").read_text())["poses"]
    }
    print(f"largest coordinate: {max(np.abs(v).max() for v in before.values() if v is not None):.4f}")
    print(f"through the store: off by {1000 * _most(before, again):.2g} mm")
    print(f"through the export of poses: off by {1000 * _most(before, exported):.2g} mm")
    assert tie.frame is not None
    assert tie.S_world_map is not None
    frame, (tileset,) = tie.frame, (folder / "tiles").glob("component_0/tileset.json")
    transform = np.reshape(json.loads(tileset.read_text())["root"]["transform"], (4, 4)).T
    stored = tiles3d.read(tileset).means[::1000].astype(np.float64)
    from_tiles = from_frame(frame, to_frame(frame, stored @ transform[:3, :3].T + transform[:3, 3], ECEF))
    want = from_frame(frame, tie.S_world_map.apply(stored))
    off = 1000 * np.abs(from_tiles - want).max()
    print(f"from 3D Tiles' Earth-centred frame back to {frame.crs}: off by {off:.2g} mm")
    utm = np.array([v for v in before.values() if v is not None])
    there = from_frame(frame, to_frame(frame, utm))
    print(f"{frame.crs} to the world frame and back: off by {1000 * np.abs(there - utm).max():.2g} mm")


def _most(a: dict[str, np.ndarray | None], b: dict[str, np.ndarray | None]) -> float:
    return max(float(np.abs(np.asarray(a[name]) - np.asarray(b[name])).max()) for name in a)


def _fill(m: Map, site: Site, params: SiteParams) -> None:
    base = ground(params.unit_m)
    for k, (name, cameras) in enumerate(zip(site.names, site.cameras, strict=True)):
        m.store.scenes.add(replace(base, sh=base.sh + np.float32(1e-3 * k)), cameras, name=name)
    for edge in site.edges:
        sigmas = np.diag(edge.information) ** -0.5
        m.add_edge(f"{edge.target}:{edge.source}", edge.S_target_source, sigmas)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--sites", type=int, default=10)
    parser.add_argument("--nees", type=int, default=40)
    parser.add_argument("--folder", type=Path, help="where to keep the map; a temporary one by default")
    options = parser.parse_args(arguments)
    params = SiteParams()
    check_points(options.sites, params, "five control points at 1 cm, 100 captures")
    street = replace(params, rows=2, columns=50, cross_every=99, edge_rotation_rad=4e-4, edge_translation_m=2e-3)
    check_points(options.sites, replace(street, num_control=9), "nine along a street that closes no loop")
    blunders(options.sites, params)
    honest(options.nees, replace(params, rows=6, columns=6, num_check=10))
    if options.folder is not None:
        options.folder.mkdir(parents=True)
        through_a_map(options.folder, params)
    else:
        with tempfile.TemporaryDirectory() as folder:
            through_a_map(Path(folder), params)


if __name__ == "__main__":
    main()
