"""Graph-GSReg (2026) stage by stage as published, beside gsmap on the same captures.

    python -m tools.bench.paper house kitchen_splats --cache FOLDER [--models FOLDER] [--merge c0 c1] [--rescale]
    python -m tools.bench.paper --made 3 --captures 3 --cache FOLDER

A folder holds captures (NAME.ply, NAME.cameras.json), truth/NAME.json with T_scene_world and, for merging, frames/ with
pictures named like cameras. Two tables are printed.

**Registration.** As published: renders from sampled cameras, masks, lifting without a depth test, association over
views by tau_asso with running means, 3-hop context histograms, the ratio test of distances, an exact maximum clique,
Umeyama with scale, ICP on the Gaussians' means. Every pair gets the pose of its clique: the paper has no verdict. What
stands for what cannot be had: gsmap's own segmenter and features for SAM and CLIP or, with --models, DeepLab and
MobileNet; thresholds that are not published are gsmap's. ``preset`` is what `gsmap update --preset paper` does: the
same graphs and clique, then gsmap's measured scale and verdict. A match or clique member is right if its ends lie
within 30 cm of each other under the true pose. RRE, RTE (|t/s - t'/s'| / |t/s|) and RSE are GaussReg's and the paper's;
RTE depends on where frames have their origins, so cm at the scene's centre stand beside it.

**Merging.** The paper's test-time optimisation (1 cm voxels of the union, L1 to renders of the captures), GaussReg's
merge (``distance``), PhotoReg's (``union``) and gsmap's, each under the poses of its own row above where that pair is
right, and under the true ones. CPU seconds are of the process and of the models', single-threaded.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.bench.registration_summary import summarise
from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import tempfile
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap.evaluate.images import Lpips
from gsmap.evaluate.registration import PoseError, pose_error, scene_centroid
from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.map.settings import Settings, settings_of
from gsmap.map.stages.describe import graph_keys
from gsmap.merge import merge
from gsmap.register import SceneView, register_pair
from gsmap.register.clique import maximum_clique
from gsmap.register.metric_scene import MetricPair
from gsmap.register.pose import fit_pose
from gsmap.register.proposers import graph
from gsmap.register.refiners import icp
from gsmap.types import PosedScene, Sim3
from gsmap.types.registration import Proposal
from tools.bench import paper_networks
from tools.bench.merge import oracle_row, ply_mb
from tools.bench.register import APART, OVERLAPPING, make_place, rescaled, true_overlap
from tools.bench.registration_methods import Capture

RIGHT_M = 0.3  # within which both ends of a right match lie
NETWORKS = {"describe.object.segmenter": "deeplab", "describe.object.embedder": "clip"}


@dataclass
class Stages:
    """What each stage of one pair came to; poses between the captures' own units."""

    matches: int = 0
    right_matches: int = 0
    clique: int = 0
    right_members: int = 0
    posed: Sim3 | None = None
    refined: Sim3 | None = None
    cpu_s: float = 0.0
    errors: dict[str, PoseError | None] = field(default_factory=dict)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--made", type=int, default=0, metavar="N", help="also N generated places")
    parser.add_argument("--captures", type=int, default=3, metavar="N", help="of each generated place")
    networks = f"{paper_networks.DEEPLAB} and {paper_networks.MOBILENET}"
    parser.add_argument("--models", type=Path, help=f"folder with {networks}")
    parser.add_argument("--rescale", action="store_true", help="each capture in a random unit, 1/5 to 5, not told")
    parser.add_argument("--merge", nargs=2, metavar="NAME", help="two captures of the first folder to merge")
    parser.add_argument("--lpips", type=Path, help="lpips.LPIPS exported to ONNX, for a column of it")
    parser.add_argument("--cache", type=Path, help="keep scene graphs and generated places here")
    parser.add_argument("--json", type=Path, help="write all figures here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        cache = options.cache or Path(temporary)
        cache.mkdir(parents=True, exist_ok=True)
        folders = options.folders + [make_place(cache, seed, options.captures) for seed in range(options.made)]
        rows, found = [], {}
        title()
        for name, settings, models in methods(options, cache):
            captures, describe_s = described(cache, folders, name, settings, models, options.rescale)
            runs = {name: as_published} if name != "gsmap" else {name: as_gsmap}
            if name == "paper":
                runs["paper, preset"] = as_gsmap
            for row_name, run in runs.items():
                row, found[row_name] = measured(row_name, captures, run, settings, describe_s)
                rows.append(row)
                show(row)
        legend()
        if options.merge:
            rows += merging(options, folders[0], found)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1, default=str))


def methods(options: argparse.Namespace, cache: Path) -> list[tuple[str, Settings, dict[str, tuple[Path, str]]]]:
    """Rows: name, settings, and models by kind with their scaling of pixels."""
    out = [("paper", settings_of({}, "paper"), {}), ("gsmap", settings_of({}), {})]
    if options.models:
        paper_networks.install(cache)
        models = {"deeplab": paper_networks.DEEPLAB, "clip": paper_networks.MOBILENET}
        files = {kind: (options.models / file, paper_networks.SCALING) for kind, file in models.items()}
        out.insert(1, ("paper, networks", settings_of(NETWORKS, "paper"), files))
    return out


# --- captures ------------------------------------------------------------------------------------------------------


def described(
    cache: Path, folders: list[Path], name: str, settings: Settings, models: dict, rescale: bool
) -> tuple[list[Capture], list[float]]:
    """Captures with the graphs that a map of these settings makes, and CPU seconds of each graph."""
    kept = cache / f"{name.replace(', ', '-')}{'-rescaled' if rescale else ''}"
    seconds_file = kept.with_suffix(".json")
    seconds = json.loads(seconds_file.read_text()) if seconds_file.exists() else {}
    rng, captures = np.random.default_rng(0), []
    with gsmap.map.open_or_create(kept.with_suffix(".gsmap")) as m:
        for kind, (path, scaling) in models.items():
            if kind not in {row.kind for row in m.model_rows()}:
                m.add_model(kind, path, preset=scaling)
        m.change_settings(
            {k: v for k, v in NETWORKS.items() if models}, preset="default" if name == "gsmap" else "paper"
        )
        for folder in folders:
            for read in read_captures(folder):
                truth = folder / "truth" / f"{read.name}.json"
                if not truth.exists():
                    continue
                S = Sim3.from_matrix(np.array(json.loads(truth.read_text())["T_scene_world"]))
                gaussians, cameras = read.gaussians, read.cameras
                policy = "unknown" if rescale else "auto"
                if rescale:
                    factor = float(np.exp(rng.uniform(-1, 1) * np.log(5)))
                    gaussians, cameras, S = rescaled(gaussians, cameras, S, factor)
                scene, _ = m.store.scenes.add(
                    gaussians, cameras, name=f"{folder.name}-{read.name}", scale_policy=policy
                )
                start = spent_s()
                m.describe(scene.id)
                key = f"{folder.name}-{read.name}"
                seconds.setdefault(key, spent_s() - start)
                layers = m.store.graphs.load(scene.id, graph_keys(m.store, [scene], m.settings)[scene.id])
                gaussians, cameras = m.store.scenes.gaussians(scene.id), m.store.scenes.cameras(scene.id)
                view = SceneView(scene.id, gaussians, cameras, layers, policy)
                captures.append(Capture(read.name, folder.name, view, S))
    seconds_file.write_text(json.dumps(seconds))
    for capture in captures:  # surfaces are shared by all methods, so none pays for them
        capture.surface().cloud  # noqa: B018
    return captures, list(seconds.values())


def spent_s() -> float:
    """CPU seconds of this process and of the models it runs."""
    total = time.process_time()
    for task in Path("/proc/self/task").glob("*/children"):
        for pid in task.read_text().split():
            stat = Path(f"/proc/{pid}/stat")
            if stat.exists():
                fields = stat.read_text().rsplit(")", 1)[1].split()
                total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


# --- registration --------------------------------------------------------------------------------------------------


def as_published(target: Capture, source: Capture, settings: Settings) -> Stages:
    """The paper's stages after the graph, each by its published definition; the scale is voted and fitted."""
    out = clique_stages(target, source, settings.register.proposers["graph"], with_scale=True)
    if out.posed is None:
        return out
    proposal = Proposal("graph:objects", out.posed, True, out.clique, out.matches, True, 0.0, "")
    pair = MetricPair.of(target.view, source.view, proposal, settings.register)
    pose = icp.refine(
        pair.target.surface(), pair.source.surface(), pair.to_metres(out.posed), settings.register.refiners["icp"]
    )
    out.refined = pair.to_scene_units(pose)
    return out


def as_gsmap(target: Capture, source: Capture, settings: Settings) -> Stages:
    """gsmap's clique, and the pose that it stands by after refinement and verdict."""
    unknown = "unknown" in (target.view.scale_policy, source.view.scale_policy)
    out = clique_stages(target, source, settings.register.proposers["graph"], with_scale=unknown)
    answer, out.cpu_s = timed(register_pair, target.view, source.view, settings.register)
    out.refined = answer.S_target_source if answer.status == "accepted" else None
    return out


def clique_stages(target: Capture, source: Capture, params: graph.Params, *, with_scale: bool) -> Stages:
    """Correspondences and the clique of the kind of node, and at the scale, that agree most."""
    best = Stages()
    truth = target.S_scene_world @ source.S_scene_world.inverse()
    for kind in params.kinds:
        for a, b in graph.comparable_layers(target.graph, source.graph, kind, with_scale=with_scale):
            matcher = graph.LayerMatcher(a, b, target.graph, source.graph, kind, params, with_scale)
            m, units = matcher.matches, matcher.units_m
            if len(m) < 3:
                continue
            metre = 1.0 / target.S_scene_world.scale  # of the target's unit, by the truth
            off = metre * np.linalg.norm(truth.apply(m.source / units[1]) - m.target / units[0], axis=1)
            right = off < RIGHT_M
            for scale, _ in (matcher.vote() if with_scale else []) or [(1.0, 1.0)]:
                clique = maximum_clique(matcher.compatibility_graph(m, scale), params.step_limit)
                if len(clique) < 3 or len(clique) <= best.clique:
                    continue
                fit = fit_pose(m.target[clique.members], m.source[clique.members], with_scale=with_scale)
                S = fit.S_target_source
                own = S.scale * units[1] / units[0] if with_scale else 1.0
                pose = Sim3(S.rotation, S.translation / units[0], own)
                members = int(right[clique.members].sum())
                best = Stages(len(m), int(right.sum()), len(clique), members, pose)
    return best


def measured(name: str, captures: list[Capture], run, settings: Settings, describe_s: list[float]) -> tuple[dict, dict]:
    """One row of the table, and every pair's stages by the names of its captures."""
    found, wanted, apart = {}, [], []
    for i, a in enumerate(captures):
        for b in captures[i + 1 :]:
            overlap = true_overlap(a, b)
            out, took = timed(run, a, b, settings)
            out.cpu_s = out.cpu_s or took
            if a.place == b.place:
                truth, centre = a.S_scene_world @ b.S_scene_world.inverse(), scene_centroid(b.view.gaussians)
                for stage in ("posed", "refined"):
                    pose = getattr(out, stage)
                    error = pose and pose_error(pose, truth, centre)
                    out.errors[stage] = error and replace(error, centroid_m=error.centroid_m / a.S_scene_world.scale)
            found[a.place, a.name, b.name] = out
            if overlap >= OVERLAPPING:
                wanted.append(out)
            elif overlap < APART:
                apart.append(out)
    count = {place: sum(len(layer(c, settings)) for c in captures if c.place == place) for place in places(captures)}
    each = {place: sum(c.place == place for c in captures) for place in count}
    return {
        "name": name,
        "nodes": {place: count[place] / each[place] for place in count},
        "right_matches": sum(s.right_matches for s in wanted),
        "matches": sum(s.matches for s in wanted),
        "clique": float(np.median([s.clique for s in wanted])),
        "right_members": sum(s.right_members for s in wanted) / max(1, sum(s.clique for s in wanted)),
        "posed": asdict(summarise([s.errors["posed"] for s in wanted])),
        "refined": asdict(summarise([s.errors["refined"] for s in wanted])),
        "apart": len(apart),
        "apart_posed": sum(s.refined is not None for s in apart),
        "describe_cpu_s": float(np.median(describe_s)),
        "pair_cpu_s": float(np.median([s.cpu_s for s in found.values()])),
        "pair_cpu_s_max": max(s.cpu_s for s in found.values()),
        "each": {" ".join(key): asdict(s) for key, s in found.items()},
    }, found


def places(captures: list[Capture]) -> list[str]:
    return list(dict.fromkeys(c.place for c in captures))


def layer(capture: Capture, settings: Settings) -> list:
    """The nodes that propose, of all kinds; of layers at several units the first."""
    kinds = settings.register.proposers["graph"].kinds
    layers = capture.graph.layers
    named = [next((n for n in layers if n == k or n.startswith(f"{k}:")), None) for k in kinds]
    return [row for n in named if n is not None for row in layers[n].positions]


def title() -> None:
    print(
        f"{'':16} {'nodes':>11} {'right matches':>14} {'clique':>6} {'right':>5} | {'clique: 5deg 30cm':>17} "
        f"{'1deg 5cm':>8} | {'refined: 5deg 30cm':>18} {'1deg 5cm':>8} {'RRE<5':>5} {'RTE<.1':>6} {'RSE<.1':>6} "
        f"{'RRE mean/median':>15} {'RTE':>5} {'RSE':>6} {'cm':>6} | {'apart':>8} | {'CPU s graph':>11} {'pair':>5} "
        f"{'most':>5}"
    )


def show(r: dict) -> None:
    before, after = r["posed"], r["refined"]

    def of(s: dict, bar: str) -> str:
        return f"{round(s['recall'][bar] * s['num_pairs'])} of {s['num_pairs']}"

    nodes = "+".join(f"{n:.0f}" for n in r["nodes"].values())
    print(
        f"{r['name']:16} {nodes:>11} {r['right_matches']:5d} of {r['matches']:5d} {r['clique']:6.0f} "
        f"{r['right_members']:5.0%} | {of(before, 'coarse'):>17} {of(before, 'fine'):>8} "
        f"| {of(after, 'coarse'):>18} {of(after, 'fine'):>8} {of(after, 'rre_5_deg').split()[0]:>5} "
        f"{of(after, 'rte_0.1').split()[0]:>6} {of(after, 'rse_0.1').split()[0]:>6} "
        f"{after['mean_rre_deg']:7.2f} /{after['median_rre_deg']:6.2f} {after['mean_rte']:5.3f} "
        f"{after['mean_rse']:6.2%} {100 * after['median_centroid_m']:6.1f} | {r['apart_posed']:2d} of {r['apart']:2d} "
        f"| {r['describe_cpu_s']:11.1f} {r['pair_cpu_s']:5.2f} {r['pair_cpu_s_max']:5.2f}",
        flush=True,
    )


def legend() -> None:
    print(
        "of the pairs that overlap by 25 % or more: nodes a capture, by place; right candidate matches; median clique "
        "and the share of its members that is right; poses of the clique, and after refinement (and gsmap's verdict, "
        "where it is gsmap's), within the bars; means and medians over the pairs that got a pose; cm: median at the "
        "scene's centre. apart: pairs that share nothing and get a pose"
    )


# --- merging -------------------------------------------------------------------------------------------------------


def merging(options: argparse.Namespace, folder: Path, found: dict[str, dict]) -> list[dict]:
    """The table of merged maps."""
    captures = read_captures([folder / f"{name}.ply" for name in options.merge])
    images = folder / "frames"
    lpips = Lpips(options.lpips) if options.lpips else None
    truth = {
        c.name: Sim3.from_matrix(np.array(json.loads((folder / f"truth/{c.name}.json").read_text())["T_scene_world"]))
        for c in captures
    }
    first, second = captures
    poses = {"true poses": truth[first.name] @ truth[second.name].inverse()}
    for row in ("paper", "gsmap"):
        stages = found[row].get((folder.name, first.name, second.name))
        if stages is not None and stages.refined is not None and not options.rescale:
            poses[f"{row}'s pose"] = stages.refined
    paper, own = settings_of({}, "paper").merge.mergers, settings_of({}).merge.mergers
    runs = [(name, "union", own["union"], "PhotoReg, union") for name in poses if name != "gsmap's pose"]
    runs += [(name, "distance", own["distance"], "GaussReg, distance") for name in poses if name != "gsmap's pose"]
    runs += [(name, "tto", paper["tto"], "paper's TTO") for name in poses if name != "gsmap's pose"]
    runs += [(name, "tto", own["tto"], "gsmap's tto") for name in poses if name != "paper's pose"]
    oracle = oracle_row(captures, images)
    perceptual = "LPIPS" if lpips else ""
    print(f"\n{'':36} {'PSNR':>6} {'SSIM':>6} {perceptual:>6} {'Gaussians':>9} {'kept':>6} {'MB':>6} {'CPU s':>6}")
    rows = [{**oracle, "name": "each alone, at its own views"}]
    print_merge(rows[0])
    for pose_name, method, params, name in runs:
        S = {first.name: Sim3.identity(), second.name: poses[pose_name]}
        scenes = []
        for c in captures:
            placed = transform_gaussians(c.gaussians, S[c.name]), transform_cameras(c.cameras, S[c.name])
            scenes.append(PosedScene(*placed, c.name, c.captured_at))
        result, seconds = timed(merge, scenes, method, params)
        parts = [
            compare_renders(result.gaussians, scene.cameras, find_images(c.cameras, images), lpips=lpips)
            for scene, c in zip(scenes, captures, strict=True)
        ]
        rows.append(
            {
                "name": f"{name} ({pose_name})",
                "psnr_db": float(np.concatenate([p.psnr_db for p in parts]).mean()),
                "ssim": float(np.concatenate([p.ssim for p in parts]).mean()),
                "lpips": float(np.concatenate([p.lpips for p in parts]).mean()) if lpips else None,
                "num_gaussians": len(result.gaussians),
                "share": len(result.gaussians) / sum(len(c.gaussians) for c in captures),
                "mb": ply_mb(result.gaussians),
                "cpu_s": seconds,
                "steps": result.steps,
            }
        )
        print_merge(rows[-1])
    return rows


def print_merge(r: dict) -> None:
    lpips = "" if r.get("lpips") is None else f"{r['lpips']:.3f}"
    print(
        f"{r['name']:36} {r['psnr_db']:6.2f} {r['ssim']:6.4f} {lpips:>6} {r['num_gaussians']:9d} {r['share']:6.1%} "
        f"{r['mb']:6.1f} {r.get('cpu_s', 0):6.1f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
