"""Where captures disagree because the place changed: who is right, and whose pictures count there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from gsmap import compare
from gsmap.compare import GONE, HIDDEN, OTHER_IN_FRONT, REPAINTED, SAME, UNSEEN, CaptureViews, Comparison
from gsmap.geometry.neighbours import nearest_of
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.merge.exposure import apply_balance
from gsmap.merge.placed import overlapping, share_in_view
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PlacedScene

Prefer = Literal["newest", "best", "both"]
"""Who wins where captures disagree: the ``newest``, whoever saw it ``best``, or nobody, so that ``both`` show."""

LOOKING_M = 10.0
"""How far around a tile captures and cameras are read where they are compared."""

MIN_CAMERAS = 12
"""Cameras of each capture that are read at least for that, the nearest, wherever they stand."""

_SHOWS = 0.15  # share of a pixel from which on what is disputed shows in it
_NEAR_M = 0.25  # of what changed, within which shards of it are looked for
_NEGLIGIBLE_GAIN = 0.02
_INTRUDES = 0.15  # difference of colour, of [0, 1], by which a picture has become another


@dataclass(frozen=True, eq=False)
class Settled:
    """Captures after those that disagree have been told apart.

    Args:
        scenes: without the Gaussians that are overruled and in the newest's exposure, in the order they were given.
        lost: how many Gaussians each lost.
        changed: per scene (N,) bool, the Gaussians that stand where another capture was overruled: nothing of an older
            capture is left there to share the work with, so they stay as they are.
        behind: per scene (N,) bool, the Gaussians beside a change that lie behind what newer captures show: nobody
            disproved them, but how the place looks now is not told by them.
        rivals: per scene, what stands now where it is overruled; empty where it is not.
        losers: per scene, the Gaussians it lost.
    """

    scenes: list[PlacedScene]
    lost: list[int]
    changed: list[np.ndarray]
    behind: list[np.ndarray]
    rivals: list[Gaussians]
    losers: list[Gaussians]
    _flagged: dict[int, tuple[Gaussians, int]] = field(default_factory=dict)

    def overruled_pixels(self, scene: int, camera: Cameras, longest_side_px: int = 240) -> np.ndarray:
        """(H, W) bool, where a picture of a scene from a camera (1) shows what is not so, or does not show what is."""
        flagged, count = self._flagged_of(scene)
        width, height = (int(v) for v in camera.sizes_px[0])
        small = camera.resized(longest_side_px)
        if not count or not share_in_view(small, flagged.means[:count])[0]:
            return np.zeros((height, width), dtype=bool)
        shows = render(flagged, small, depth=False, dominant_id=False).colour[0, ..., 0] > _SHOWS
        # A Gaussian's skirts reach beyond the pixels in which it shows.
        shows = compare.dilate(shows)
        rows = ((np.arange(height) + 0.5) * shows.shape[0] / height).astype(int)
        columns = ((np.arange(width) + 0.5) * shows.shape[1] / width).astype(int)
        out: np.ndarray = shows[np.ix_(rows, columns)]
        return out

    def _flagged_of(self, scene: int) -> tuple[Gaussians, int]:
        """What is disputed of a scene, white, then the rest of it, black, and how many these are; kept for one scene,
        as pictures are asked for scene by scene."""
        if scene not in self._flagged:
            self._flagged.clear()
            disputed = Gaussians.concatenate([self.losers[scene], self.rivals[scene]])
            parts = [_in_grey(disputed, 1.0), _in_grey(self.scenes[scene].gaussians, 0.0)]
            self._flagged[scene] = Gaussians.concatenate(parts), len(disputed)
        return self._flagged[scene]

    def is_disputed(self, scene: int) -> bool:
        """Whether any picture of a scene may show what is not so, or not show what is."""
        return len(self.losers[scene]) + len(self.rivals[scene]) > 0

    def notes(self) -> list[str]:
        """Remarks on what was dropped."""
        return [
            f"{n} Gaussians of scene {s.scene_id[:12]} are overruled where the place changed"
            for s, n in zip(self.scenes, self.lost, strict=True)
            if n
        ]


def settle(
    scenes: Sequence[PlacedScene],
    prefer: Prefer = "newest",
    *,
    max_views: int = compare.MAX_VIEWS,
    one_exposure: bool = True,
) -> Settled:
    """Drop what captures of other dates disprove.

    From the newest capture back, each older one is compared once with what all newer ones are sure of together: N
    captures cost N comparisons. A Gaussian leaves where that looked through it, or shows its surface in another colour
    (exposure apart); with ``best`` only if it also saw the place better, and otherwise the newer's Gaussians leave.
    What no newer capture saw stays. Captures without a date, or of one date, overrule nothing.

    Args:
        one_exposure: bring all of it to the newest's exposure. Not of a piece of a map, whose neighbours would show the
            same capture in another one.
    """
    keeps = [np.ones(len(s.gaussians), dtype=bool) for s in scenes]
    changed, behind = ([np.zeros(len(s.gaussians), dtype=bool) for s in scenes] for _ in range(2))
    rivals = [_none(s) for s in scenes]
    exposures: list[compare.Balance | None] = [None] * len(scenes)
    truth: list[_Standing] = []
    groups = _by_date(scenes) if prefer != "both" else []
    for group in groups:
        added = []
        for i in group:
            looks = compare.render_views(scenes[i], max_views=max_views)
            parts = [one for one in truth if overlapping(one.looks.scene, scenes[i])]
            if not parts:
                added.append(_Standing(i, looks, np.ones(len(looks.gaussians), dtype=bool)))
                continue
            joined = compare.combine_views([(one.looks, one.shows) for one in parts], scenes[i], max_views)
            found = compare.compare(looks, joined)
            verdict = _verdict(looks, joined, found, prefer)
            exposures[i] = _exposure(found)
            keeps[i] &= ~verdict.lost
            if prefer == "newest":
                beside = _beside(looks.gaussians.means, joined, verdict)
                behind[i] = beside & (found.older.state == HIDDEN)
                exposed = _exposed(looks.gaussians, exposures[i])
                keeps[i] &= ~_intruders(exposed, keeps[i] & beside, joined)
            first = 0
            for one in parts:
                rows = np.flatnonzero(one.shows)
                mine = slice(first, first + len(rows))
                changed[one.scene][rows[verdict.changed[mine]]] = True
                keeps[one.scene][rows[verdict.beaten[mine]]] = False
                one.shows[rows[verdict.beaten[mine]]] = False
                first += len(rows)
            rivals[i] = Gaussians.concatenate([rivals[i], joined.gaussians[verdict.changed]])
            if group is groups[-1]:
                continue  # Nothing is compared with the oldest.
            # Truth grows by what is new to it alone, so that it stays as large as the place.
            shows = keeps[i] & looks.surface & np.isin(found.older.state, (UNSEEN, HIDDEN))
            added.append(
                _Standing(i, _in_one_exposure(compare.mask_outdated(looks, found, keeps[i]), exposures[i]), shows)
            )
        truth += added
    return Settled(
        [_left(s, k, e if one_exposure else None) for s, k, e in zip(scenes, keeps, exposures, strict=True)],
        [int((~k).sum()) for k in keeps],
        [c[k] for c, k in zip(changed, keeps, strict=True)],
        [b[k] for b, k in zip(behind, keeps, strict=True)],
        rivals,
        [s.gaussians[~k] for s, k in zip(scenes, keeps, strict=True)],
    )


@dataclass(frozen=True, eq=False)
class _Standing:
    """A capture among the newer ones: which, its looks, and (N,) which of its Gaussians add to what is shown."""

    scene: int
    looks: CaptureViews
    shows: np.ndarray


@dataclass(frozen=True, eq=False)
class _Verdict:
    """(N,) which Gaussians of the older leave, (M,) which of the newer stand where it changed, (M,) which leave."""

    lost: np.ndarray
    changed: np.ndarray
    beaten: np.ndarray


def _verdict(older: CaptureViews, newer: CaptureViews, found: Comparison, prefer: Prefer) -> _Verdict:
    lost = np.isin(found.older.state, (GONE, REPAINTED))
    changed = np.isin(found.newer.state, (GONE, REPAINTED))
    changed |= (found.newer.state != SAME) & _revealed(newer, found)
    beaten = np.zeros(len(changed), dtype=bool)
    if prefer == "best":
        stays = lost & (older.sharpness > found.older.sharpness)
        beaten = np.isin(found.newer.state, (GONE, REPAINTED)) & (newer.sharpness < found.newer.sharpness)
        lost, changed = lost & ~stays, changed & ~beaten
    return _Verdict(lost, changed, beaten)


def _revealed(newer: CaptureViews, found: Comparison) -> np.ndarray:
    """(M,) which Gaussians of the newer show where the older had a thing before them."""
    count = len(newer.gaussians)
    shown, bared = np.zeros(count), np.zeros(count)
    for picture in found.newer_views:
        dominant = picture.own.dominant_id
        shown += np.bincount(dominant[dominant >= 0], minlength=count)
        bare = (picture.outcome == OTHER_IN_FRONT) & (dominant >= 0)
        bared += np.bincount(dominant[bare], minlength=count)
    out: np.ndarray = (bared >= 2) & (bared >= 0.2 * shown)
    return out


def _beside(older: np.ndarray, newer: CaptureViews, verdict: _Verdict) -> np.ndarray:
    """(N,) which of the older's Gaussians (N, 3) lie beside what left or what is new."""
    disputed = np.concatenate([older[verdict.lost], newer.gaussians.means[verdict.changed]])
    if not len(disputed):
        return np.zeros(len(older), dtype=bool)
    out: np.ndarray = np.isfinite(nearest_of(disputed, older, _NEAR_M)[0])
    return out


def _intruders(older: Gaussians, asked: np.ndarray, newer: CaptureViews) -> np.ndarray:
    """(N,) which of the older's Gaussians that are asked would show, in pictures of the newer, where these look
    otherwise.

    They are in the newer's exposure. A last look at what evidence of single Gaussians leaves beside a change: shards,
    and what is smaller than a pixel.
    """
    out = np.zeros(len(older), dtype=bool)
    rows = np.flatnonzero(asked)
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
    """What brings the older's colours to the newest's exposure, so that the place shows in one; None for nothing."""
    greys = np.tile(np.array([[0.1], [0.5], [0.9]]), 3)
    off = np.log(np.maximum(found.balance.applied(greys), 1e-3) / greys)
    return found.balance if np.abs(off).max() > _NEGLIGIBLE_GAIN else None


def _exposed(gaussians: Gaussians, exposure: compare.Balance | None) -> Gaussians:
    return gaussians if exposure is None else apply_balance(gaussians, exposure)


def _left(scene: PlacedScene, stays: np.ndarray, exposure: compare.Balance | None) -> PlacedScene:
    if stays.all() and exposure is None:
        return scene
    # Its views as they were rendered before show what is gone.
    return replace(scene, sights=None, gaussians=_exposed(scene.gaussians[stays], exposure))


def _in_one_exposure(looks: CaptureViews, exposure: compare.Balance | None) -> CaptureViews:
    return replace(looks, scene=_left(looks.scene, np.ones(len(looks.gaussians), dtype=bool), exposure))


def _in_grey(gaussians: Gaussians, value: float) -> Gaussians:
    """All of them in one grey, in [0, 1], from wherever they are seen."""
    return replace(gaussians, sh=sh0_of_rgb(np.full((len(gaussians), 1, 3), value, np.float32)))


def _none(scene: PlacedScene) -> Gaussians:
    return scene.gaussians[np.zeros(0, dtype=np.int64)]


def _by_date(scenes: Sequence[PlacedScene]) -> list[list[int]]:
    """Indices of the scenes that have a date and meet another, by date, newest first; those of one date together."""
    times = {i: _time(scene.captured_at) for i, scene in enumerate(scenes)}
    dated = {i: time for i, time in times.items() if time is not None}
    groups = [[i for i, then in dated.items() if then == time] for time in sorted(set(dated.values()), reverse=True)]
    return groups if len(groups) > 1 else []


def newest_first(scenes: Sequence[PlacedScene]) -> list[int]:
    """Indices of all scenes, the newest first; those without a date last, in their order."""
    times = [_time(scene.captured_at) for scene in scenes]
    return sorted(range(len(scenes)), key=lambda i: (-t.timestamp() if (t := times[i]) else np.inf, i))


def _time(text: str | None) -> datetime | None:
    if not text:
        return None
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)
