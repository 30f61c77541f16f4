"""What photographs of one place are worth to each other, on clips through made places and streets: tables to choose by.

    python -m tools.make.localize_places PLACES --set fit
    python -m tools.fit.clips PLACES alike --cache FOLDER    # constants of `joint_localization` against aliased rooms
    python -m tools.fit.clips PLACES bundle --cache FOLDER   # constants of `bundle_adjustment`

Clips are those of ``tools/bench/clips.py``, of the places that curves are fitted on. They are looked into once (a
quarter of an hour of two cores) and kept in FOLDER by what takes part; tables take minutes. Nothing is written:
the constants are in `gsmap.localize.joint_localization` and `gsmap.localize.bundle_adjustment`.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import hashlib
import pickle
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from gsmap.geometry.uncertainty import max_sigmas
from gsmap.localize import bundle_adjustment, joint_localization, verdict
from gsmap.localize.localization import rival_probability
from gsmap.localize.params import Params
from gsmap.methods import family
from gsmap.types.plain import canonical, plain
from tools.bench.clips import Frame, made_clips, street_clips
from tools.fit.localize import WRONG_DEG, WRONG_M, Place, camera_error, index_of, places_and_streets

COVERED = 0.2
_LATER = ("clips", "min_change_fraction")  # settings that take no part in what is kept


@dataclass(eq=False)
class Seen:
    """A frame of a clip that was looked into.

    Args:
        frame: without its picture.
        evidence, probability, sigmas, rival: of the pose that is believed; evidence is None where there is none.
        known: as it is adjusted with others from that pose; None where there is none, or it has no covariance.
        free: as it is adjusted where it is not placed.
    """

    frame: Frame
    evidence: Mapping[str, float] | None
    probability: float
    sigmas: tuple[float, float]
    rival: float
    known: bundle_adjustment.BundlePhoto | None
    free: bundle_adjustment.BundlePhoto


@dataclass(eq=False)
class Clip:
    """A clip: ``made``, or of a street's ``own`` rooms or of such that look ``alike``."""

    kind: str
    seen: list[Seen]
    ties: dict[tuple[int, int], bool]
    matches: bundle_adjustment.Matches


def clips_of(place: Place, params: Params) -> list[Clip]:
    """What the clips of a place tell."""
    scenes = {scene.scene: scene for scene in place.scenes}
    index = index_of(place.scenes, params)
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    is_street = place.folder.parent.name.endswith("_streets")
    filmed = street_clips(place) if is_street else (("made", frames) for frames in made_clips(place, params))
    out = []
    for kind, frames in filmed:
        shots, near, ties = joint_localization.evaluate_photos(
            [frame.photo for frame in frames], index, scenes, extractor, params
        )
        seen = [_seen(frame, shot) for frame, shot in zip(frames, shots, strict=True)]
        out.append(Clip(kind, seen, dict(ties), joint_localization.match_neighbours(shots, near)))
    print(f"{place.seed}: {len(out)} clips", flush=True)
    return out


def _seen(frame: Frame, shot: joint_localization.PhotoState) -> Seen:
    best, free = shot.best, joint_localization.bundle_photo(shot, False)
    blank = replace(frame, photo=replace(frame.photo, rgb=frame.photo.rgb[:1, :1]))
    if best is None:
        return Seen(blank, None, 0.0, (np.inf, np.inf), 0.0, None, free)
    known = None if best.covariance is None else joint_localization.bundle_photo(shot, True)
    rival = rival_probability(shot.poses)
    return Seen(blank, best.evidence, best.probability, max_sigmas(best.covariance), rival, known, free)


def all_clips(folder: Path, cache: Path, params: Params, workers: int) -> list[Clip]:
    """Of all places and streets that are fitted on; kept by what they depend on."""
    settings = canonical(plain({name: value for name, value in vars(params).items() if name not in _LATER}))
    kept = cache / f"clips-{hashlib.sha256(settings.encode()).hexdigest()[:8]}.pickle"
    if not kept.exists():
        began = time.time()
        with ProcessPoolExecutor(workers) as pool:
            told = list(pool.map(partial(clips_of, params=params), places_and_streets(folder, "fit", cache, params)))
        kept.write_bytes(pickle.dumps([clip for clips in told for clip in clips]))
        print(f"looked into in {time.time() - began:.0f} s")
    found: list[Clip] = pickle.loads(kept.read_bytes())
    return found


def placed(clip: Clip, params: Params) -> list[bool]:
    """Which frames are placed by their own evidence and that of the others, before they are adjusted."""
    shots = [
        SimpleNamespace(
            best=None if one.evidence is None else SimpleNamespace(evidence=one.evidence),
            probability=one.probability,
            unsupported=False,
        )
        for one in clip.seen
    ]
    out = []
    elsewhere = joint_localization.rival_factors([one.probability - one.rival for one in clip.seen], clip.ties)
    probable_of = joint_localization.combine_probabilities(shots, clip.ties, params.verdict.aliased_prior)
    for one, probable, with_others in zip(clip.seen, probable_of, elsewhere, strict=True):
        min_inliers = 0 if probable > one.probability else verdict.MIN_INLIERS
        rival = one.rival * with_others
        said = one.evidence is not None and not verdict.rejection_reason(
            one.evidence, probable, one.sigmas, rival, params.verdict, min_inliers
        )
        out.append(said and one.known is not None)
    return out


def is_right(pose: np.ndarray, frame: Frame) -> bool:
    xi = camera_error(pose, frame.T_metric_camera)
    return bool(np.degrees(np.linalg.norm(xi[:3])) <= WRONG_DEG and np.linalg.norm(xi[3:]) <= WRONG_M)


def say_alike(clips: Sequence[Clip], params: Params) -> None:
    """What the settings of a room that looks alike cost and save."""
    print(
        "shared  usual  most   of rooms that look alike placed   of the map's own placed right, wrong   of made clips"
    )
    for shared, usual, most in product((0.25, 0.5, 0.75, 1.0), (1.0, 1.75, 2.5), (2.0, 4.0, 8.0)):
        default = _constants()
        _set_constants(shared, usual, most)
        counts = {kind: np.zeros(4, int) for kind in ("alike", "own", "made")}
        for clip in clips:
            for seen, said in zip(clip.seen, placed(clip, params), strict=True):
                right = said and is_right(seen.known.T_metric_camera, seen.frame)
                covered = seen.frame.coverage >= COVERED
                counts[clip.kind] += [1, said, right and covered, covered]
        alike, own, made = (counts[kind] for kind in ("alike", "own", "made"))
        _set_constants(*default)
        star = "*" if (shared, usual, most) == default else " "
        print(
            f"{shared:5.2f}{star} {usual:6.2f} {most:5.0f}   {alike[1]:5d} of {alike[0]}"
            f"                       {own[2]:5d} of {own[3]}, {own[1] - own[2]:3d}"
            f"                            {made[2]:5d} of {made[3]}",
            flush=True,
        )


def _constants() -> tuple[float, float, float]:
    module = joint_localization
    return module.SHARED_EVIDENCE, module.EXPECTED_LOG_ODDS, module.MAX_LOG_ODDS


def _set_constants(shared: float, usual: float, most: float) -> None:
    module = joint_localization
    module.SHARED_EVIDENCE, module.EXPECTED_LOG_ODDS, module.MAX_LOG_ODDS = shared, usual, most


def say_bundle(clips: Sequence[Clip], params: Params) -> None:
    """What adjusting at once does, as it is set and with one setting otherwise."""
    said = [placed(clip, params) for clip in clips]
    before = [
        (seen.known.T_metric_camera, seen.known.covariance, seen.frame)
        for clip, told in zip(clips, said, strict=True)
        for seen, one in zip(clip.seen, told, strict=True)
        if one
    ]
    print("each by the map:            ", _errors(before))
    changes: list[tuple[str, object]] = [("", None)]
    changes += [("TOLERANCES", (1.0,)), ("TOLERANCES", (1.0, 1.0)), ("TOLERANCES", (3.0, 1.0))]
    changes += [("ROBUST_SIGMAS", 0.5), ("ROBUST_SIGMAS", 2.0), ("MIN_POINTS", 8), ("MIN_POINTS", 20)]
    changes += [("MIN_SUPPORTERS", 1), ("MAX_ERROR_PX", 3.0), ("MAX_SHIFT_SIGMAS", 1e6), ("VARIANCE_PRIOR", 1e9)]
    changes += [("POSE_CORRELATION", 0.0), ("POSE_CORRELATION", 0.2), ("POSE_CORRELATION", 1.0)]
    changes += [("CORRELATED_FEATURE_PX", 1.0), ("CORRELATED_FEATURE_PX", 3.0)]
    for name, value in changes:
        default = getattr(bundle_adjustment, name) if name else None
        if name:
            setattr(bundle_adjustment, name, value)
        began = time.process_time()
        of_map, found = [], []
        for clip, told in zip(clips, said, strict=True):
            photos = [seen.known if one else seen.free for seen, one in zip(clip.seen, told, strict=True)]
            for k, one in bundle_adjustment.adjust_photos(photos, clip.matches)[0].items():
                turn, shift = max_sigmas(one.covariance)
                bars = params.verdict
                if np.degrees(turn) < bars.max_rotation_sigma_deg and shift < bars.max_translation_sigma_m:
                    row = (one.T_metric_camera, one.covariance, clip.seen[k].frame)
                    (found if one.resected_from else of_map).append(row)
        seconds = (time.process_time() - began) / max(sum(len(clip.seen) for clip in clips), 1)
        if name:
            setattr(bundle_adjustment, name, default)
        title = f"{name} {value}" if name else "as it is set"
        print(f"{title:28s} {_errors(of_map)}; {seconds:.3f} CPU s a frame")
        print(f"{'':24s}found {_errors(found)}", flush=True)


def _errors(rows: Sequence[tuple[np.ndarray, np.ndarray, Frame]]) -> str:
    if not rows:
        return "none"
    told = []
    for pose, known, frame in rows:
        xi = camera_error(pose, frame.T_metric_camera)
        told.append((np.degrees(np.linalg.norm(xi[:3])), 100 * np.linalg.norm(xi[3:]), xi @ np.linalg.solve(known, xi)))
    wrong = sum(not is_right(pose, frame) for pose, _, frame in rows)
    (deg, cm, middle), (deg9, cm9, high) = np.quantile(told, (0.5, 0.9), axis=0)
    return (
        f"{len(rows):4d}, {wrong:2d} wrong; median {deg:.2f} deg {cm:.1f} cm, nine in ten {deg9:.2f} deg {cm9:.1f} cm; "
        f"NEES by its expectation {middle / 5.35:.2f}, nine in ten {high / 10.6:.2f}"
    )


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("what", choices=("alike", "bundle"))
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    params = Params()
    clips = all_clips(args.places, args.cache, params, args.workers)
    frames = sum(len(clip.seen) for clip in clips)
    print(f"{len(clips)} clips of {frames} frames")
    {"alike": say_alike, "bundle": say_bundle}[args.what](clips, params)
    return 0


if __name__ == "__main__":
    sys.exit(main())
