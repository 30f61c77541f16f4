"""Resolve changes between scenes of different dates: remove outdated Gaussians and mask outdated pixels of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from gsmap import compare
from gsmap.compare import GONE, HIDDEN, OTHER_IN_FRONT, REPAINTED, SAME, UNSEEN, CaptureViews, Comparison
from gsmap.geometry.boxes import inside
from gsmap.geometry.neighbours import nearest_of
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.merge.exposure import apply_balance
from gsmap.merge.overlap import boxes_overlap, share_in_view
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PosedScene
from gsmap.types.merging import UnchangedPlace

Prefer = Literal["newest", "best", "both"]
"""Preferred scene where scenes disagree: the ``newest``, the ``best`` observed one, or no preference, so that ``both``
appear."""

LOOKING_M = 10.0
"""Distance around a tile, in metres, within which Gaussians and cameras are read for comparison and reference views."""

MIN_CAMERAS = 12
"""Smallest number of cameras of each scene that are read for these purposes: the nearest ones, at any distance."""

_SHOWS = 0.15  # smallest blending weight of disputed Gaussians in a disputed pixel
_NEAR_M = 0.25  # fragments of a change are searched within this distance of it
_NEGLIGIBLE_GAIN = 0.02
_INTRUDES = 0.15  # smallest difference of colour in [0, 1] that a misfit causes in a view


@dataclass(frozen=True, eq=False)
class ResolvedScenes:
    """Scenes without outdated Gaussians.

    Args:
        scenes: the scenes in the given order, without outdated Gaussians, and in the exposure of the newest scene.
        num_removed: number of removed Gaussians of each scene.
        changed: per scene, an (N,) mask of Gaussians that replace removed Gaussians of another scene. No older scene
            shows their place, so mergers do not change them.
        behind: per scene, an (N,) mask of Gaussians beside a change that are occluded in newer scenes. Nothing
            disproves them, but they may not show the present place.
        replacements: per scene, the present Gaussians at the places of the scene's removed Gaussians; may be empty.
        removed: per scene, the removed Gaussians.
    """

    scenes: list[PosedScene]
    num_removed: list[int]
    changed: list[np.ndarray]
    behind: list[np.ndarray]
    replacements: list[Gaussians]
    removed: list[Gaussians]
    _flagged: dict[int, tuple[Gaussians, int]] = field(default_factory=dict)

    def outdated_pixels(self, scene: int, camera: Cameras, longest_side_px: int = 240) -> np.ndarray:
        """Return an (H, W) mask of pixels in one view of a scene that show outdated content or miss present content."""
        flagged, count = self._flagged_of(scene)
        width, height = (int(v) for v in camera.sizes_px[0])
        small = camera.resized(longest_side_px)
        if not count or not share_in_view(small, flagged.means[:count])[0]:
            return np.zeros((height, width), dtype=bool)
        shows = render(flagged, small, depth=False, dominant_id=False).colour[0, ..., 0] > _SHOWS
        # The tails of a Gaussian reach beyond the pixels that it visibly covers.
        shows = compare.dilate(shows)
        rows = ((np.arange(height) + 0.5) * shows.shape[0] / height).astype(int)
        columns = ((np.arange(width) + 0.5) * shows.shape[1] / width).astype(int)
        out: np.ndarray = shows[np.ix_(rows, columns)]
        return out

    def _flagged_of(self, scene: int) -> tuple[Gaussians, int]:
        """Return a scene's Gaussians, disputed ones in white and the rest in black, and the number of disputed ones.

        The result is cached for one scene, as views are processed scene by scene.
        """
        if scene not in self._flagged:
            self._flagged.clear()
            disputed = Gaussians.concatenate([self.removed[scene], self.replacements[scene]])
            parts = [_in_grey(disputed, 1.0), _in_grey(self.scenes[scene].gaussians, 0.0)]
            self._flagged[scene] = Gaussians.concatenate(parts), len(disputed)
        return self._flagged[scene]

    def is_disputed(self, scene: int) -> bool:
        """Return whether any view of a scene may show outdated content or miss present content."""
        return len(self.removed[scene]) + len(self.replacements[scene]) > 0

    def notes(self) -> list[str]:
        """Return a note for each scene with removed Gaussians."""
        return [
            f"{n} outdated Gaussians of scene {s.scene_id[:12]} are removed where the place changed"
            for s, n in zip(self.scenes, self.num_removed, strict=True)
            if n
        ]


def resolve_changes(
    scenes: Sequence[PosedScene],
    prefer: Prefer = "newest",
    *,
    max_views: int = compare.MAX_VIEWS,
    one_exposure: bool = True,
) -> ResolvedScenes:
    """Remove Gaussians that scenes of other dates disprove.

    From the newest scene back, each older scene is compared once with the combined views of all newer scenes, so N
    scenes cost N comparisons. A Gaussian of the older scene is removed if it lies in free space of the newer scenes, or
    on a surface of another colour after exposure balancing. With ``best`` this holds only if the newer scenes also
    observed the place better; otherwise the Gaussians of the newer scene are removed. Gaussians that no newer scene
    observed stay. Scenes without dates, or of one date, remove nothing, and nothing is removed where a person rejected
    the changes (`PosedScene.unchanged`).

    Args:
        scenes: scenes in the map frame.
        prefer: preferred scene where scenes disagree.
        max_views: largest number of views of each scene that are compared.
        one_exposure: bring all scenes to the exposure of the newest scene. Do not use it for a piece of a map:
            neighbouring pieces would show the same scene in another exposure.
    """
    keeps = [np.ones(len(s.gaussians), dtype=bool) for s in scenes]
    changed, behind = ([np.zeros(len(s.gaussians), dtype=bool) for s in scenes] for _ in range(2))
    replacements = [_empty(s) for s in scenes]
    exposures: list[compare.Balance | None] = [None] * len(scenes)
    newer: list[_NewerScene] = []
    groups = _by_date(scenes) if prefer != "both" else []
    for group in groups:
        added = []
        for i in group:
            views = compare.render_views(scenes[i], max_views=max_views)
            parts = [one for one in newer if boxes_overlap(one.views.scene, scenes[i])]
            if not parts:
                added.append(_NewerScene(i, views, np.ones(len(views.gaussians), dtype=bool)))
                continue
            joined = compare.combine_views([(one.views, one.shows) for one in parts], scenes[i], max_views)
            found = compare.compare(views, joined)
            verdict = _find_disagreement(views, joined, found, prefer, scenes[i].unchanged)
            exposures[i] = _exposure(found)
            keeps[i] &= ~verdict.removed
            if prefer == "newest":
                beside = _beside(views.gaussians.means, joined, verdict)
                beside &= ~_inside_any(views.gaussians.means, scenes[i].unchanged)
                behind[i] = beside & (found.older.state == HIDDEN)
                exposed = _exposed(views.gaussians, exposures[i])
                keeps[i] &= ~_find_misfits(exposed, keeps[i] & beside, joined)
            first = 0
            for one in parts:
                rows = np.flatnonzero(one.shows)
                mine = slice(first, first + len(rows))
                changed[one.scene][rows[verdict.replacing[mine]]] = True
                keeps[one.scene][rows[verdict.removed_newer[mine]]] = False
                one.shows[rows[verdict.removed_newer[mine]]] = False
                first += len(rows)
            replacements[i] = Gaussians.concatenate([replacements[i], joined.gaussians[verdict.replacing]])
            if group is groups[-1]:
                continue  # no scene is older than the oldest
            # Only Gaussians that no newer scene observed are added, so that `newer` does not outgrow the place.
            shows = keeps[i] & views.surface & np.isin(found.older.state, (UNSEEN, HIDDEN))
            added.append(
                _NewerScene(i, _in_one_exposure(compare.mask_outdated(views, found, keeps[i]), exposures[i]), shows)
            )
        newer += added
    return ResolvedScenes(
        [_remaining(s, k, e if one_exposure else None) for s, k, e in zip(scenes, keeps, exposures, strict=True)],
        [int((~k).sum()) for k in keeps],
        [c[k] for c, k in zip(changed, keeps, strict=True)],
        [b[k] for b, k in zip(behind, keeps, strict=True)],
        replacements,
        [s.gaussians[~k] for s, k in zip(scenes, keeps, strict=True)],
    )


@dataclass(frozen=True, eq=False)
class _NewerScene:
    """A newer scene: its index, its views, and an (N,) mask of its Gaussians that are compared with older scenes."""

    scene: int
    views: CaptureViews
    shows: np.ndarray


@dataclass(frozen=True, eq=False)
class _Disagreement:
    """Masks of two compared scenes: (N,) removed Gaussians of the older scene; (M,) replacing and (M,) removed
    Gaussians of the newer scene."""

    removed: np.ndarray
    replacing: np.ndarray
    removed_newer: np.ndarray


def _find_disagreement(
    older: CaptureViews,
    newer: CaptureViews,
    found: Comparison,
    prefer: Prefer,
    unchanged: Sequence[UnchangedPlace],
) -> _Disagreement:
    removed = np.isin(found.older.state, (GONE, REPAINTED))
    replacing = np.isin(found.newer.state, (GONE, REPAINTED))
    replacing |= (found.newer.state != SAME) & _revealed(newer, found)
    removed &= ~_inside_any(older.gaussians.means, unchanged)
    replacing &= ~_inside_any(newer.gaussians.means, unchanged)
    removed_newer = np.zeros(len(replacing), dtype=bool)
    if prefer == "best":
        stays = removed & (older.sharpness > found.older.sharpness)
        removed_newer = replacing & np.isin(found.newer.state, (GONE, REPAINTED))
        removed_newer &= newer.sharpness < found.newer.sharpness
        removed, replacing = removed & ~stays, replacing & ~removed_newer
    return _Disagreement(removed, replacing, removed_newer)


def _inside_any(points: np.ndarray, places: Sequence[UnchangedPlace]) -> np.ndarray:
    """Return an (N,) mask of points (N, 3) in any of the places or its margin."""
    out = np.zeros(len(points), dtype=bool)
    for place in places:
        out |= inside(place.S_frame_map.apply(points), place.box, place.margin_m)
    return out


def _revealed(newer: CaptureViews, found: Comparison) -> np.ndarray:
    """Return an (M,) mask of Gaussians of the newer scene that an object of the older scene occluded."""
    count = len(newer.gaussians)
    shown, bared = np.zeros(count), np.zeros(count)
    for picture in found.newer_views:
        dominant = picture.own.dominant_id
        shown += np.bincount(dominant[dominant >= 0], minlength=count)
        bare = (picture.outcome == OTHER_IN_FRONT) & (dominant >= 0)
        bared += np.bincount(dominant[bare], minlength=count)
    out: np.ndarray = (bared >= 2) & (bared >= 0.2 * shown)
    return out


def _beside(older: np.ndarray, newer: CaptureViews, verdict: _Disagreement) -> np.ndarray:
    """Return an (N,) mask that is True for Gaussians of the older scene near removed or replacing Gaussians."""
    disputed = np.concatenate([older[verdict.removed], newer.gaussians.means[verdict.replacing]])
    if not len(disputed):
        return np.zeros(len(older), dtype=bool)
    out: np.ndarray = np.isfinite(nearest_of(disputed, older, _NEAR_M)[0])
    return out


def _find_misfits(older: Gaussians, candidates: np.ndarray, newer: CaptureViews) -> np.ndarray:
    """Return an (N,) mask of candidate Gaussians of the older scene that would alter views of the newer scene.

    The Gaussians must be in the exposure of the newer scene. This finds the outdated Gaussians beside a change that the
    evidence on single Gaussians misses: fragments, and Gaussians smaller than a pixel.
    """
    out = np.zeros(len(older), dtype=bool)
    rows = np.flatnonzero(candidates)
    if not len(rows):
        return out
    count = len(newer.gaussians)
    together = Gaussians.concatenate([newer.gaussians, older[rows]])
    good, bad = np.zeros(len(rows)), np.zeros(len(rows))
    for view in newer.views:
        if not share_in_view(view.camera, older.means[rows])[0]:
            continue
        seen = render(together, view.camera, depth=False)
        shown = seen.dominant_id[0]
        theirs = view.opaque & (shown >= count)
        low, high = compare.local_ranges(view.colour)
        colour = np.clip(seen.colour[0][theirs], 0, 1)
        worse = (np.maximum(low[theirs] - colour, colour - high[theirs]) > _INTRUDES).any(1)
        shown = shown[theirs] - count
        bad += np.bincount(shown[worse], minlength=len(rows))
        good += np.bincount(shown[~worse], minlength=len(rows))
    out[rows[bad > good]] = True
    return out


def _exposure(found: Comparison) -> compare.Balance | None:
    """Return the balance from the exposure of the older scene to that of the newest scene; None if it is negligible."""
    greys = np.tile(np.array([[0.1], [0.5], [0.9]]), 3)
    off = np.log(np.maximum(found.balance.applied(greys), 1e-3) / greys)
    return found.balance if np.abs(off).max() > _NEGLIGIBLE_GAIN else None


def _exposed(gaussians: Gaussians, exposure: compare.Balance | None) -> Gaussians:
    return gaussians if exposure is None else apply_balance(gaussians, exposure)


def _remaining(scene: PosedScene, stays: np.ndarray, exposure: compare.Balance | None) -> PosedScene:
    if stays.all() and exposure is None:
        return scene
    # Earlier renders of the scene's views show the removed Gaussians.
    return replace(scene, reference_views=None, gaussians=_exposed(scene.gaussians[stays], exposure))


def _in_one_exposure(views: CaptureViews, exposure: compare.Balance | None) -> CaptureViews:
    return replace(views, scene=_remaining(views.scene, np.ones(len(views.gaussians), dtype=bool), exposure))


def _in_grey(gaussians: Gaussians, value: float) -> Gaussians:
    """Return the Gaussians with one grey value in [0, 1], independent of the viewing direction."""
    return replace(gaussians, sh=sh0_of_rgb(np.full((len(gaussians), 1, 3), value, np.float32)))


def _empty(scene: PosedScene) -> Gaussians:
    return scene.gaussians[np.zeros(0, dtype=np.int64)]


def _by_date(scenes: Sequence[PosedScene]) -> list[list[int]]:
    """Group the indices of dated scenes by date, newest first; return nothing if all have one date."""
    times = {i: _time(scene.captured_at) for i, scene in enumerate(scenes)}
    dated = {i: time for i, time in times.items() if time is not None}
    groups = [[i for i, then in dated.items() if then == time] for time in sorted(set(dated.values()), reverse=True)]
    return groups if len(groups) > 1 else []


def newest_first(scenes: Sequence[PosedScene]) -> list[int]:
    """Return the indices of all scenes, newest first; undated scenes come last, in their given order."""
    times = [_time(scene.captured_at) for scene in scenes]
    return sorted(range(len(scenes)), key=lambda i: (-t.timestamp() if (t := times[i]) else np.inf, i))


def _time(text: str | None) -> datetime | None:
    if not text:
        return None
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)
