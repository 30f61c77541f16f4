"""How well photographs are localised: given captures crosswise, photographs of other places, and what they may lack.

    python -m tools.bench.localize DATA WORK                 # the house: every photograph in a map without its capture
    python -m tools.bench.localize DATA WORK --kitchen       # the same of the real kitchen, with its eight RGB-D frames
    python -m tools.bench.localize DATA WORK --only c0 c1    # photographs of these captures alone
    python -m tools.bench.localize DATA WORK --perturb       # exposure, resolution, focal length, people
    python -m tools.bench.localize DATA WORK --elsewhere     # photographs of other places: none may be placed
    python -m tools.bench.localize DATA WORK --beside        # and retrieval alone, and SIFT + PnP on photographs
    python -m tools.bench.localize DATA WORK --sift          # and our features beside COLMAP's
    python -m tools.bench.localize DATA WORK --started       # and what settles of poses 10 cm and 3 degrees off
    python -m tools.bench.localize DATA WORK --small 0.05    # and a small map in so much of the captures' bytes (with
                                                             # --perturb: photographs in other light and lenses by both)
    python -m tools.bench.localize DATA WORK --crowd 1000 --places PLACES    # and in a map of so many scenes

DATA is the folder of the given captures; maps are made in WORK once. The captures' poses in the map are gsmap's own,
and the truth of a photograph is taken to the map through the scene that supports it most; where its covariance is asked
(NEES), which holds what is not known of where scenes lie, through the scene that the map's frame is fixed to. A
photograph's coverage is the share of its pixels whose surface another capture of the map shows where it is (5 cm and
2 % of the depth).

Beside it (of the house): the pose of the most alike view, alone; and what is done without renders of the map: SIFT of
the captures' own photographs, lifted by their splats' depth, matched with the 20 most alike ones by ratio and mutually,
one pose by LO-RANSAC (pycolmap), said where 12 agree. That needs the photographs to be kept with their poses.

A crowd are made captures (`--places`, of `make_localize_places.py`) over and over, elsewhere: each once as it is; the
others have every feature moved a random part of the way to one of the same word, which leaves as many features in every
word as captures have. They are no places: what agrees in one copy by chance is likely to agree in the next.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

import gsmap.map
from gsmap.geometry.rotations import angle_between
from gsmap.geometry.similarities import rotation_vectors
from gsmap.localize import index_recipe, localize_photo, new_segment, view_index
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.candidates import PoseCandidate
from gsmap.localize.extractors import sift
from gsmap.localize.features import lift, quantize
from gsmap.localize.joint_localization import word_histogram
from gsmap.localize.localization import SMOOTH_PX, evaluate_pose, extract_features, scale_photo
from gsmap.localize.map_scene import MapScene
from gsmap.localize.matching import FeatureSet, match_features
from gsmap.localize.refinement import ScaledPhoto
from gsmap.localize.resection import retract_pose
from gsmap.localize.retrieval import retrieve_views
from gsmap.localize.vocabulary import Vocabulary, load_vocabulary
from gsmap.map.localization.localize import Localizer
from gsmap.map.progress_logging import log_progress
from gsmap.map.small_map.export import SmallLocalizer, export_small
from gsmap.render import render
from gsmap.types import Cameras, Sim3
from gsmap.types.localization import LocalizationResult, Photo, SceneFeatures
from gsmap.types.segments import merged
from tools.fit.localize import places


@dataclass(eq=False)
class Shot:
    """A photograph with truth: the pose of its camera in the world, and how much of it the map covers."""

    photo: Photo
    T_world_camera: np.ndarray
    coverage: float
    allowed: set[str]


@dataclass(eq=False)
class World:
    """A map and what is true of it."""

    localizer: Localizer
    S_scene_world: dict[str, Sim3]  # by scene id
    ids: dict[str, str]  # by name
    crowd: set[str] = field(default_factory=set)  # ids of scenes that show nothing that is asked for

    def localize(
        self, photo: Photo, allowed: set[str], within: Localizer | None = None
    ) -> tuple[LocalizationResult, float]:
        """In a map of some of its scenes; and CPU seconds.

        Args:
            within: a small map of it.
        """
        held = within or self.localizer
        began = time.process_time()
        index = held.index.only(allowed | self.crowd)
        found = localize_photo(photo, index, held.placed, held.extractor, held.params, held.metres)
        return found, time.process_time() - began

    def fill(self, num_scenes: int, strangers: list[MapScene], work: Path) -> None:
        """Add others until the map has so many scenes; their segment lies on the disk as a map's does."""
        held, rng = self.localizer, np.random.default_rng(7)
        kept = [scene.features for scene in strangers]
        words = load_vocabulary(kept[0].descriptors.shape[1])
        others = Others(words, np.concatenate([found.descriptors for found in kept]))
        component = held.placed[next(iter(self.ids.values()))].component
        shutil.rmtree(work / "crowd", ignore_errors=True)
        parts, there = [], []
        for number in range(num_scenes - len(self.ids)):
            scene = strangers[number % len(strangers)]
            found = scene.features if number < len(strangers) else others.like(scene.features, rng)
            name = f"{number:032x}"
            place = Sim3(np.eye(3), np.array([100.0 * (number + 1), 0, 0])) @ scene.S_metric_scene
            read = partial(_read, _written(found, work / "crowd" / f"{number}.npz"), scene.features)
            held.placed[name] = replace(
                scene, scene=name, S_metric_scene=place, component=component, read_features=read
            )
            self.crowd.add(name)
            there.append((replace(found, scene=name), "0" * 32))
            if len(there) == 64 or number == num_scenes - len(self.ids) - 1:
                parts.append(new_segment(there))
                there = []
        whole = merged(parts)
        store = gsmap.map.create(work / "crowd" / "crowd.gsmap").store
        store.indexes.save_segment(index_recipe(), [m for m in whole.members if m is not None], whole.arrays, ())
        held.index = view_index([*held.index.segments, *store.indexes.segments(index_recipe())])

    def anchor(self, component: int) -> str:
        """The scene that a component's frame is fixed to."""
        there = [one for one in map(self.localizer.placed.get, self.ids.values()) if one.component == component]
        return min(there, key=lambda one: 0.0 if one.covariance is None else float(np.trace(one.covariance))).scene

    def truth(self, shot: Shot, scene: str) -> np.ndarray:
        """(4, 4) the camera in the frame of the map that a scene says."""
        return self.truth_of(shot.T_world_camera, scene)

    def truth_of(self, T_world_camera: np.ndarray, scene: str) -> np.ndarray:
        """The same of a pose in the world."""
        placed = self.localizer.placed[scene]
        unit = self.localizer.metres.get(placed.component, 1.0)
        S = placed.S_metric_scene @ self.S_scene_world[scene]
        out = np.eye(4)
        out[:3, :3] = S.rotation @ T_world_camera[:3, :3]
        out[:3, 3] = S.apply(T_world_camera[:3, 3]) / unit
        return out


class Others:
    """Features as alike to those of captures as captures' are to each other.

    Args:
        words: of the index.
        descriptors: (N, D) int8 that there are.
    """

    def __init__(self, words: Vocabulary, descriptors: np.ndarray) -> None:
        word = words.nearest(words.reduce(descriptors / np.float32(254)))[:, 0]
        self.words, self.descriptors = words, descriptors[np.argsort(word, kind="stable")]
        self._known: dict[str, np.ndarray] = {}  # by scene, the words of its features
        self.starts = np.searchsorted(np.sort(word), np.arange(len(words.centres) + 1))

    def _words_of(self, found: SceneFeatures) -> np.ndarray:
        if found.scene not in self._known:
            short = self.words.reduce(found.descriptors / np.float32(254))
            self._known[found.scene] = self.words.nearest(short)[:, 0]
        return self._known[found.scene]

    def like(self, found: SceneFeatures, rng: np.random.Generator) -> SceneFeatures:
        """Each feature moved a random part of the way to another one of its word."""
        own = found.descriptors.astype(np.float32)
        word = self._words_of(found)
        size = self.starts[word + 1] - self.starts[word]
        other = self.descriptors[self.starts[word] + (rng.random(len(own)) * size).astype(int)].astype(np.float32)
        out = own + rng.random((len(own), 1), np.float32) * (other - own)
        out *= 254 / np.linalg.norm(out, axis=1, keepdims=True)
        return replace(found, descriptors=np.clip(np.round(out), -127, 127).astype(np.int8))


def _written(found: SceneFeatures, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, descriptors=found.descriptors)
    return path


def _read(path: Path, like: SceneFeatures) -> SceneFeatures:
    """The features of a scene of the crowd, read anew."""
    with np.load(path) as stored:
        return replace(like, descriptors=stored["descriptors"])


def world(data: Path, work: Path, names: list[str]) -> World:
    """The map of some captures, made where it is missing; the features of its views are made as well."""
    path = work / f"{data.name}.gsmap"
    fresh = not path.exists()
    m = gsmap.map.open_or_create(path)
    if fresh:
        began = time.process_time()
        m.update(*(data / f"{name}.ply" for name in names))
        print(f"{path.name}: {time.process_time() - began:.0f} CPU s in this process")
    localizer, took = timed(Localizer, m.store, m.settings, log_progress(None))
    print(f"{len(localizer.scenes)} scenes, {took:.1f} CPU s here")
    truth, ids = {}, {}
    for scene in localizer.scenes.values():
        told = json.loads((data / "truth" / f"{scene.name}.json").read_text())
        truth[scene.id], ids[scene.name] = Sim3.from_matrix(np.array(told["T_scene_world"])), scene.id
    return World(localizer, truth, ids)


def house_shots(data: Path, held: World, only: list[str]) -> Iterator[Shot]:
    """Photographs that captures were trained on, each in the map of all other captures."""
    for name, scene in sorted(held.ids.items()):
        if name not in only:
            continue
        cameras = held.localizer.store.scenes.cameras(scene)
        numbers = {int(camera): row for row, camera in enumerate(cameras.names)} if cameras.names[0].isdigit() else {}
        for path in sorted((data / "frames").glob(f"{name}_*.jpg")):
            row = numbers.get(int(path.stem[-3:]), int(path.stem[-3:]))
            S = held.S_scene_world[scene].inverse()
            pose = np.eye(4)
            pose[:3, :3] = S.rotation @ cameras.T_frame_camera[row, :3, :3]
            pose[:3, 3] = S.apply(cameras.centers[row])
            photo = Photo(np.asarray(Image.open(path).convert("RGB")), cameras.intrinsics_px[row], 0.0, path.name)
            depth = _depth(held, scene, cameras[[row]].resized(120))
            others = {other for other in held.ids.values() if other != scene}
            yield Shot(photo, pose, _coverage(held, photo, pose, depth, others), others)


def kitchen_shots(data: Path, held: World) -> Iterator[Shot]:
    """The eight frames of a sensor: in the whole map, which was trained on others of them."""
    scenes = set(held.ids.values())
    for photo, pose, depth in kitchen_frames(data.parent / "kitchen"):
        yield Shot(photo, pose, _coverage(held, photo, pose, depth, scenes), scenes)


def kitchen_frames(frames: Path) -> Iterator[tuple[Photo, np.ndarray, np.ndarray]]:
    """Each frame's photograph, camera-to-world pose and depth (a fifth of its size)."""
    fx, _, cx, _, fy, cy, *_ = np.loadtxt(frames / "camera-intrinsics.txt").ravel()
    for path in sorted(frames.glob("*.color.jpg")):
        pose = np.loadtxt(path.with_name(path.name.replace("color.jpg", "pose.txt")))
        image = np.asarray(Image.open(path).convert("RGB"))
        raw = np.asarray(Image.open(path.with_name(path.name.replace("color.jpg", "depth.png")))).astype(np.float32)
        depth = np.where(raw < 65535, raw / 1000, 0)[::5, ::5]
        yield Photo(image, np.array([fx, fy, cx, cy]), 0.0, path.name), pose, depth


def _depth(held: World, scene: str, camera: Cameras) -> np.ndarray:
    shown = render(held.localizer.placed[scene].gaussians, camera, dominant_id=False, backend="native")
    return np.where(shown.alpha[0] > 0.9, shown.depth[0], 0)


def _coverage(held: World, photo: Photo, pose: np.ndarray, depth: np.ndarray, scenes: set[str]) -> float:
    """Share of the pixels of a small depth image whose surface some of the scenes has."""
    height, width = depth.shape
    intrinsics = photo.intrinsics_px * (width / photo.size_px[0])
    has = np.zeros(depth.shape, bool)
    for scene in scenes:
        S = held.S_scene_world[scene]
        inside = np.eye(4)
        inside[:3, :3], inside[:3, 3] = S.rotation @ pose[:3, :3], S.apply(pose[:3, 3])
        other = _depth(held, scene, Cameras(inside[None], intrinsics[None], np.array([[width, height]])))
        has |= (depth > 0) & (other > 0) & (np.abs(other - depth) < 0.05 + 0.02 * depth)
    return float(has.mean())


# --- perturbations ---------------------------------------------------------------------------------------------------


def exposed(stops: float) -> Callable[[Photo], Photo]:
    def change(photo: Photo) -> Photo:
        rgb = np.clip(255 * (photo.rgb / 255.0) * 2 ** (stops / 2.2), 0, 255).astype(np.uint8)
        return Photo(rgb, photo.intrinsics_px, 0.0, photo.name)

    return change


def halved(photo: Photo) -> Photo:
    width, height = photo.size_px
    rgb = np.asarray(Image.fromarray(photo.rgb).resize((width // 2, height // 2), Image.Resampling.BOX))
    return Photo(rgb, photo.intrinsics_px / 2, 0.0, photo.name)


def nearer(photo: Photo) -> Photo:
    """Another lens: the middle three quarters, as large as before."""
    width, height = photo.size_px
    x, y = width // 8, height // 8
    part = Image.fromarray(photo.rgb).crop((x, y, width - x, height - y))
    fx, fy, cx, cy = photo.intrinsics_px
    factor = width / (width - 2 * x)
    rgb = np.asarray(part.resize((width, height), Image.Resampling.BICUBIC))
    return Photo(rgb, np.array([fx, fy, cx - x, cy - y]) * factor, 0.0, photo.name)


def hidden(photo: Photo, *, masked: bool = False) -> Photo:
    """Somebody upright in a tenth of the picture; told by a mask, or not."""
    width, height = photo.size_px
    rng = np.random.default_rng(sum(photo.name.encode()))
    tall, wide = 0.8 * height, 0.125 * width
    x = rng.uniform(wide / 2, width - wide / 2)
    v, u = np.mgrid[0:height, 0:width]
    body = (np.abs(u - x) < wide / 2) & (v > height - tall)
    stripes = rng.uniform(0, 255, (8, 3))[(v // 25) % 8] + rng.normal(0, 12, photo.rgb.shape)
    rgb = np.where(body[..., None], np.clip(stripes, 0, 255), photo.rgb).astype(np.uint8)
    return Photo(rgb, photo.intrinsics_px, 0.0, photo.name, known=~body if masked else None)


def unknown_focal(photo: Photo) -> Photo:
    cx, cy = photo.intrinsics_px[2:]
    likely = 0.8 * max(photo.size_px)
    return Photo(photo.rgb, np.array([likely, likely, cx, cy]), np.inf, photo.name)


PERTURBED: dict[str, Callable[[Photo], Photo]] = {
    "as it is": lambda photo: photo,
    "+1 EV": exposed(1.0),
    "-1 EV": exposed(-1.0),
    "half resolution": halved,
    "another focal length": nearer,
    "a tenth hidden": hidden,
    "a tenth hidden, masked": partial(hidden, masked=True),
    "focal length unknown": unknown_focal,
}

# --- others ---------------------------------------------------------------------------------------------------------


def retrieval_alone(held: World) -> Localise:
    """The pose of the view that looks most alike."""

    def localise(photo: Photo, allowed: set[str]) -> tuple[LocalizationResult, float]:
        began = time.process_time()
        localizer = held.localizer
        index = localizer.index.only(allowed)
        picture, _ = scale_photo(photo, localizer.params.views.image_size_px)
        found = extract_features(picture, localizer.extractor, SMOOTH_PX)
        views = retrieve_views(index, found, picture.intrinsics_px, 1)
        if not views:
            return LocalizationResult("no view is like it", name=photo.name), time.process_time() - began
        scene, view = views[0]
        placed = localizer.placed[scene]
        pose = _in_map(held, scene, placed.features.cameras.T_frame_camera[view])
        return LocalizationResult(
            "", pose, None, placed.component, (scene,), name=photo.name
        ), time.process_time() - began

    return localise


def _in_map(held: World, scene: str, T_scene_camera: np.ndarray) -> np.ndarray:
    placed = held.localizer.placed[scene]
    S = placed.S_metric_scene
    out = np.eye(4)
    out[:3, :3] = S.rotation @ T_scene_camera[:3, :3]
    out[:3, 3] = S.apply(T_scene_camera[:3, 3]) / held.localizer.metres.get(placed.component, 1.0)
    return out


class Started:
    """What settles of a pose 10 cm and 3 degrees off the true one, whatever is then said of it."""

    def __init__(self, held: World, shots: list[Shot]) -> None:
        self.held, self.shots, self.rng = held, {shot.photo.name: shot for shot in shots}, np.random.default_rng(0)

    def localize(self, photo: Photo, allowed: set[str]) -> tuple[LocalizationResult, float]:
        shot, localizer = self.shots[photo.name], self.held.localizer
        begin = time.process_time()
        picture, scale = scale_photo(photo, localizer.params.views.image_size_px)
        covers = {scene: self._covered(shot, scene, picture) for scene in allowed}
        scenes = sorted(allowed, key=lambda scene: -covers[scene])[:3]
        component = localizer.placed[scenes[0]].component
        unit = localizer.metres.get(component, 1.0)
        pose = self._metric(shot, scenes[0])
        turn, shift = self.rng.normal(size=(2, 3))
        xi = np.r_[np.radians(3) * turn / np.linalg.norm(turn), 0.1 * shift / np.linalg.norm(shift)]
        start = PoseCandidate(component, retract_pose(pose, xi), picture.intrinsics_px, 0, tuple(scenes))
        found = evaluate_pose(picture, start, localizer.placed, localizer.params.verdict.aliased_prior)
        seconds = time.process_time() - begin
        if found.covariance is None:
            return LocalizationResult("nothing was found again", name=photo.name), seconds
        answer = found.refined.T_metric_camera.copy()
        answer[:3, 3] /= unit
        side = np.r_[np.ones(3), np.full(3, 1 / unit)]
        known = found.covariance * np.outer(side, side)
        return LocalizationResult(
            "",
            answer,
            known,
            component,
            tuple(scenes),
            intrinsics_px=picture.intrinsics_px / scale,
            name=photo.name,
        ), seconds

    def _metric(self, shot: Shot, scene: str) -> np.ndarray:
        out = self.held.truth(shot, scene)
        out[:3, 3] *= self.held.localizer.metres.get(self.held.localizer.placed[scene].component, 1.0)
        return out

    def _covered(self, shot: Shot, scene: str, picture: ScaledPhoto) -> float:
        small = (picture.size_px[0] // 4, picture.size_px[1] // 4)
        placed = [self.held.localizer.placed[scene]]
        looks = render_scenes(placed, self._metric(shot, scene), picture.intrinsics_px / 4, small)
        return float((looks[0].alpha > 0.9).mean())


def sift_beside_colmap(shots: list[Shot]) -> None:
    """How many features of photographs are the same, how far their descriptors are apart, and what both cost."""
    import warnings

    import pycolmap
    from scipy.spatial import cKDTree

    ours, params = sift.make({}, sift.Params()), sift.Params()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features, options.sift.peak_threshold = params.max_features, sift.PEAK_THRESHOLD
    options.sift.edge_threshold, options.sift.normalization = sift.EDGE_THRESHOLD, pycolmap.Normalization.L1_ROOT
    warnings.simplefilter("ignore", DeprecationWarning)
    theirs = pycolmap.Sift(options, pycolmap.Device.cpu)
    same, apart, seconds = [], [], np.zeros(2)
    for shot in shots:
        began = time.process_time()
        mine = ours.extract(shot.photo.rgb)
        between = time.process_time()
        grey = (shot.photo.rgb @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8)
        found, descriptors = theirs.extract(np.ascontiguousarray(grey))
        seconds += between - began, time.process_time() - between
        assert mine.angles_rad is not None
        places = np.c_[mine.pixels, np.cos(mine.angles_rad), np.sin(mine.angles_rad)]
        far, row = cKDTree(places).query(np.c_[found[:, :2], np.cos(found[:, 3]), np.sin(found[:, 3])])
        same.append((far < 0.02).mean())
        apart.append(np.abs(mine.descriptors[row] - descriptors)[far < 0.02].max(1))
    print(
        f"SIFT of {len(shots)} photographs: {np.mean(same):.1%} of COLMAP's features to a fiftieth of a pixel, "
        f"99 % of their descriptors within {512 * np.quantile(np.concatenate(apart), 0.99):.0f} of 512; "
        f"{seconds[0] / len(shots):.3f} CPU s a photo, COLMAP {seconds[1] / len(shots):.3f}"
    )


class PosedPhotos:
    """The captures' own photographs: features, lifted to the map (metres) by the depth of the capture's splat."""

    def __init__(self, data: Path, held: World) -> None:
        self.held = held
        self.features: list[tuple[str, FeatureSet, np.ndarray, np.ndarray]] = []  # scene, features, words, points
        began = time.process_time()
        for shot, scene in _photographs(data, held):
            camera = Cameras(shot.T_world_camera[None], shot.photo.intrinsics_px[None], np.array([shot.photo.size_px]))
            placed = held.localizer.placed[scene]
            shown = render(placed.gaussians, camera, dominant_id=False, backend="native")
            found = held.localizer.extractor.extract(shot.photo.rgb)
            rows, points = lift(found, shown, camera)
            described = FeatureSet(quantize(found.descriptors[rows]), np.zeros(len(rows), np.uint8))
            at = placed.S_metric_scene.apply(points)
            self.features.append((scene, described, word_histogram(found), at))
        print(f"features of {len(self.features)} posed photographs: {time.process_time() - began:.0f} CPU s")

    def __call__(self, photo: Photo, allowed: set[str]) -> tuple[LocalizationResult, float]:
        import pycolmap

        began = time.process_time()
        localizer = self.held.localizer
        found = localizer.extractor.extract(photo.rgb)
        mine = FeatureSet(quantize(found.descriptors), np.zeros(len(found), np.uint8))
        mine_words = word_histogram(found)
        known = [one for one in self.features if one[0] in allowed]
        likeness = np.array([one[2] @ mine_words for one in known])
        parts: dict[int, list[tuple[str, np.ndarray, np.ndarray]]] = {}
        for k in np.argsort(-likeness, kind="stable")[:MOST_PHOTOS]:
            scene, described, _, points = known[k]
            rows, columns = match_features(mine, described)
            component = localizer.placed[scene].component
            parts.setdefault(component, []).append((scene, found.pixels[rows], points[columns]))
        best, why = None, LocalizationResult("too few agree", name=photo.name)
        for component, held in parts.items():
            pixels, points = (np.concatenate([part[n] for part in held]).astype(np.float64) for n in (1, 2))
            if len(pixels) < 4:
                continue
            width, height = photo.size_px
            camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=photo.intrinsics_px)
            options = pycolmap.AbsolutePoseEstimationOptions()
            options.ransac.max_error = 4.0 * max(photo.size_px) / 480
            answer = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options)
            if answer is None or answer["num_inliers"] < max(AGREE, best or 0):
                continue
            best = answer["num_inliers"]
            T = np.vstack([answer["cam_from_world"].matrix(), [0, 0, 0, 1]])
            pose = np.linalg.inv(T)
            pose[:3, 3] /= localizer.metres.get(component, 1.0)
            ids = np.repeat(np.arange(len(held)), [len(part[1]) for part in held])
            most = np.bincount(ids[answer["inlier_mask"]], minlength=len(held)).argmax()
            why = LocalizationResult("", pose, None, component, (held[most][0],), name=photo.name)
        return why, time.process_time() - began


MOST_PHOTOS, AGREE = 20, 12


def _photographs(data: Path, held: World) -> Iterator[tuple[Shot, str]]:
    """Every photograph of every capture with the pose of its camera in the capture's own frame, and the capture."""
    for name, scene in sorted(held.ids.items()):
        cameras = held.localizer.store.scenes.cameras(scene)
        numbers = {int(camera): row for row, camera in enumerate(cameras.names)} if cameras.names[0].isdigit() else {}
        for path in sorted((data / "frames").glob(f"{name}_*.jpg")):
            row = numbers.get(int(path.stem[-3:]), int(path.stem[-3:]))
            photo = Photo(np.asarray(Image.open(path).convert("RGB")), cameras.intrinsics_px[row], 0.0, path.name)
            yield Shot(photo, cameras.T_frame_camera[row], 0.0, set()), scene


# --- what is said ----------------------------------------------------------------------------------------------------


Localise = Callable[[Photo, set[str]], tuple[LocalizationResult, float]]


def measure(
    held: World,
    shots: list[Shot],
    change: Callable[[Photo], Photo],
    verbose: bool,
    localise: Localise | None = None,
) -> list[dict]:
    """What is found of each photograph; by gsmap, or as ``localise`` finds it."""
    rows = []
    for shot in shots:
        found, seconds = (localise or held.localize)(change(shot.photo), shot.allowed)
        row = {"name": shot.photo.name, "coverage": shot.coverage, "cpu": seconds, "placed": found.is_placed}
        if found.is_placed:
            truth = held.truth(shot, found.scenes[0])
            pose = found.T_map_camera
            row["deg"] = float(np.degrees(angle_between(pose[:3, :3], truth[:3, :3])))
            unit = held.localizer.metres.get(found.component, 1.0)
            row["m"] = float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]) * unit)
            known, truth = found.covariance, held.truth(shot, held.anchor(found.component))
            turn = pose[:3, :3].T @ truth[:3, :3]
            xi = np.r_[rotation_vectors(turn)[0], pose[:3, :3].T @ (truth[:3, 3] - pose[:3, 3])]
            row["nees"] = np.nan if known is None else float(xi @ np.linalg.solve(known, xi))
        rows.append(row)
        if verbose:
            told = (
                f"{row['deg']:.2f} deg {100 * row['m']:.1f} cm NEES {row['nees']:.1f}"
                if found.is_placed
                else found.reason
            )
            print(f"  {row['name']} covered {shot.coverage:.0%}: {told} ({seconds:.2f} CPU s)", flush=True)
    return rows


def say(name: str, rows: list[dict], deg: float, metres: float) -> None:
    """One line: recall of the well-covered, errors, wrong ones, cost."""
    well = [row for row in rows if row["coverage"] >= 0.4]
    good = [row for row in rows if row["placed"] and row["deg"] < deg and row["m"] < metres]
    wrong = [row for row in rows if row["placed"] and (row["deg"] > 5 or row["m"] > 0.3)]
    errors = np.array([(row["deg"], 100 * row["m"]) for row in rows if row["placed"]]).reshape(-1, 2)
    nees = np.median([row["nees"] for row in rows if row["placed"]] or [np.nan]) / 5.35
    of_well = sum(row in good for row in well)
    middle = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
    print(
        f"{name}: {of_well} of {len(well)} covered by 40 % within {deg:g} deg / {100 * metres:g} cm "
        f"({of_well / max(len(well), 1):.0%}); {len(errors)} of {len(rows)} placed, {len(wrong)} wrong; median "
        f"{middle[0]:.2f} deg {middle[1]:.1f} cm; median NEES {nees:.2f} of expectation; "
        f"{np.mean([row['cpu'] for row in rows]):.2f} CPU s a photo",
        flush=True,
    )


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", nargs="+", default=["c0", "c1", "c2", "c3"])
    parser.add_argument("--kitchen", action="store_true")
    parser.add_argument("--perturb", action="store_true")
    parser.add_argument("--elsewhere", action="store_true")
    parser.add_argument("--beside", action="store_true")
    parser.add_argument("--sift", action="store_true")
    parser.add_argument("--started", action="store_true")
    parser.add_argument("--small", type=float, metavar="SHARE")
    parser.add_argument("--crowd", type=int, metavar="SCENES")
    parser.add_argument("--places", type=Path, help="that the crowd is made of")
    parser.add_argument("-v", action="store_true")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    if args.kitchen:
        data = args.data / "kitchen_splats"
        held = world(data, args.work, ["k0", "k3", "k5"])
        shots, deg, metres = list(kitchen_shots(args.data / "kitchen_splats", held)), 2.0, 0.08
    else:
        data = args.data / "house"
        held = world(data, args.work, ["c0", "c1", "c2", "c3", "c5"])
        shots, deg, metres = list(house_shots(args.data / "house", held, args.only)), 1.0, 0.05
    if args.elsewhere:
        if args.kitchen:
            house = sorted((args.data / "house" / "frames").glob("*.jpg"))
            strangers = [Photo(np.asarray(Image.open(p)), np.array([280.0, 280, 240, 180]), 0.0, p.name) for p in house]
        else:
            strangers = [photo for photo, *_ in kitchen_frames(args.data / "kitchen")]
        placed = [held.localize(photo, set(held.ids.values()))[0] for photo in strangers]
        print(f"photographs of another place: {sum(p.is_placed for p in placed)} of {len(placed)} placed")
        return 0
    as_is = PERTURBED["as it is"]
    changes = PERTURBED if args.perturb else {"as it is": as_is}
    for name, change in changes.items():
        say(name, measure(held, shots, change, args.v), deg, metres)
    if args.sift:
        sift_beside_colmap(shots)
    if args.started:
        say(
            "from 10 cm and 3 degrees off",
            measure(held, shots, as_is, args.v, Started(held, shots).localize),
            deg,
            metres,
        )
    if args.beside:
        say("retrieval alone", measure(held, shots, as_is, args.v, retrieval_alone(held)), deg, metres)
        say("SIFT + PnP on photographs", measure(held, shots, as_is, args.v, PosedPhotos(data, held)), deg, metres)
    if args.crowd:
        if args.places is None:
            parser.error("a crowd is of made captures: --places FOLDER")
        made = places(args.places, "fit", args.work / "features", held.localizer.params)
        held.fill(args.crowd, [scene for place in made for scene in place.scenes], args.work)
        say(f"among {args.crowd} scenes", measure(held, shots, as_is, args.v), deg, metres)
    if args.small is not None:
        small = small_map(held, data, args.work, args.small)
        for name, change in changes.items():
            rows = measure(held, shots, change, args.v, lambda *asked: held.localize(*asked, within=small))
            say(f"the small map, {name}", rows, deg, metres)
    return 0


def small_map(held: World, data: Path, work: Path, share: float) -> SmallLocalizer:
    """A small map in a share of the bytes of the captures' files, made anew."""
    out = work / "small"
    shutil.rmtree(out, ignore_errors=True)
    whole = sum((data / f"{name}.ply").stat().st_size for name in held.ids)
    store, settings = held.localizer.store, held.localizer.settings
    began = time.process_time()
    report = export_small(store, out, int(share * whole), settings, log_progress(None))
    print(
        f"small map: {report.num_bytes / 1e6:.2f} MB of {whole / 1e6:.1f} ({report.num_bytes / whole:.1%}), "
        f"{time.process_time() - began:.1f} CPU s"
    )
    return SmallLocalizer(out)


if __name__ == "__main__":
    sys.exit(main())
