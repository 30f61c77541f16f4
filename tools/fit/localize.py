"""Fits what localisation knows before it sees a map: the words of its index, and what its evidence is worth.

    python -m tools.make.localize_places PLACES --set fit && python -m tools.make.localize_places PLACES --set test
    python -m tools.fit.localize PLACES words --cache FOLDER     # writes gsmap/localize/vocabulary.npz
    python -m tools.fit.localize PLACES cells --cache FOLDER     # writes gsmap/localize/mismatch.npz
    python -m tools.fit.localize PLACES verdict --cache FOLDER   # writes gsmap/localize/probability.json
    python -m tools.fit.localize PLACES sigma --cache FOLDER     # prints the best constants of `covariance`
    python -m tools.fit.localize PLACES displaced --cache FOLDER # prints the best `displacement.FRACTION`
    python -m tools.fit.localize PLACES agreement --cache FOLDER # prints the cost of `refinement.MIN_AGREEMENT`
    python -m tools.fit.localize PLACES turned --cache FOLDER    # how alike turned matches lead to rough poses
    python -m tools.fit.localize PLACES placed --cache FOLDER    # says what photos of these are placed, and their cost
    python -m tools.fit.localize PLACES test --cache FOLDER      # says how both do on places that they have not seen

Everything comes from made places (`gsmap_synthetic`).
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import hashlib
import json
import pickle
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.optimize import minimize

from gsmap.compare.odds import Curve, Odds
from gsmap.geometry.filters import box_means
from gsmap.geometry.similarities import rotation_vectors
from gsmap.ingest import read_captures
from gsmap.localize import (
    candidates,
    covariance,
    direct_alignment,
    displacement,
    feature_frames,
    features,
    localization,
    matching,
    mismatch,
    probability,
    refinement,
    resection,
    retrieval,
    tracking,
    vocabulary,
)
from gsmap.localize.candidate_renders import GREY, downsample, render_scenes
from gsmap.localize.candidates import PoseCandidate, match_views, propose_poses
from gsmap.localize.features import INDEXED_FEATURES
from gsmap.localize.map_scene import MapScene
from gsmap.localize.params import Params
from gsmap.localize.resection import retract_pose
from gsmap.localize.retrieval import ViewIndex, new_segment, retrieve_views, view_index
from gsmap.methods import family
from gsmap.types import Sim3
from gsmap.types.localization import Photo, SceneFeatures
from gsmap.types.plain import canonical, plain
from tools.make.localize_places import occluded

ROOT = Path(__file__).resolve().parents[2] / "gsmap" / "localize"


@dataclass
class Place:
    """A made place: its captures where they truly lie, and its photographs."""

    seed: str
    scenes: list[MapScene]
    photos: list[dict]
    folder: Path

    def photo(self, told: dict) -> Photo:
        rgb = np.asarray(Image.open(self.folder / "photos" / told["file"]).convert("RGB"))
        return Photo(rgb, np.array(told["intrinsics"]), 0.0, f"{self.seed}/{told['file']}")


def places(folder: Path, split: str, cache: Path, params: Params) -> list[Place]:
    """The places of a set, with the features of their captures, which are kept."""
    return [_place(path, cache, params) for path in sorted((folder / split).iterdir()) if (path / "done").exists()]


def places_and_streets(folder: Path, split: str, cache: Path, params: Params) -> list[Place]:
    """The places of a set and its streets, whose rooms look alike."""
    return places(folder, split, cache, params) + places(folder, f"{split}_streets", cache, params)


def _place(folder: Path, cache: Path, params: Params) -> Place:
    scenes = load_place(folder, cache, params)
    return Place(folder.name, scenes, json.loads((folder / "photos.json").read_text()), folder)


def load_place(folder: Path, cache: Path, params: Params) -> list[MapScene]:
    """The captures in a folder where they truly lie, with their features, which are kept."""
    scenes = []
    for path in sorted(folder.glob("*.ply")):
        truth = np.array(json.loads((folder / "truth" / f"{path.stem}.json").read_text())["T_scene_world"])
        read = partial(_gaussians, path)
        found = partial(_features, path, cache, params)
        scene = f"{folder.name}/{path.stem}"
        scenes.append(MapScene(scene, Sim3.from_matrix(truth).inverse(), 0, None, read, found))
    return scenes


def _gaussians(path: Path):
    return next(iter(read_captures([str(path)]))).gaussians


def _features(path: Path, cache: Path, params: Params) -> SceneFeatures:
    settings = canonical(plain([params.views, params.extractors[params.extractor]]))
    code = hashlib.sha256(settings.encode()).hexdigest()[:8]
    kept = cache / f"{path.parent.name}-{path.stem}-{code}.pickle"
    if kept.exists():
        found: SceneFeatures = pickle.loads(kept.read_bytes())
        return found
    cache.mkdir(parents=True, exist_ok=True)
    capture = next(iter(read_captures([str(path)])))
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    began = time.process_time()
    found = features.scene_features(
        f"{path.parent.name}/{path.stem}", capture.gaussians, capture.cameras, extractor, params.views
    )
    seconds = time.process_time() - began
    print(f"{found.scene}: {found.num_views} views, {found.num_features} features, {seconds:.1f} CPU s")
    kept.write_bytes(pickle.dumps(found))
    return found


# --- words -----------------------------------------------------------------------------------------------------------

NUM_WORDS, NUM_AXES = 2048, 64


def fit_words(found: list[Place], params: Params) -> None:
    """Principal axes of descriptors, their k-means, and how near features of other places come."""
    from scipy.cluster.vq import kmeans2

    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    shown = {scene.scene: _indexed(scene.features) for place in found for scene in place.scenes}
    asking: dict[str, np.ndarray] = {}
    for place in found:
        pictures = [localization.scale_photo(place.photo(told), params.views.image_size_px)[0] for told in place.photos]
        asking[place.seed] = np.concatenate(
            [
                localization.extract_features(picture, extractor, localization.SMOOTH_PX).descriptors
                for picture in pictures
            ]
        )
    everything = np.concatenate([*shown.values(), *asking.values()])
    some = everything[np.random.default_rng(0).permutation(len(everything))[:120_000]].astype(np.float32)
    mean = some.mean(0).astype(np.float16)
    values, axes = np.linalg.eigh(np.cov((some - mean.astype(np.float32)).T))
    axes = axes[:, ::-1][:, :NUM_AXES].astype(np.float16)
    short = (some - mean.astype(np.float32)) @ axes.astype(np.float32)
    centres, _ = kmeans2(short, NUM_WORDS, iter=15, minit="points", rng=np.random.default_rng(1))
    step = np.abs(centres).max() / 127
    kept = {
        "mean": mean,
        "axes": axes,
        "centres": np.round(centres / step).astype(np.int8),
        "step": np.float32(step),
        "turned": vocabulary.random_sign_axes(NUM_AXES).astype(np.float16),
        "chance": np.zeros(vocabulary.NUM_SIGNS + 1, np.float32),
    }
    np.savez_compressed(ROOT / "vocabulary.npz", **kept)
    vocabulary.load_vocabulary.cache_clear()
    kept["chance"] = _chance(vocabulary.load_vocabulary(some.shape[1]), shown, asking).astype(np.float32)
    np.savez_compressed(ROOT / "vocabulary.npz", **kept)
    vocabulary.load_vocabulary.cache_clear()
    size = (ROOT / "vocabulary.npz").stat().st_size >> 10
    share = values[::-1][:NUM_AXES].sum() / values.sum()
    print(f"{len(everything)} features, {share:.1%} of their variance kept: {size} KB")
    told = ", ".join(f"{signs}: {kept['chance'][signs]:.2g}" for signs in range(4, retrieval.MAX_HAMMING + 1, 4))
    print(f"features of a scene that is another place, by signs that differ at most: {told}")


def _indexed(held: SceneFeatures) -> np.ndarray:
    """Descriptors of what an index holds of a scene."""
    views = zip(held.starts[:-1], held.starts[1:], strict=True)
    return np.concatenate([held.descriptors[a : min(b, a + INDEXED_FEATURES)] for a, b in views]) / np.float32(254)


def _chance(held: vocabulary.Vocabulary, shown: dict[str, np.ndarray], asking: dict[str, np.ndarray]) -> np.ndarray:
    """(65,) features of a scene within so many signs of a photo's, where it shows another place."""
    counts, pairs = np.zeros(vocabulary.NUM_SIGNS + 1), 0
    rng = np.random.default_rng(2)
    for seed, descriptors in asking.items():
        short = held.reduce(descriptors[rng.permutation(len(descriptors))[:2000]])
        probed = held.nearest(short, retrieval.NUM_WORDS)
        for scene, theirs in shown.items():
            if scene.startswith(f"{seed}/"):
                continue
            pairs += len(short)
            other = held.reduce(theirs)
            word = held.nearest(other)[:, 0]
            order = np.argsort(word, kind="stable")
            signs, starts = held.signatures(other, word)[order], np.searchsorted(word[order], np.arange(NUM_WORDS + 1))
            for column in probed.T:
                mine = held.signatures(short, column)
                sizes = starts[column + 1] - starts[column]
                within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
                differ = np.bitwise_count(np.repeat(mine, sizes) ^ signs[np.repeat(starts[column], sizes) + within])
                counts += np.bincount(differ, minlength=vocabulary.NUM_SIGNS + 1)
    return np.cumsum(counts) / max(pairs, 1)


# --- cells -----------------------------------------------------------------------------------------------------------

HIDDEN, STEPS, BATCH = 24, 1500, 4096
CELLS = 400  # of a render


def fit_cells(found: list[Place], params: Params) -> None:
    """The network that says which cells of a photo show something else than a render: of photos where they were taken,
    and of rooms that look alike where those of the map are, from near which they are settled."""
    parts = [_cells(place, params) for place in found]
    features, truth = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    fold = np.repeat(np.arange(len(parts)) % 4, [len(part[1]) for part in parts])
    print(f"{len(truth)} cells, {truth.mean():.1%} of them show something else")
    for k in range(4):
        _save_network(features[fold != k], truth[fold != k])
        said = mismatch.classify(features[fold == k][None])[0]
        right = truth[fold == k]
        ranks = np.argsort(np.argsort(said))
        area = (ranks[right].mean() - (right.sum() - 1) / 2) / (~right).sum()
        shares = (f"{(said[right] > b).mean():.1%} (wrongly {(said[~right] > b).mean():.2%})" for b in (0.5, 0.8))
        print(f"  places left out: area under the curve {area:.3f}; said to be others: {', '.join(shares)}")
    _save_network(features, truth)


def _cells(place: Place, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """(N, F) features of cells of a place's photos, and (N,) bool whether they show something else."""
    rng, own = np.random.default_rng([int(place.seed), 6]), {scene.scene: scene for scene in place.scenes}
    features, truth = [], []
    with np.load(place.folder / "differs.npz") as held:
        told = list(zip(held["photo"], held["T_map_camera"], held["apart"], strict=True))
    for number, pose, apart in told:
        picture, _ = localization.scale_photo(place.photo(place.photos[number]), params.views.image_size_px)
        start = retract_pose(pose, rng.normal(size=6) * np.r_[np.full(3, 0.02), np.full(3, 0.05)])
        settled = refinement.refine_pose(picture, start, picture.intrinsics_px, place.scenes)
        off = camera_error(settled.T_metric_camera, pose)
        if np.degrees(np.linalg.norm(off[:3])) > RIGHT_DEG or np.linalg.norm(off[3:]) > RIGHT_M:
            continue
        lit = np.clip(picture.rgb * np.float32(2 ** (rng.uniform(-1, 1) / 2.2)), 0, 1)
        for one in settled.renders:
            here, known = mismatch.cell_features(downsample(lit, 2), one)
            differs = apart[sorted(own).index(one.scene)].astype(np.float32)
            share = box_means(differs, mismatch.SIDE, step=mismatch.STEP)[: known.shape[0], : known.shape[1]]
            rows = np.flatnonzero(known & ((share > 0.5) | (share < 0.05)))  # at edges neither is true
            rows = rng.permutation(rows)[:CELLS]
            features.append(here.reshape(-1, here.shape[2])[rows])
            truth.append(share.ravel()[rows] > 0.5)
    print(f"{place.seed}: {len(features)} renders, {time.process_time():.0f} CPU s", flush=True)
    return np.concatenate(features), np.concatenate(truth)


def _save_network(features: np.ndarray, truth: np.ndarray) -> None:
    """Logistic loss by Adam, and the weights written where gsmap reads them."""
    import torch

    torch.manual_seed(0)
    mean, spread = features.mean(0, dtype=np.float64), features.std(0, dtype=np.float64) + 1e-6
    x = torch.tensor(mismatch.normalize(features, mean, spread), dtype=torch.float32)
    y = torch.tensor(truth, dtype=torch.float32)
    sizes = (x.shape[1], HIDDEN, HIDDEN, 1)
    layers = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    network = torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), layers[2])
    optimiser = torch.optim.AdamW(network.parameters(), 4e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        some = torch.randint(len(x), (BATCH,))
        optimiser.zero_grad()
        torch.nn.functional.binary_cross_entropy_with_logits(network(x[some])[:, 0], y[some]).backward()
        optimiser.step()
        schedule.step()
    kept = {"mean": mean, "spread": spread}
    for k, layer in enumerate(layers):
        kept |= {f"weights{k}": layer.weight.detach().numpy().T, f"offsets{k}": layer.bias.detach().numpy()}
    np.savez(ROOT / "mismatch.npz", **{name: np.asarray(value, np.float32) for name, value in kept.items()})
    mismatch.load_network.cache_clear()


# --- verdict ---------------------------------------------------------------------------------------------------------

RIGHT_DEG, RIGHT_M = 3.0, 0.15
WRONG_DEG, WRONG_M = 5.0, 0.3  # between the two a pose is neither
FEWEST = 6  # inliers of a pose that nobody found, to be worth a judgement
HOPELESS = -2.0  # log-odds under which it does not matter how improbable a pose is
LEAST_TOLD = 0.05  # share of a photo that must differ to tell two rooms apart
RISES = {"matches", "inliers", "found_again", "laid", "spread", "explained", "explained_coarsely", "compared", "colour"}
RISES |= {"seen"}
KNOTS = {
    "matches": tuple(np.log10(np.array([6.0, 8, 11, 15, 21, 41, 81]))),
    "inliers": tuple(np.log10(np.array([1.0, 6, 11, 16, 26, 41, 81, 161]))),
    "found_again": (0.0, 0.03, 0.07, 0.12, 0.2, 0.35),
    "laid": (0.1, 0.2, 0.3, 0.4, 0.55, 0.75),
    "spread": (0.05, 0.15, 0.25, 0.4, 0.6),
    "explained": (0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8),
    "contradicted": (0.05, 0.1, 0.2, 0.3, 0.45, 0.6),
    "explained_coarsely": (0.2, 0.35, 0.5, 0.65, 0.8, 0.9),
    "contradicted_coarsely": (0.03, 0.07, 0.12, 0.2, 0.35, 0.5),
    "unlike_part": (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.45),
    "unlike": (0.0, 0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.25),
    "unlike_likely": (0.0, 0.01, 0.02, 0.04, 0.08, 0.15),
    "unlike_surely": (0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.15),
    "compared": tuple(np.log10(np.array([31.0, 101, 301, 801, 1501]))),
    "colour": (0.0, 0.2, 0.4, 0.6, 0.8, 0.95),
    "seen": (0.1, 0.3, 0.5, 0.8),
    "blocked": (0.0, 0.05, 0.2, 0.5),
    "sigma_m": tuple(np.log10(np.array([0.003, 0.01, 0.03, 0.08, 0.2, 0.6]))),
}


@dataclass
class Row:
    """One pose that was looked into, and what is known of it."""

    photo: str
    kind: str  # found, elsewhere, moved, hidden, lit, alike
    evidence: dict[str, float]
    error: tuple[float, float]  # deg, m; inf in another place
    nees: float
    changed: bool
    differs: float = 1.0  # share of a photo that tells its room from the one of the map that looks like it

    @property
    def right(self) -> bool:
        return self.error[0] < RIGHT_DEG and self.error[1] < RIGHT_M

    @property
    def tells(self) -> bool:
        """Whether it teaches anything: not a pose that is neither right nor wrong, nor one on the exact twin of its
        wing or in a room that looks alike, where nothing in the picture tells them apart."""
        twin = self.kind != "elsewhere" and self.error[0] < RIGHT_DEG and self.error[1] > 4.0
        twin |= self.differs < LEAST_TOLD
        between = not self.right and self.error[0] < WRONG_DEG and self.error[1] < WRONG_M
        idle = self.kind in ("moved", "hidden", "lit") and self.evidence["inliers"] < np.log10(FEWEST + 1)
        return not (twin or between or idle)


def judge_all(found: list[Place], params: Params) -> list[Row]:
    """Poses of every photo in its own place, and of every other one in another place, as they are looked into (more of
    them than where photos are placed), and poses that settle from near the truth and from far of it; of photos of rooms
    that look like those of the map, the poses that are found there."""
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    params = replace(params, max_candidates=4)
    localization.HIGH_PROBABILITY, localization.MIN_COMPARED_PROBABILITY = 2.0, 0.0
    fewer, out = replace(params, max_candidates=2), []
    indexes = {place.seed: index_of(place.scenes, params) for place in found}
    for number, place in enumerate(found):
        stranger = found[(number + 1) % len(found)]
        own, other = ({scene.scene: scene for scene in one.scenes} for one in (place, stranger))
        rng = np.random.default_rng([int(place.seed), 5])
        for count, told in enumerate(place.photos):
            photo, truth = place.photo(told), np.array(told["T_world_camera"])
            picture, _ = localization.scale_photo(photo, params.views.image_size_px)

            def row(judged, kind, truth=truth, told=told, name=photo.name):
                error, nees = errors(judged, truth, kind)
                return Row(name, kind, dict(judged.evidence), error, nees, told["changed"], told.get("differs", 1.0))

            judged, _ = localization.evaluate_candidates(picture, indexes[place.seed], own, extractor, params)
            if "differs" in told:
                out += [row(one, "alike") for one in judged]
                continue
            out += [row(one, "found") for one in judged]
            if count % 2 == 0:
                judged, _ = localization.evaluate_candidates(picture, indexes[stranger.seed], other, extractor, fewer)
                out += [row(one, "elsewhere") for one in judged]
            hidden, lit = hidden_and_lit(picture, rng)
            near = (("hidden", hidden, 0.05), ("lit", lit, 0.05))
            sizes = (0.05, rng.uniform(0.1, 0.4), rng.uniform(0.2, 1.2))
            for kind, shown, size in (*(("moved", picture, size) for size in sizes), *near):
                xi = np.r_[rng.normal(size=3) * size * 0.4, rng.normal(size=3) * size]
                start = PoseCandidate(0, retract_pose(truth, xi), picture.intrinsics_px, 0, tuple(own))
                one = localization.evaluate_pose(shown, start, own, params.verdict.aliased_prior)
                one.evidence["matches"] = float("nan")
                out.append(row(one, kind))
        print(f"{place.seed}: {len(out)} poses, {time.process_time():.0f} CPU s", flush=True)
    return out


def hidden_and_lit(
    picture: refinement.ScaledPhoto, rng: np.random.Generator
) -> tuple[refinement.ScaledPhoto, refinement.ScaledPhoto]:
    """The same with somebody in about a tenth of it, and a stop brighter or darker."""
    hidden = occluded((picture.rgb * 255).astype(np.uint8), rng, (0.05, 0.13))[0].astype(np.float32) / 255
    lit = np.clip(picture.rgb * np.float32(2 ** (rng.choice([-1, 1]) * rng.uniform(0.5, 1) / 2.2)), 0, 1)
    return tuple(replace(picture, rgb=rgb, grey=rgb @ GREY) for rgb in (hidden, lit))


def errors(judged, truth: np.ndarray, kind: str) -> tuple[tuple[float, float], float]:
    """Error in degrees and metres, and the normalised squared error by the covariance."""
    if kind in ("elsewhere", "alike"):
        return (180.0, np.inf), np.nan
    xi = camera_error(judged.refined.T_metric_camera, truth)
    error = float(np.degrees(np.linalg.norm(xi[:3]))), float(np.linalg.norm(xi[3:]))
    if judged.covariance is None:
        return error, np.nan
    return error, float(xi @ np.linalg.solve(judged.covariance, xi))


def camera_error(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(6,) [rot_rad, trans] by which a pose is off, on the camera's side."""
    turn, shift = rotation_vectors(T[:3, :3].T @ truth[:3, :3])[0], T[:3, :3].T @ (truth[:3, 3] - T[:3, 3])
    return np.r_[turn, shift]


def index_of(scenes: list[MapScene], params: Params) -> ViewIndex:
    """All views of some scenes."""
    return view_index([new_segment([(scene.features, scene.scene) for scene in scenes])])


def completed(rows: list[Row]) -> list[Row]:
    """Poses that nobody found have no matches: they get those of the found pose that is right or wrong like them and
    is most like them else (a hot deck). Left out, their absence would tell which is right."""
    asked = ("inliers", "laid", "spread", "explained")
    lacking = np.array([np.isnan(row.evidence["matches"]) for row in rows])
    right = np.array([row.right for row in rows])
    told = np.array([[row.evidence[name] for name in asked] for row in rows])
    told = (told - told.mean(0)) / told.std(0)
    out = list(rows)
    for k in np.flatnonzero(lacking):
        known = np.flatnonzero(~lacking & (right == right[k]))
        one = known[np.argmin(((told[known] - told[k]) ** 2).sum(1))]
        out[k] = replace(rows[k], evidence={**rows[k].evidence, "matches": rows[one].evidence["matches"]})
    return out


def design(rows: list[dict[str, float]]) -> np.ndarray:
    """(N, columns) how far each piece has gone through each step between its knots, and whether it is missing."""
    columns = []
    for name, knots in KNOTS.items():
        value = np.array([row[name] for row in rows])
        known = np.isfinite(value)
        for low, high in pairwise(knots):
            step = np.clip((np.where(known, value, low) - low) / (high - low), 0, 1)
            columns.append(np.where(known, step if name in RISES else 1 - step, 0.0))
        columns.append(np.where(known, 0.0, 1.0))
    return np.stack(columns, axis=1)


def fit(rows: list[Row], penalty: float = 0.0002) -> Odds:
    """Monotone curves of largest likelihood with a penalty on steep ones; right and wrong poses weigh the same."""
    x = design([row.evidence for row in rows])
    y = np.array([row.right for row in rows], float)
    weight = np.where(y > 0, 0.5 / y.sum(), 0.5 / (1 - y).sum())
    bounds, free = [], []
    for name, knots in KNOTS.items():
        bounds += [(0, None)] * (len(knots) - 1) + [(None, None)]
        free.append(name)
    bounds.append((None, None))

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        z = x @ w[:-1] + w[-1]
        p = 1 / (1 + np.exp(-np.clip(z, -40, 40)))
        g = weight * (p - y)
        value = (weight * (np.logaddexp(0, z) - y * z)).sum() + penalty * (w[:-1] ** 2).sum()
        return float(value), np.r_[x.T @ g + 2 * penalty * w[:-1], g.sum()]

    w = minimize(
        loss, np.zeros(x.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 3000}
    ).x
    curves, at = {}, 0
    for name, knots in KNOTS.items():
        rises = w[at : at + len(knots) - 1]
        worth = np.r_[0, np.cumsum(rises)] if name in RISES else np.r_[np.cumsum(rises[::-1])[::-1], 0]
        curves[name] = Curve(tuple(map(float, knots)), tuple(map(float, worth)), float(w[at + len(knots) - 1]))
        at += len(knots)
    return Odds(curves, float(w[-1]), 1e-4)


def log_odds(model: Odds, rows: list[Row]) -> np.ndarray:
    return np.array([model.log_odds(row.evidence) for row in rows])


def fit_verdict(rows: list[Row]) -> None:
    """Curves of right poses against wrong ones of other places, and of right poses against those of rooms that look
    alike; and what comes of `localize.verdict.aliased_prior`, of places that were left out."""
    alike = np.array([row.kind == "alike" for row in rows])
    right = np.array([row.right for row in rows])
    other, odds_other = calibrated(rows, ~alike)
    rooms, odds_rooms = calibrated(rows, right | alike)
    save(other=other, alike=rooms)
    bars = Params().verdict
    prior, bar = probability.PRIOR, bars.min_probability
    for share in (0.35, 0.2, 0.1, 0.05, 0.02, 0.005):
        against = np.exp(-odds_other) * (1 - prior - share) + np.exp(-odds_rooms) * share
        p = prior / (prior + against)
        if share == bars.aliased_prior:
            report("places left out", rows, p)
        differs = np.array([row.differs for row in rows])
        bands = ((LEAST_TOLD, 0.15), (0.15, 0.3), (0.3, 1.01))
        wrong = (f"{(alike & (differs >= a) & (differs < b) & (p >= bar)).sum()}" for a, b in bands)
        kinds = [np.array([row.kind == kind for row in rows]) & right for kind in ("found", "hidden", "lit")]
        good = (f"{(kind & (p >= bar)).sum()} of {kind.sum()}" for kind in kinds)
        print(f"alike {share}: found, with somebody before them, in other light {', '.join(good)}; ", end="")
        print(f"wrong of rooms that look alike, from 5, 15 and 30 % that differ {', '.join(wrong)}; ", end="")
        print(f"of other places {(~alike & ~right & (p >= bar)).sum()}")


def calibrated(rows: list[Row], asked: np.ndarray, folds: int = 6) -> tuple[Odds, np.ndarray]:
    """The curves of the rows that are asked, stretched until places that were left out bear out what they say (Platt
    1999), and what they say of every row where its place was left out."""
    some = [row for row, one in zip(rows, asked, strict=True) if one]
    model = fit(some)
    seeds = sorted({row.photo.split("/")[0] for row in rows})
    fold = np.array([seeds.index(row.photo.split("/")[0]) % folds for row in rows])
    odds, y = np.zeros(len(rows)), np.array([row.right for row in rows], float)
    for k in range(folds):
        held = np.flatnonzero(fold == k)
        rest = [row for row, f, one in zip(rows, fold, asked, strict=True) if f != k and one]
        odds[held] = log_odds(fit(rest), [rows[i] for i in held])
    weight = asked * np.where(y > 0, 0.5 / y[asked].sum(), 0.5 / (1 - y)[asked].sum())
    weight[odds < HOPELESS] = 0  # of these nothing is asked

    def loss(ab: np.ndarray) -> float:
        z = ab[0] * odds + ab[1]
        return float((weight * (np.logaddexp(0, z) - y * z)).sum())

    a, b = minimize(loss, [1.0, 0.0], method="Nelder-Mead").x
    curves = {n: Curve(c.knots, tuple(a * v for v in c.worth), a * c.missing) for n, c in model.curves.items()}
    print(f"{len(some)} poses; left out: stretched by {a:.2f}, moved by {b:.2f}")
    return Odds(curves, a * model.base + b, 1.0 / max((y[asked] == 0).sum(), 1)), a * odds + b


def report(name: str, rows: list[Row], p: np.ndarray) -> None:
    """How often poses that are so probable are right."""
    right = np.array([row.right for row in rows])
    print(f"{name}: {right.sum()} right poses, {(~right).sum()} wrong ones")
    for bar in (0.5, 0.8, 0.9, 0.95, 0.99):
        print(f"  p >= {bar}: {((p >= bar) & right).sum()} right, {((p >= bar) & ~right).sum()} wrong")
    for low, high in ((0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01)):
        those = (p >= low) & (p < high)
        if those.any():
            print(f"  said {low:.2f} to {min(high, 1):.2f}: {those.sum():5d} poses, {right[those].mean():.3f} right")
    found_again = np.array([10 ** row.evidence["inliers"] - 1 for row in rows])
    for low, high in ((0, 5.5), (5.5, 11.5), (11.5, np.inf)):
        sure = (found_again > low) & (found_again < high) & (p >= 0.95)
        print(f"  {low:.0f} to {high:.0f} patches: {(sure & right).sum()} right, {(sure & ~right).sum()} wrong at .95")
    good = [row for row, q in zip(rows, p, strict=True) if row.right and q > 0.9 and np.isfinite(row.nees)]
    if good:
        nees = np.array([row.nees for row in good])
        told = f"median {np.median(nees):.1f} (expected 5.3), 90th {np.quantile(nees, 0.9):.1f} (expected 10.6)"
        print(f"  NEES of {len(nees)}: {told}; error {np.median([row.error for row in good], axis=0)}")


# --- sigma -----------------------------------------------------------------------------------------------------------


def fit_sigma(found: list[Place], params: Params) -> None:
    """By how much residuals are too sure, and the more so the less the render agrees, and what leaves none: the
    likeliest of a grid.

    Started near the truth; poses that settle right and are more probable than not. Likelihoods are of Student's t of 8
    degrees of freedom, since a few photos are placed on a part of a map that is bent.
    """
    covariance.PATCH_SCALE = covariance.ALIGNMENT_SCALE = 1.0
    covariance.AGREEMENT_SLOPE = covariance.MODEL_SIGMA_M = covariance.MODEL_SIGMA_RAD = 0.0
    covariance.DIFFERENCE_WEIGHT = 0.0
    # Errors, what patches and what colours tell, by what the two differ, and how well the render agreed.
    told: list[tuple[np.ndarray, ...]] = []
    rng, between = np.random.default_rng(7), refinement._fuse

    for place in found:
        own = {scene.scene: scene for scene in place.scenes}
        for photo_told in place.photos:
            photo, truth = place.photo(photo_told), np.array(photo_told["T_world_camera"])
            picture, _ = localization.scale_photo(photo, params.views.image_size_px)
            both: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

            def noted(pose, lens, by_colours, fit, by_patches, both=both):
                both.append((by_patches, by_colours, camera_error(pose, fit.T_map_camera)))
                return between(pose, lens, by_colours, fit, by_patches)

            refinement._fuse = noted
            xi = np.r_[rng.normal(size=3) * 0.02, rng.normal(size=3) * 0.05]
            start = PoseCandidate(0, retract_pose(truth, xi), picture.intrinsics_px, 0, tuple(own))
            judged = localization.evaluate_pose(picture, start, own, params.verdict.aliased_prior)
            off = camera_error(judged.refined.T_metric_camera, truth)
            right = np.linalg.norm(off[:3]) < np.radians(WRONG_DEG) and np.linalg.norm(off[3:]) < WRONG_M
            if both and right and judged.probability > 0.5:
                told.append((off, *both[-1], np.array(judged.refined.agreement)))
    refinement._fuse = between
    error, by_patches, by_colours, apart, agreement = (np.stack(column) for column in zip(*told, strict=True))
    tried = []
    for patches, aligned, disagreeing in product((1.5, 2.1, 2.6), (2.6, 3.7, 4.7, 5.9), (0.0, 1.0, 1.5, 2.0, 2.5, 3.0)):
        parts = by_patches * patches**2, by_colours * aligned**2
        residual = 2 * np.linalg.inv(np.linalg.inv(parts[0]) + np.linalg.inv(parts[1]))
        doubt = covariance.agreement_scale(agreement, disagreeing)[:, None, None] ** 2
        for hidden_m, hidden_rad, differing in product(
            (0.002, 0.003, 0.005, 0.007), (0.0003, 0.0005, 0.001), (0.1, 0.25, 0.5, 1.0)
        ):
            known = doubt * (residual + differing * apart[:, :, None] * apart[:, None, :])
            known += np.diag(np.r_[np.full(3, hidden_rad), np.full(3, hidden_m)] ** 2)
            nees = np.einsum("ni,ni->n", error, np.linalg.solve(known, error[..., None])[..., 0])
            likely = (-0.5 * np.linalg.slogdet(known)[1] - 7 * np.log1p(nees / 8)).mean()
            settings = f"PATCH_SCALE {patches}, ALIGNMENT_SCALE {aligned}, AGREEMENT_SLOPE {disagreeing}, "
            settings += f"MODEL_SIGMA_M {hidden_m}, MODEL_SIGMA_RAD {hidden_rad}, DIFFERENCE_WEIGHT {differing}"
            low = np.median(nees[agreement < 0.45])
            tried.append((likely, settings, *np.quantile(nees, (0.5, 0.9)), low, np.median(nees[agreement > 0.6])))
    print(f"{len(error)} poses")
    for likely_, settings, middle, most, low, high in sorted(tried, reverse=True)[:12]:
        by = f"median {low:.1f} where renders agree by less than .45, {high:.1f} by more than .6"
        print(f"likelihood {likely_:.3f}: {settings}; NEES {middle:.1f}, 90th {most:.1f}; {by}")


# --- displaced -------------------------------------------------------------------------------------------------------


def fit_displaced(found: list[Place], params: Params) -> None:
    """By how much what renders show lies elsewhere than where it is seen from the true pose, as a share of how far off
    the middles of Gaussians are that they show; and how much further out it lies before and after."""
    displacement.FRACTION = 1.0
    away, seen, radius = [], [], []
    for place in found:
        for told in place.photos:
            if told["changed"] or told["occluded"]:
                continue
            picture, _ = localization.scale_photo(place.photo(told), params.views.image_size_px)
            view = np.array(told["T_world_camera"]), picture.intrinsics_px, picture.size_px
            for one in render_scenes(place.scenes, *view, with_displacement=True):
                hits = tracking.track(one.grey, one.smooth, picture.grey, refinement.NEAR_PX)
                if hits.found.sum() < FEWEST:
                    continue
                pixels = hits.render_px[hits.found]
                middle = np.array(picture.size_px) / 2
                radius.append(pixels - middle)
                seen.append(hits.photo_px[hits.found] - pixels)
                away.append(one.displaced_px(pixels))
    seen, away, radius = (np.concatenate(part).astype(np.float64) for part in (seen, away, radius))
    weights, share = np.ones(seen.shape), 0.0
    for _ in range(30):  # Cauchy's loss
        share = float((weights * seen * away).sum() / (weights * away**2).sum())
        left = seen - share * away
        weights = 1 / (1 + (left / (1.4826 * np.median(np.abs(left)))) ** 2)
    print(f"{len(seen)} patches: share {share:.3f}; half of them are off by {np.median(np.abs(seen)):.3f} px in either")
    print(f"direction, and by {np.median(np.abs(left)):.3f} px after")
    far = np.linalg.norm(radius, axis=1)
    for low in range(0, 300, 50):
        rows = (far >= low) & (far < low + 50)
        before, after = (np.median((part * radius).sum(1)[rows] / far[rows]) for part in (seen, left))
        print(f"  {low} to {low + 50} px from the middle: {before:+.3f} px outwards, {after:+.3f} after")


# --- placed ----------------------------------------------------------------------------------------------------------


def place_all(found: list[Place], params: Params) -> None:
    """Every photo in its own place, and every fourth in another one."""
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    indexes = {place.seed: index_of(place.scenes, params) for place in found}
    for elsewhere in (False, True):
        answers, seconds = [], []
        for number, place in enumerate(found):
            other = found[(number + elsewhere) % len(found)]
            scenes = {scene.scene: scene for scene in other.scenes}
            for told in place.photos[:: 4 if elsewhere else 1]:
                said, took = timed(
                    localization.localize_photo, place.photo(told), indexes[other.seed], scenes, extractor, params
                )
                seconds.append(took)
                wrong = False
                if said.T_map_camera is not None:
                    apart = np.linalg.inv(np.array(told["T_world_camera"])) @ said.T_map_camera
                    turn = np.degrees(np.linalg.norm(rotation_vectors(apart[:3, :3])[0]))
                    wrong = elsewhere or turn > WRONG_DEG or np.linalg.norm(apart[:3, 3]) > WRONG_M
                answers.append((said.is_placed, wrong))
        placed, wrong = np.sum(answers, axis=0)
        where = "in another place" if elsewhere else "in their own places"
        cost = f"{np.mean(seconds):.2f} CPU s on average, {np.median(seconds):.2f} in the median"
        print(f"{len(answers)} photographs {where}: {placed} placed, {wrong} wrong; {cost}", flush=True)


# --- agreement -------------------------------------------------------------------------------------------------------


def fit_agreement(found: list[Place], params: Params) -> None:
    """How well renders agree with a photo that they were laid over, from right poses and from wrong ones.

    Of every other photo in its own place and in another one; a pose's agreement is the least of those that are asked.
    """
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    params = replace(params, max_candidates=4)
    localization.HIGH_PROBABILITY, refinement.MIN_AGREEMENT = 2.0, -1.0
    align, judge, asked = direct_alignment.align, localization.evaluate_pose, []

    def noted(*args, **kwargs):
        laid = align(*args, **kwargs)
        asked.append(laid.agreement)
        return laid

    direct_alignment.align = noted
    rows: list[tuple[float, bool, bool]] = []  # agreement, right, and placed
    for number, place in enumerate(found):
        for told, other in ((t, o) for t in place.photos[::2] for o in (place, found[(number + 1) % len(found)])):
            picture, _ = localization.scale_photo(place.photo(told), params.views.image_size_px)
            scenes = {scene.scene: scene for scene in other.scenes}
            index = index_of(other.scenes, params)

            def judged(*args, told=told, other=other, place=place):
                asked.clear()
                one = judge(*args)
                kind = "found" if other is place else "elsewhere"
                (deg, metres), _ = errors(one, np.array(told["T_world_camera"]), kind)
                right = deg < RIGHT_DEG and metres < RIGHT_M
                least = min(asked[1:], default=np.nan)
                rows.append((least, right, one.probability >= params.verdict.min_probability))
                return one

            localization.evaluate_pose = judged
            localization.evaluate_candidates(picture, index, scenes, extractor, params)
    localization.evaluate_pose, direct_alignment.align = judge, align
    agreement, right, placed = (np.array(column) for column in zip(*rows, strict=True))
    print(f"{right.sum()} right poses, {(right & placed).sum()} of them placed, {(~right).sum()} wrong ones")
    for bar in (0.06, 0.08, 0.1, 0.12, 0.15, 0.2):
        under = agreement < bar
        lost = f"{(under & right).sum()} right poses under it, {(under & right & placed).sum()} of them placed"
        print(f"  min_agreement {bar}: {lost}; {(under & ~right).sum()} wrong ones")


def fit_turned(found: list[Place], params: Params) -> None:
    """Among how many rough poses there is one that is about right, and what looking for them costs, by how alike
    matches must say that the camera was turned and how many of them must agree.

    Of every photo with as many views as are asked first, and then with more; about right is from where poses settle.
    """
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    asked = []
    for place in found:
        own, index = {scene.scene: scene for scene in place.scenes}, index_of(place.scenes, params)
        for told in place.photos:
            picture, _ = localization.scale_photo(place.photo(told), params.views.image_size_px)
            finer = [localization.extract_features(picture, extractor, px) for px in (localization.SMOOTH_PX, 0.0)]
            for shown, views in (
                (finer[0], params.max_views),
                (localization.concatenate_keypoints(finer), localization.MORE_VIEWS * params.max_views),
            ):
                described = matching.FeatureSet(features.quantize(shown.descriptors), features.quantize_angles(shown))
                chosen = retrieve_views(index, shown, picture.intrinsics_px, views)
                frames = feature_frames.camera_frames(shown, picture.intrinsics_px)
                matches = match_views(described, frames, chosen, own)
                asked.append((picture, shown.pixels, matches, np.array(told["T_world_camera"])))
    print(f"{len(asked) // 2} photographs")
    for deg, fewest, turns in (
        *product((15.0, 20.0, 30.0, 40.0, 60.0), (3, 4, 5, 6), (10,)),
        (30.0, 4, 3),
        (30.0, 4, 20),
    ):
        candidates.MAX_TURN_DEG, resection.MIN_INLIERS, candidates.MAX_ORIENTATIONS = deg, fewest, turns
        right, wrong, began = np.zeros(2, int), np.zeros(2, int), time.process_time()
        for number, (picture, pixels, matches, truth) in enumerate(asked):
            rough = propose_poses(pixels, matches, picture.intrinsics_px, picture.size_px, picture.focal_sigma)
            off = [camera_error(one.T_metric_camera, truth) for one in rough[: params.max_candidates]]
            near = [np.degrees(np.linalg.norm(xi[:3])) < 8 and np.linalg.norm(xi[3:]) < 0.3 for xi in off]
            right[number % 2] += any(near)
            wrong[number % 2] += len(near) - sum(near)
        spent = 1000 * (time.process_time() - began) / len(asked)
        print(
            f"max_turn_deg {deg:.0f}, min_agreeing {fewest}, turns {turns}: a pose that is about right for {right[0]} "
            f"and {right[1]} of them, beside {wrong[0]} and {wrong[1]} others; {spent:.0f} CPU ms",
            flush=True,
        )


def save(**models: Odds) -> None:
    told = {}
    for kind, model in models.items():
        curves = {
            name: {
                "knots": [round(v, 5) for v in c.knots],
                "worth": [round(v, 4) for v in c.worth],
                "missing": round(c.missing, 4),
            }
            for name, c in model.curves.items()
        }
        told[kind] = {"base": round(model.base, 4), "least": model.least, "curves": curves}
    (ROOT / "probability.json").write_text(json.dumps(told, indent=1) + "\n")
    probability.load_model.cache_clear()


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument(
        "what", choices=("words", "sigma", "displaced", "agreement", "turned", "placed", "cells", "verdict", "test")
    )
    parser.add_argument("--cache", type=Path, required=True)
    args = parser.parse_args()
    params = Params()
    if args.what == "words":
        fit_words(places(args.places, "fit", args.cache, params), params)
        return 0
    if args.what == "sigma":
        fit_sigma(places(args.places, "fit", args.cache, params), params)
        return 0
    if args.what == "displaced":
        fit_displaced(places(args.places, "fit", args.cache, params), params)
        return 0
    if args.what == "agreement":
        fit_agreement(places(args.places, "fit", args.cache, params), params)
        return 0
    if args.what == "turned":
        fit_turned(places(args.places, "fit", args.cache, params), params)
        return 0
    if args.what == "cells":
        fit_cells(places_and_streets(args.places, "fit", args.cache, params), params)
        return 0
    if args.what == "placed":
        for kind in ("test", "test_courts"):
            print(kind)
            place_all(places(args.places, kind, args.cache, params), params)
        return 0
    split = "fit" if args.what == "verdict" else "test"
    kept = args.cache / f"judged-{split}.pickle"
    if not kept.exists():
        kept.write_bytes(pickle.dumps(judge_all(places_and_streets(args.places, split, args.cache, params), params)))
    rows = completed([row for row in pickle.loads(kept.read_bytes()) if row.tells])
    if args.what == "verdict":
        fit_verdict(rows)
    else:
        bars = params.verdict
        told = [probability.load_model().probability(row.evidence, bars.aliased_prior) for row in rows]
        report("test", rows, np.array(told))
    return 0


if __name__ == "__main__":
    sys.exit(main())
