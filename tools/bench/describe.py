"""How well landmarks of separately trained captures of one place agree, over all pairs of a folder of captures.

    python -m tools.bench.describe ../shared/data/house [--json OUT] [--gain]
    python -m tools.bench.describe --cost [FILE.ply ...]

The folder holds NAME.ply, NAME.cameras.json and truth/NAME.json (``T_scene_world``). For each ordered pair that
overlaps (landmarks of a with surface of b within 10 cm): rep@10 is their share with a landmark of b of the same type
within 10 cm (chance: the same at random points of b's surface), sigma the RMS distance per axis of those
counterparts, recall@1 the share of landmarks with a counterpart within 15 cm whose most similar one is such, correct
the number of mutual best matches within 15 cm, out of how many. ``--gain`` changes each capture's exposure (gain .85
to 1.15, gamma .9 to 1.15).

``--cost`` prints CPU seconds and peak memory instead, for files and for two made captures: a flat of three rooms as
150,000 Gaussians, and one of eight as 2.5 million; each in a process of its own, under both policies.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import resource
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsmap import formats
from gsmap.describe import describe
from gsmap.describe.cloud import surface_cloud
from gsmap.geometry.sh import rgb_of_sh0, sh0_of_rgb
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import Cameras, Gaussians, Sim3
from tools.harness import argument_parser, timed


def exposed(gaussians: Gaussians, gain: float, gamma: float) -> Gaussians:
    """The capture under another exposure (view-independent colour only)."""
    sh = gaussians.sh.copy()
    sh[:, 0] = sh0_of_rgb(gain * np.clip(rgb_of_sh0(sh[:, 0]), 0, 1) ** gamma)
    return replace(gaussians, sh=sh)


def compare(a, b, S_a_b: Sim3, surface_a: np.ndarray, surface_b: np.ndarray) -> dict[str, float] | None:
    """The figures of one ordered pair, or None where less than a tenth of the landmarks of a lie in the overlap."""
    mapped, mapped_surface = S_a_b.apply(b.positions), S_a_b.apply(surface_b)
    inside = cKDTree(mapped_surface).query(a.positions)[0] < 0.1
    if inside.mean() < 0.1:
        return None
    typed = cKDTree(np.c_[mapped, b.types * 1e3])
    distance = typed.query(np.c_[a.positions, a.types * 1e3])[0]
    rng = np.random.default_rng(0)
    random = mapped_surface[rng.integers(len(mapped_surface), size=inside.sum())]
    chance = typed.query(np.c_[random, a.types[inside] * 1e3])[0] < 0.1
    similarity = np.where(a.types[:, None] == b.types[None], a.embeddings @ b.embeddings.T, -2)
    best, back = similarity.argmax(1), similarity.argmax(0)
    right = np.linalg.norm(mapped[best] - a.positions, axis=1) < 0.15
    mutual = back[best] == np.arange(len(a))
    near = inside & (distance < 0.1)
    return {
        "rep@10": float(near.sum() / inside.sum()),
        "chance": float(chance.mean()),
        "sigma": float(np.sqrt((distance[near] ** 2).mean() / 3)) if near.any() else float("nan"),
        "recall@1": float(right[inside & (distance < 0.15)].mean()),
        "correct": int((right & mutual).sum()),
        "matches": int(mutual.sum()),
    }


def dense_capture(rooms: int, count: int, times: int) -> tuple[Gaussians, Cameras]:
    """A made flat of so many rooms; of each Gaussian ``times`` smaller ones in its plane."""
    from gsmap.geometry.rotations import quats_to_matrices
    from gsmap_synthetic import make_captures, make_place

    place = make_place(1, rooms=rooms, texel_m=0.012)
    routes = [sorted((d.a, d.b)) for d in place.doors]
    parts = make_captures(
        1, len(routes), steps=0, num_frames=40, num_gaussians=count // (times * len(routes)), routes=routes, place=place
    )
    whole, views = [], []
    rng = np.random.default_rng(5)
    for part in parts:
        back = Sim3.from_matrix(part.T_scene_world).inverse()
        g = transform_gaussians(part.gaussians, back)
        views.append(transform_cameras(part.cameras, back).T_frame_camera)
        axes = quats_to_matrices(g.quats)
        for _ in range(times):
            step = rng.normal(size=(len(g), 3)) * g.scales
            means = g.means + np.einsum("nij,nj->ni", axes, step)
            scales = g.log_scales - 0.5 * np.log(times)
            whole.append(Gaussians(means, g.quats, scales, g.logit_opacities, g.sh))
    some = parts[0].cameras
    poses = np.concatenate(views)
    rows = np.zeros(len(poses), int)
    return Gaussians.concatenate(whole), Cameras(poses, some.intrinsics_px[rows], some.sizes_px[rows])


def print_costs(files: list[Path]) -> None:
    """CPU seconds and peak memory of describing, a line for each capture and policy."""
    from gsmap.formats import cameras_json

    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as temporary:
        for name, rooms, count, times in (("made_150k", 3, 150_000, 3), ("made_2500k", 8, 2_500_000, 8)):
            gaussians, cameras = dense_capture(rooms, count, times)
            formats.write(Path(temporary) / f"{name}.ply", gaussians)
            cameras_json.write(Path(temporary) / f"{name}.cameras.json", cameras)
            files = [*files, Path(temporary) / f"{name}.ply"]
            del gaussians, cameras
        for path in files:
            for policy in ("known", "auto"):
                process = context.Process(target=_cost, args=(path, policy))
                process.start()
                process.join()


def _cost(path: Path, policy: str) -> None:
    gaussians, cameras = formats.read(path), formats.read_cameras(path.with_suffix(".cameras.json"))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    graph, took = timed(describe, path.stem, gaussians, cameras, scale_policy=policy)
    seconds, peak = took, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{path.stem:12s} {policy:6s} {len(gaussians)} Gaussians, {graph.num_nodes} nodes in {len(graph.layers)} "
        f"layers: {seconds:.1f} CPU s, peak {peak / 1e6:.2f} GB ({before / 1e6:.2f} GB before)",
        flush=True,
    )


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="*")
    parser.add_argument("--cost", action="store_true", help="print CPU seconds and peak memory alone")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--gain", action="store_true", help="change each capture's exposure")
    options = parser.parse_args()
    if options.cost:
        return print_costs(options.folder)
    if len(options.folder) != 1:
        parser.error("give one folder, or --cost")
    (folder,) = options.folder
    rng = np.random.default_rng(0)
    scenes = {}
    for path in sorted(folder.glob("*.ply")):
        gaussians = formats.read(path)
        cameras = formats.read_cameras(path.with_suffix(".cameras.json"))
        if options.gain:
            gaussians = exposed(gaussians, rng.uniform(0.85, 1.15), rng.uniform(0.9, 1.15))
        record = json.loads((folder / "truth" / f"{path.stem}.json").read_text())
        graph, seconds = timed(describe, path.stem, gaussians, cameras, scale_policy="known")
        layer = graph.layers["landmarks"]
        print(f"{path.stem}: {len(gaussians)} Gaussians, {len(layer)} landmarks, {seconds:.1f} CPU s")
        truth = Sim3.from_matrix(np.array(record["T_scene_world"]))
        scenes[path.stem] = (layer, truth, surface_cloud(gaussians).points)
    rows = []
    for one, two in itertools.permutations(scenes, 2):
        (a, S_a, surface_a), (b, S_b, surface_b) = scenes[one], scenes[two]
        figures = compare(a, b, S_a @ S_b.inverse(), surface_a, surface_b)
        if figures:
            rows.append({"pair": f"{one}-{two}", **figures})
    names = [k for k in rows[0] if k != "pair"] if rows else []
    print("pair    " + "".join(f"{n:>10}" for n in names))
    mean = {"pair": "mean", **{n: float(np.nanmean([r[n] for r in rows])) for n in names}}
    for row in [*rows, mean]:
        print(f"{row['pair']:8}" + "".join(f"{row[n]:10.3f}" for n in names))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
