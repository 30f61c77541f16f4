"""Captures that are stretched along one axis, or bent: how many accepted pairs say so, and how well they measure it.

    python -m tools.bench.deform --made 21 22 23 24 [--bend] [--percent 0 1 2 3 4] [--captures FOLDER --pairs c0:c1 ...]
    python -m tools.bench.deform --rigid 8201 8202 8203

Every place is captured twice. The second capture is ingested as it is and deformed by each percentage, with its
cameras, and each is registered with the first one: stretched along an axis of its frame drawn at random, or, with
``--bend``, bent so that its middle sags by the percentage of its longest extent (x' = x + a y^2, towards a direction
drawn at random). ``--captures`` takes pairs of a folder of captures (NAME.ply, NAME.cameras.json) besides. One row for
each percentage: pairs, accepted ones, accepted ones that say that they are stretched or bent (all but the first row
should), and the largest error of a named stretch.

``--rigid`` counts undeformed pairs that are named as bent or stretched: places of these seeds are captured eight times
(0, 40 or 80 steps of training, two routes, varied exposure), and all pairs are tested under their true poses.
"""

from __future__ import annotations

import itertools
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.geometry.warps import deform_gaussians
from gsmap.map import Map
from gsmap.register.deformation import fit_deformation
from gsmap.register.prepare import prepare
from gsmap.register.surface import Surface
from gsmap.register.view_cache import PreparedViews
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic import make_captures, make_place, write_captures
from gsmap_synthetic.capture import default_routes
from tools.bench.change_scores import claims_of, score_changes
from tools.harness import argument_parser, print_table, say
from tools.make.change_truth import Truth

_STRETCHED = re.compile(r"change by ([+-][\d.]+)% along")
SURE = 0.8
_BENT = re.compile(r"would have to bend along")
Capture = tuple[Gaussians, Cameras]


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--changes", type=Path, nargs="+", help="folders of tools/make/change.py")
    parser.add_argument("--rigid", type=int, nargs="+", help="seeds of places whose undeformed pairs are tested")
    parser.add_argument("--made", type=int, nargs="*", default=[21, 22, 23, 24], help="seeds of places")
    parser.add_argument("--bend", action="store_true", help="bend the captures instead of stretching them")
    parser.add_argument("--percent", type=float, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--captures", type=Path, help="folder of captures")
    parser.add_argument("--pairs", nargs="*", default=[], help="of captures, A:B")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    if given.changes:
        _print_changes(given.changes, given.percent, bend=given.bend)
        return
    if given.rigid:
        rows = [_count_rigid(seed) for seed in given.rigid]
        print_table(["place", "pairs tested", "named"], [*rows, ("all", *np.sum(rows, axis=0)[1:].tolist())])
        return
    counts = {percent: [0, 0, 0, 0, 0.0] for percent in given.percent}
    with tempfile.TemporaryDirectory(prefix="gsmap-deform-") as folder:
        for name, target, source in _pairs(given.made, given.captures, given.pairs, Path(folder)):
            with gsmap.map.create(Path(folder) / f"{name}.gsmap") as m:
                for percent, row in counts.items():
                    if given.bend:
                        _measure(m, target, bent(*source, percent, rng), percent, None, row)
                    else:
                        _measure(m, target, stretched(*source, percent, int(rng.integers(3))), percent, percent, row)
            say(name)
    columns = ["deformation, %", "pairs", "accepted", "stretched", "bent", "largest error of the stretch, %"]
    print_table(columns, [[percent, *row[:4], f"{row[4]:.2f}"] for percent, row in counts.items()])


def _pairs(seeds: list[int], captures: Path | None, pairs: list[str], folder: Path):
    for seed in seeds:
        place = folder / f"place{seed}"
        made = make_captures(seed, 2, steps=0, num_frames=40, num_gaussians=40_000, size_px=(240, 180))
        yield f"place {seed}", *(_read(place, path.stem) for path in write_captures(place, made))
    for pair in pairs:
        yield pair.replace(":", "-"), *(_read(captures, name) for name in pair.split(":"))


def _count_rigid(seed: int) -> tuple[int, int, int]:
    """Return the seed of a place, the number of pairs of its captures that are tested, and of those that are named."""
    rng = np.random.default_rng(seed)
    place = make_place(seed, texel_m=0.012)
    routes = default_routes(place, 2)
    surfaces, poses = [], []
    for k in range(8):
        (made,) = make_captures(
            *(seed, 1),
            steps=(0, 40, 80)[k % 3],
            num_frames=34,
            num_gaussians=int(rng.integers(18_000, 34_000)),
            size_px=(200, 150),
            place=place,
            routes=[routes[k % 2]],
            vary_exposure=True,
            first=k,
        )
        prepared = prepare(made.name, made.gaussians.degree_0(), made.cameras, 1.0)
        splats = made.gaussians.degree_0(prepared.is_surface)
        views = PreparedViews(prepared) if len(prepared.cameras) else None
        surfaces.append(Surface.from_splats(splats, 1.0, made.gaussians, made.cameras, views, prepared))
        poses.append(Sim3.from_matrix(np.array(made.T_scene_world)))
    fits = [
        fit_deformation(surfaces[i], surfaces[j], poses[i] @ poses[j].inverse())
        for i, j in itertools.combinations(range(8), 2)
    ]
    named = [fit.is_bent or fit.is_stretched for fit in fits if fit is not None]
    say(f"place {seed}: {sum(named)} of {len(named)} named")
    return seed, len(named), sum(named)


def _print_changes(places: list[Path], percents: list[float], *, bend: bool) -> None:
    """Print what is claimed and found of each deformation, over all pairs."""
    columns = ["deformation, %", "pairs", "compared", "named", "claims", "false", f"false, confidence >= {SURE}"]
    counts = {percent: np.zeros(8, dtype=int) for percent in percents}
    for folder in places:
        truth = Truth(folder)
        for percent, row in counts.items():
            for newer in truth.times[1:]:
                rng = np.random.default_rng([int(10 * percent), *folder.name.encode()])
                first = _read(folder, truth.times[0])
                older = bent(*first, percent, rng) if bend else stretched(*first, percent, int(rng.integers(3)))
                found = _compared(truth, older, newer)
                row += found
                say(f"{folder.name} {percent:g} % {newer}: {found}")
    print_table([*columns, "changed objects", "found"], [[percent, *row] for percent, row in counts.items()])


def _compared(truth: Truth, older: Capture, newer: str) -> list[int]:
    """Compare a deformed first capture with another one; return the counts of a row."""
    with tempfile.TemporaryDirectory(prefix="gsmap-deform-") as folder, gsmap.map.create(Path(folder) / "m.gsmap") as m:
        first = truth.times[0]
        m.ingest(older[0], cameras=older[1], name=first, captured_at=truth.captured_at(first))
        gaussians, cameras = _read(truth.folder, newer)
        m.ingest(gaussians, cameras=cameras, name=newer, captured_at=truth.captured_at(newer))
        m.update()
        poses = {row.name: row.component for row in m.scene_rows()}
        if poses[first] != poses[newer]:
            return [1, 0, 0, 0, 0, 0, 0, 0]
        named = any(_STRETCHED.search(note) or _BENT.search(note) for note in m.show_pair(f"{first}:{newer}").notes)
        m.changes()
        (one,) = m.store.changes.current()
        claims = [change for change in m.store.changes.load(one.number).changes if len(change.voxels)]
    S_place_frame = truth.T_place_scene(newer) @ one.S_frame_newer.inverse()
    found = score_changes(truth, first, newer, claims_of(claims, S_place_frame))
    wrong = [not row["right"] for row in found["claim_rows"]]
    sure = sum(bad and claim.confidence >= SURE for bad, claim in zip(wrong, claims, strict=True))
    return [1, 1, named, len(claims), sum(wrong), sure, found["objects"], found["found"]]


def _read(folder: Path, name: str) -> Capture:
    return formats.read(folder / f"{name}.ply"), formats.read_cameras(folder / f"{name}.cameras.json")


def _measure(m: Map, target: Capture, source: Capture, percent: float, stretch: float | None, row: list[float]) -> None:
    """Register a deformed source with the target, and count it in a row."""
    if not m.scene_rows():
        m.ingest(target[0], cameras=target[1], name="target")
    name = f"deformed {percent:g}"
    m.ingest(source[0], cameras=source[1], name=name)
    m.describe()
    (edge,) = m.register(f"target:{name}")
    notes = m.show_pair(f"target:{name}").notes
    named = [float(found[1]) for note in notes if (found := _STRETCHED.search(note))]
    row[0] += 1
    row[1] += edge.status == "accepted"
    row[2] += bool(named)
    row[3] += any(_BENT.search(note) for note in notes)
    if stretch is not None:
        # Relative to the other directions, what was stretched must shrink to fit, or the other capture must grow.
        wanted = 100 * (1 / (1 + stretch / 100) - 1) if edge.source_name == name else stretch
        row[4] = max([row[4], *(abs(value - wanted) for value in named)])


def stretched(gaussians: Gaussians, cameras: Cameras, percent: float, axis: int) -> Capture:
    """Stretch a capture along an axis of its frame."""
    A = np.eye(3)
    A[axis, axis] += percent / 100
    poses = cameras.T_frame_camera.copy()
    poses[:, :3, 3] = poses[:, :3, 3] @ A.T
    moved = deform_gaussians(gaussians, gaussians.means.astype(np.float64) @ A.T, A)
    return moved, replace(cameras, T_frame_camera=poses)


def bent(gaussians: Gaussians, cameras: Cameras, percent: float, rng: np.random.Generator) -> Capture:
    """Bend a capture so that its middle sags by some percent of its longest extent, towards a random direction."""
    move = sag(gaussians.means.astype(np.float64), percent, rng)
    moved = deform_gaussians(gaussians, *move(gaussians.means.astype(np.float64)))
    poses = cameras.T_frame_camera.copy()
    poses[:, :3, 3], turns = move(poses[:, :3, 3])
    u, _, vt = np.linalg.svd(turns @ poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    return moved, replace(cameras, T_frame_camera=poses)


def sag(means: np.ndarray, percent: float, rng: np.random.Generator):
    """Return a function from points (N, 3) to their bent positions and the (N, 3, 3) derivatives of these."""
    middle = np.median(means, axis=0)
    along = np.linalg.eigh(np.cov((means - middle).T))[1][:, 2]
    low, high = np.percentile((means - middle) @ along, [1, 99])
    middle, half = middle + along * (low + high) / 2, (high - low) / 2
    down = np.cross(along, rng.normal(size=3))
    down /= np.linalg.norm(down)
    depth = 2 * half * percent / 100

    def move(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way = (points - middle) @ along / half
        return (
            points + depth * way[:, None] ** 2 * down,
            np.eye(3) + 2 * depth / half * way[:, None, None] * np.outer(down, along),
        )

    return move


if __name__ == "__main__":
    main()
