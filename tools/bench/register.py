"""Registers all pairs of captures with known poses: gsmap, what else one would pick, and ablations, in one table.

A folder holds captures (NAME.ply, NAME.cameras.json) and truth/NAME.json with T_scene_world. Pairs of different folders
share nothing. CPU seconds are of the process, single-threaded: features of single captures count in every pair they are
used in, but scene graphs are described once (`bench_describe.py`) and kept, with everything else that is made, in the
folder that --cache names.

    python -m tools.bench.register house kitchen_splats --methods all --json out.json --cache FOLDER
    python -m tools.bench.register house kitchen_splats --methods ablations --cache FOLDER
    python -m tools.bench.register house kitchen_splats --methods ablations --encoder mobilenet.onnx --cache FOLDER
    python -m tools.bench.register house kitchen_splats --methods gsmap --rescale
    python -m tools.bench.register --made 6 --captures 3 --methods gsmap

Under the table stands how honest the poses' covariances are: normalised squared errors against the truth and around
triangles of accepted edges, next to the chi-square they should follow. With --encoder, by whose features objects are
then told, stands there how alike the contexts of objects are that lie more than 6 m apart.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools import harness
from tools.bench.registration_summary import summarise
from tools.harness import argument_parser, say, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import itertools
import json
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

import gsmap.map
from gsmap.evaluate.calibration import nees_of_edge, truth_covariance
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import PoseError, pose_error, scene_centroid
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.map.stages.describe import graph_keys
from gsmap.optimize.cycles import cycle_chi2, list_triangles
from gsmap.optimize.measurements import measurements
from gsmap.register import SceneView
from gsmap.register.context import add_context
from gsmap.types import Cameras, Edge, Gaussians, Sim3
from tools.bench.registration_methods import ABLATIONS, METHODS, Answer, Capture, Method

OVERLAPPING, APART = 0.25, 0.01
GATE = 0.999  # of the optimiser


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--made", type=int, default=0, metavar="N", help="also N generated places")
    parser.add_argument("--captures", type=int, default=1, metavar="N", help="of each generated place")
    known = ", ".join([*METHODS, *ABLATIONS])
    parser.add_argument("--methods", default="gsmap", help=f"all (without ablations), ablations, none, or of: {known}")
    parser.add_argument("--rescale", action="store_true", help="each capture in a random unit, 1/5 to 5, not told")
    parser.add_argument("--encoder", type=Path, metavar="FILE.onnx", help="an image encoder that objects are told by")
    parser.add_argument("--pixels", default="imagenet", help="how that encoder's pixels are scaled")
    parser.add_argument("--overlapping", action="store_true", help="only pairs that overlap, for slow methods")
    parser.add_argument("--cache", type=Path, help="keep scene graphs and generated places here")
    parser.add_argument("--json", type=Path, help="keep the rows here; those it holds already are printed along")
    parser.add_argument("--verbose", action="store_true", help="one line per pair")
    options = parser.parse_args()
    groups = {"all": [*METHODS], "ablations": [*ABLATIONS], "none": []}
    names = groups.get(options.methods) if options.methods in groups else options.methods.split(",")
    if "splatreg" in names and not _installed("splatreg"):
        say("splatreg is not installed: left out")
        names.remove("splatreg")
    with tempfile.TemporaryDirectory() as temporary:
        pairs = read_pairs(options, options.cache or Path(temporary)) if names else []
        pairs = [p for p in pairs if not options.overlapping or p[2] >= OVERLAPPING]
        for name in names:
            row = measure(name, {**METHODS, **ABLATIONS}[name], pairs, options.verbose)
            row["method"] += " rescaled" if options.rescale else ""
            row["method"] += f" {options.encoder.stem}" if options.encoder else ""
            if options.json:
                rows = _kept(options.json)
                rows[row["method"]] = row
                options.json.write_text(json.dumps(rows, indent=1))
            else:
                print_table([row])
        if options.encoder:
            print(contexts_apart(pairs))
    if options.json:
        print_table(list(_kept(options.json).values()))


def _kept(path: Path) -> dict[str, dict]:
    return json.loads(path.read_text()) if path.exists() else {}


# --- captures ------------------------------------------------------------------------------------------------------


def read_pairs(options: argparse.Namespace, cache: Path) -> list[tuple[Capture, Capture, float]]:
    """All pairs with their true overlap."""
    cache.mkdir(parents=True, exist_ok=True)
    folders = options.folders + [make_place(cache, seed, options.captures) for seed in range(options.made)]
    rng = np.random.default_rng(0)
    captures = []
    with gsmap.map.open_or_create(cache / f"bench{options.encoder.stem if options.encoder else ''}.gsmap") as m:
        if options.encoder:
            m.add_model("clip", options.encoder, preset=options.pixels)
        for folder in folders:
            for read in read_captures(folder):
                truth = folder / "truth" / f"{read.name}.json"
                if truth.exists():
                    S = Sim3.from_matrix(np.array(json.loads(truth.read_text())["T_scene_world"]))
                    parts = read.gaussians, read.cameras, S
                    if options.rescale:
                        parts = rescaled(*parts, float(np.exp(rng.uniform(-1, 1) * np.log(5))))
                    policy = "unknown" if options.rescale else "auto"
                    captures.append(described(m, read.name, folder.name, *parts, policy))
    for c in captures:  # surfaces are shared by all methods, so none pays for them
        c.surface().cloud  # noqa: B018
    return [(a, b, true_overlap(a, b)) for a, b in itertools.combinations(captures, 2)]


def described(m, name: str, place: str, gaussians: Gaussians, cameras: Cameras, S: Sim3, policy: str) -> Capture:
    """The capture with the scene graph that a map keeps of it, made where the map does not know it yet."""
    scene, new = m.store.scenes.add(gaussians, cameras, name=f"{place}-{name}", scale_policy=policy)
    start = time.process_time()
    m.describe(scene.id)
    graph = m.store.graphs.load(scene.id, graph_keys(m.store, [scene], m.settings)[scene.id])
    say(f"{name}: {graph.num_nodes} nodes" + (f", {time.process_time() - start:.1f} CPU s" if new else ""))
    gaussians, cameras = m.store.scenes.gaussians(scene.id), m.store.scenes.cameras(scene.id)
    return Capture(name, place, SceneView(scene.id, gaussians, cameras, graph, policy), S)


def make_place(cache: Path, seed: int, count: int) -> Path:
    from gsmap_synthetic import make_captures, write_captures

    folder = cache / f"made_{seed}_{count}"
    if not folder.exists():
        say(f"making place {seed}")
        made = make_captures(seed, count, num_frames=40, num_gaussians=40_000, size_px=(240, 180))
        write_captures(folder, made)
    return folder


def rescaled(gaussians: Gaussians, cameras: Cameras, S_scene_world: Sim3, factor: float):
    """A capture in another unit."""
    S = Sim3(np.eye(3), np.zeros(3), factor)
    return transform_gaussians(gaussians, S), transform_cameras(cameras, S), S @ S_scene_world


def true_overlap(a: Capture, b: Capture) -> float:
    """The smaller of both directions' share of opaque, not huge Gaussians within 8 cm of one of the other's."""
    if a.place != b.place:
        return 0.0
    centres = {c.view.id: solid_centres(c.view.gaussians, c.S_scene_world) for c in (a, b)}
    (overlap,) = true_overlaps(list(centres), centres.__getitem__).values()
    return overlap


# --- measuring -----------------------------------------------------------------------------------------------------


def measure(name: str, method: Method, pairs: list[tuple[Capture, Capture, float]], verbose: bool) -> dict:
    """One row of the table: every pair by one method."""
    records, seconds = [], []
    for a, b, overlap in pairs:
        answer, took = timed(method, a, b)
        seconds.append(took + answer.shared_s)
        error = None
        if answer.pose is not None and a.place == b.place:
            error = pose_error(answer.pose, _truth(a, b), scene_centroid(b.view.gaussians))
            error = replace(error, centroid_m=error.centroid_m / a.S_scene_world.scale)
        records.append((a, b, overlap, answer, error))
        if verbose:
            said = "no pose" if answer.pose is None else "pose" if error is None else _text(error)
            say(f"{name:14s} {a.name}-{b.name} overlap {overlap:.2f} {seconds[-1]:5.2f} s  {said}  {answer.note}")
    wanted = [r for r in records if r[2] >= OVERLAPPING]
    places = {a.place: [] for a, *_ in wanted}
    for a, *_, e in wanted:
        places[a.place].append(e)
    apart = [r for r in records if r[2] < APART]
    surest_wrong = max([x.score for *_, x, e in apart if x.pose is not None and not (e and _right(e))], default=-np.inf)
    return {
        "method": name,
        "places": {p: asdict(summarise(errors)) for p, errors in places.items()},
        "summary": asdict(summarise([r[-1] for r in wanted])),
        "wrong": sum(e is not None and not _right(e) for *_, e in records),
        "apart": len(apart),
        "accepted_apart": sum(x.pose is not None and not (e and _right(e)) for *_, x, e in apart),
        "told": sum(e is not None and _right(e) and x.score > surest_wrong for *_, x, e in wanted),
        "scored": bool(np.isfinite([x.score for *_, x, _ in records if x.pose is not None]).any()),
        "cpu_s": float(np.median(seconds)),
        "cpu_s_max": float(np.max(seconds)),
        "honesty": honesty(records),
        "each": [
            {"target": a.name, "source": b.name, "overlap": o, "error": e and asdict(e), "posed": x.pose is not None}
            for a, b, o, x, e in records
        ],
    }


TRUTH_SIGMA = {"kitchen_splats": (0.5, 0.02)}
"""Standard deviations (degrees, metres) of truths that are not exact: a sensor whose colour and depth cameras are not
registered. Honesty is told with them and without."""


def honesty(records: list[tuple[Capture, Capture, float, Answer, PoseError | None]]) -> dict[str, dict]:
    """By place: normalised squared errors (6 degrees of freedom, 7 with scale) of right poses, and of triangles."""
    out = {}
    for place in {a.place for a, *_ in records}:
        right = [
            (Edge(a.view.id, b.view.id, x.pose, x.information), _truth(a, b))
            for a, b, _, x, e in records
            if a.place == place and x.information is not None and e is not None and _right(e)
        ]
        if not right:
            continue
        edges = [edge for edge, _ in right]
        m = measurements(list(dict.fromkeys(s for e in edges for s in (e.target, e.source))), edges)
        errors = (m.measured.inverse() @ Similarities.stack([true for _, true in right])).log()[:, : m.dim]
        cycles = cycle_chi2(m, *list_triangles(m.targets, m.sources, m.num_scenes))
        nees = np.einsum("ed,edf,ef->e", errors, m.information, errors)
        out[place] = {"dof": m.dim, "nees": nees.tolist(), "cycles": cycles.tolist()}
        if place in TRUTH_SIGMA:
            degrees, metres = TRUTH_SIGMA[place]
            allowed = []
            for a, b, _, x, e in records:
                if a.place == place and x.information is not None and e is not None and _right(e):
                    unit, centroid = b.S_scene_world.scale, scene_centroid(b.view.gaussians)
                    of_truth = truth_covariance(float(np.radians(degrees)), metres * unit, centroid)
                    allowed.append(nees_of_edge(x.pose, x.information, _truth(a, b), of_truth).value)
            out[place]["allowed"] = allowed
    return out


def _truth(a: Capture, b: Capture) -> Sim3:
    return a.S_scene_world @ b.S_scene_world.inverse()


def _right(e: PoseError) -> bool:
    return e.rre_deg < 5 and e.centroid_m < 0.3


def _text(e: PoseError) -> str:
    return f"{e.rre_deg:.2f} deg {100 * e.centroid_m:.1f} cm scale {e.rse:.2%}"


def contexts_apart(pairs: list[tuple[Capture, Capture, float]]) -> str:
    """How alike the contexts of objects of one capture are that lie more than 6 m apart, over all pairs."""
    cosines = []
    for a, b, _ in pairs:
        layers = [capture.graph.layers["objects"] for capture in (a, b)]
        for plain, joined in zip(layers, add_context(*layers), strict=True):
            contexts = joined.embeddings[:, plain.features.shape[1] :].astype(np.float64)
            contexts /= np.maximum(np.linalg.norm(contexts, axis=1, keepdims=True), 1e-12)
            at = plain.positions * plain.unit_m
            far = np.triu(np.linalg.norm(at[:, None] - at[None], axis=2) > 6, 1)
            cosines.append((contexts @ contexts.T)[far])
    values = np.concatenate(cosines)
    low, middle, high = np.percentile(values, [5, 50, 95])
    return (
        f"contexts of objects more than 6 m apart: median cosine {middle:.3f}, 5 to 95 % {low:.3f} to {high:.3f} "
        f"({len(values)} pairs of objects)"
    )


# --- the table -----------------------------------------------------------------------------------------------------


def print_table(rows: list[dict]) -> None:
    heads = "posed", "fine", "coarse", "wrong", "apart", "told", "median", "worst", "scale", "CPU_s", "max"
    lines = []
    for r in rows:
        s, places = r["summary"], r["places"].values()
        cells = [f"{s['num_estimated']} of {s['num_pairs']}"]
        for bar in ("fine", "coarse"):
            right = [round(p["recall"][bar] * p["num_pairs"]) for p in places]
            cells.append("+".join(map(str, right)) if len(right) <= 3 else str(sum(right)))
        cells += [r["wrong"], f"{r['accepted_apart']} of {r['apart']}" if r["apart"] else "not run"]
        cells += [r["told"] if r["scored"] and r["apart"] else ""]
        cells += [f"{s[f'{k}_rre_deg']:.2f}d {100 * s[f'{k}_centroid_m']:.1f}cm" for k in ("median", "worst")]
        cells += [f"{s['mean_rse']:.2%}", f"{r['cpu_s']:.2f}", f"{r['cpu_s_max']:.2f}"]
        lines.append([r["method"], *cells])
    harness.print_table(["method", *heads], lines)
    print(
        "posed: of the pairs that overlap by 25 % or more; fine, coarse: of those, by place, within 1 deg and 5 cm, "
        "within 5 deg and 30 cm; wrong: poses of any pair of one place beyond coarse; apart: wrong poses among pairs "
        "that share nothing; told: right poses that the method itself scores above all of those; median, worst, scale "
        "(mean): errors of the posed"
    )
    for r in rows:
        kinds = sorted({h["dof"] for h in r["honesty"].values()})
        for dof in kinds:
            for place, h in [(p, h) for p, h in r["honesty"].items() if h["dof"] == dof]:
                print(f"{r['method']}, {place}: " + _honesty(h))
            together = [h for h in r["honesty"].values() if h["dof"] == dof]
            if len(together) > 1:
                both = {k: [x for h in together for x in h[k]] for k in ("nees", "cycles")}
                print(f"{r['method']}, all: " + _honesty({"dof": dof, **both}))


def _honesty(h: dict) -> str:
    dof, parts = h["dof"], []
    of = (("errors", "nees"), ("errors, the truth's own allowed for", "allowed"), ("triangles", "cycles"))
    for name, values in ((name, h.get(key, [])) for name, key in of):
        if values:
            middle, high = np.percentile(values, [50, 95])
            parts.append(f"{len(values)} {name}: median chi2 {middle:.2f}, 95 % {high:.1f}")
    bars = f"honest: {chi2.ppf(0.5, dof):.2f}, {chi2.ppf(0.95, dof):.1f}; gate {chi2.ppf(GATE, dof):.1f}"
    return "; ".join(parts) + f" ({bars})"


def _installed(package: str) -> bool:
    from importlib.util import find_spec

    return find_spec(package) is not None


if __name__ == "__main__":
    main()
