"""Mixtures of survey data on made sites: wrong ties, ties lost by adding observations, reasons named.

    python -m tools.bench.survey_groups [--seeds 100] [--first 0] [--only NAME]

Sites are 6 to 600 m wide, at altitudes of 5 to 1,609 m, of 4 or 9 captures. Seeds take the mixtures in turn: first the
observations before `+`, then those after it are added. A tie is wrong where it is off by more than five of its own
standard deviations; with correct control points, where it is off by more than 10 cm. A tie is lost where the first
observations tie the map rightly and all together do not; where equal groups contradict each other no tie is right.
Hidden are mixtures whose common error is below five standard deviations of what the observations state: no reason need
be named, and without control points nothing can tell which group is right.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.optimize import optimize
from gsmap.types.world import LOCAL, ControlPoint, Georeference, ImagePoint, PositionFix, ScaleBar, Survey, WorldFrame
from gsmap_synthetic.surveyed import Site, SiteParams, surveyed_site
from tools.harness import argument_parser

FEET = 0.3048
PHONE = ((1.5, 3.0), (3.0, 6.0), 40.0)
RTK = ((0.02, 0.04), (0.02, 0.04), 0.0)
Sigmas = tuple[tuple[float, float], tuple[float, float], float]


@dataclass(frozen=True, eq=False)
class Made:
    """A made site and the random numbers of its observations."""

    site: Site
    rng: np.random.Generator

    @property
    def height_m(self) -> float:
        return self.site.frame.height_m

    def points(self, change: Callable[[np.ndarray], np.ndarray] | None = None, keep: int | None = None) -> Survey:
        """Control points of 1 cm, altitudes changed by a function of (N, 3) positions."""
        marks = self.site.marks[:keep]
        at = np.array([m.true_m for m in marks]) + self.rng.normal(size=(len(marks), 3)) * 0.01
        at = at if change is None else change(at)
        row = {name: k for k, name in enumerate(self.site.names)}
        images = []
        for mark in marks:
            cameras = self.site.cameras[row[mark.scene]]
            for photo, pixel in mark.pixels.items():
                k = cameras.names.index(photo)
                pose, intrinsics = cameras.T_frame_camera[k], cameras.intrinsics_px[k]
                images.append(ImagePoint(mark.name, photo, mark.scene, np.array(pixel), 0.5, pose, intrinsics))
        points = [ControlPoint(m.name, LOCAL, p, (0.01, 0.01)) for m, p in zip(marks, at, strict=True)]
        return Survey(self.site.frame, tuple(points), tuple(images))

    def photos(
        self,
        sigmas: Sigmas,
        change: Callable[[np.ndarray], np.ndarray] | None = None,
        captures: Sequence[int] | None = None,
        noise: float = 1.0,
        drift: float = 0.0,
    ) -> Survey:
        """Positions of photos with the errors that their sigmas state, positions changed by a function."""
        own, common, sea = (np.array(one) for one in sigmas)
        # What counts from take-off counts from no sea level.
        level = np.clip(self.rng.normal() * sea, -2 * sea, 2 * sea) * noise * (change != self.takeoff)
        fixes = []
        for k in range(len(self.site.names)) if captures is None else captures:
            cameras, S = self.site.cameras[k], self.site.truth[k]
            at = S.apply(cameras.centers)
            at = at + noise * self.rng.normal(size=at.shape) * own[[0, 0, 1]]
            at = at + noise * self.rng.normal(size=3) * common[[0, 0, 1]] + [0, 0, level]
            at += np.outer(np.linspace(-0.5, 0.5, len(at)), self.rng.normal(size=3) * common[[0, 0, 1]] * drift)
            at = at if change is None else change(at)
            fixes += [
                PositionFix(name, self.site.names[k], centre, LOCAL, p, tuple(own), tuple(common), float(sea))
                for name, centre, p in zip(cameras.names, cameras.centers, at, strict=True)
            ]
        return Survey(self.site.frame, fixes=tuple(fixes))

    def scenes(
        self, sigma_m: float, shift: Sequence[float] = (0, 0, 0), captures: Sequence[int] | None = None
    ) -> Survey:
        """Surveyed origins of scenes."""
        chosen = range(len(self.site.names)) if captures is None else captures
        fixes = []
        for k in chosen:
            at = self.site.truth[k].translation + self.rng.normal(size=3) * sigma_m + shift
            fixes.append(PositionFix("survey", self.site.names[k], np.zeros(3), LOCAL, at, (sigma_m, sigma_m)))
        return Survey(self.site.frame, fixes=tuple(fixes))

    def bars(self, factor: float = 1.0) -> Survey:
        """Lengths between captures, in another unit by a factor."""
        n, out = len(self.site.names), []
        for k in (1, 2, 3):
            length = float(np.linalg.norm(self.site.truth[0].translation - self.site.truth[k].translation))
            sigma = 0.002 * length * factor
            measured = length * factor + self.rng.normal() * sigma
            ends = (self.site.names[0], self.site.names[k % n])
            out.append(ScaleBar(f"bar {k}", ends, np.zeros((2, 3)), (1e-3, 1e-3), measured, sigma))
        return Survey(self.site.frame, bars=tuple(out))

    # Changes of positions.

    def feet(self, at: np.ndarray) -> np.ndarray:
        """Altitudes in feet taken for metres."""
        return at + np.outer(at[:, 2] + self.height_m, [0, 0, 1 / FEET - 1])

    def takeoff(self, at: np.ndarray) -> np.ndarray:
        """Altitudes above where the drone took off, on the ground of the site."""
        return at - [0, 0, self.height_m + self.takeoff_m]

    @property
    def takeoff_m(self) -> float:
        return float(np.median([m.true_m[2] for m in self.site.marks]))

    def zero(self, at: np.ndarray) -> np.ndarray:
        """Altitudes of 0."""
        return np.c_[at[:, :2], np.full(len(at), -self.height_m) - (at[:, :2] ** 2).sum(1) / (2 * 6_371_000)]

    def geoid(self) -> Callable[[np.ndarray], np.ndarray]:
        """Heights above the other surface."""
        off = self.rng.choice([-1, 1]) * self.rng.uniform(15, 80)
        return lambda at: at + np.array([0, 0, off])

    def aside(self) -> Callable[[np.ndarray], np.ndarray]:
        """Another horizontal datum."""
        turn = self.rng.uniform(0, 2 * np.pi)
        return lambda at: at + 100.0 * np.array([np.cos(turn), np.sin(turn), 0])

    def elsewhere(self, at: np.ndarray) -> np.ndarray:
        """Positions of another flight with the same names."""
        return self.rng.permutation(at * [3, 3, 1] + self.rng.normal(size=at.shape) * [40, 40, 5] + [60, -40, 0])


def both(*some: Survey) -> Survey:
    """All observations together."""
    return Survey(
        some[0].frame,
        tuple(p for s in some for p in s.points),
        tuple(i for s in some for i in s.images),
        tuple(f for s in some for f in s.fixes),
        tuple(b for s in some for b in s.bars),
    )


@dataclass(frozen=True)
class Mixture:
    """First and added observations of a made site.

    Args:
        make: them. cause: that a contradiction must name; empty where there is none.
        near: whether a tie must be within 10 cm. tied: whether the map must be tied; None where either is right.
    """

    make: Callable[[Made], tuple[Survey, Survey]]
    cause: str = ""
    near: bool = True
    tied: bool | None = True


def _halves(m: Made) -> tuple[list[int], list[int]]:
    order = m.rng.permutation(len(m.site.names)).tolist()
    return order[: len(order) // 2], order[len(order) // 2 : 2 * (len(order) // 2)]


def _equal_photos(m: Made) -> tuple[Survey, Survey]:
    a, b = _halves(m)
    return m.photos(RTK, captures=a), m.photos(RTK, m.geoid(), captures=b)


def _equal_scenes(m: Made) -> tuple[Survey, Survey]:
    a, b = _halves(m)
    noise = float(10 ** m.rng.uniform(-2.5, -0.3))
    shift = (m.rng.normal(size=3) * 40 * noise + 20 * noise).tolist()
    return m.scenes(noise, captures=a), m.scenes(noise, shift, captures=b)


def _one_capture(m: Made, change: Callable[[np.ndarray], np.ndarray]) -> tuple[Survey, Survey]:
    last = len(m.site.names) - 1
    return m.photos(RTK, captures=range(last)), m.photos(RTK, change, captures=[last])


def _corners(m: Made, sigmas: Sigmas, change: Callable[[np.ndarray], np.ndarray]) -> tuple[Survey, Survey]:
    corners = [0, 1, 2, 3] if len(m.site.names) == 4 else [0, 2, 6, 8]
    return m.photos(sigmas, captures=corners[:3]), m.photos(sigmas, change, captures=corners[3:])


def _scattered(m: Made, times: float) -> Survey:
    """Control points with errors of so many times the standard deviation that they state."""
    whole = m.points()
    errors = m.rng.normal(size=(len(whole.points), 3)) * 0.01 * times
    points = [replace(one, position=one.position + off) for one, off in zip(whole.points, errors, strict=True)]
    return replace(whole, points=tuple(points))


def _half_points(m: Made) -> tuple[Survey, Survey]:
    whole, moved = m.points(), m.points(m.geoid())
    half = len(whole.points) // 2
    return replace(whole, points=whole.points[half:]), replace(moved, points=moved.points[:half])


def _blundered(m: Made) -> Survey:
    whole = m.points()
    k = int(m.rng.integers(len(whole.points)))
    off = m.rng.normal(size=3)
    bad = replace(whole.points[k], position=whole.points[k].position + 20 * off / np.linalg.norm(off))
    return replace(whole, points=(*whole.points[:k], bad, *whole.points[k + 1 :]))


SURE: Sigmas = ((0.03, 0.03), (0.0, 0.0), 0.0)

MIXTURES = {
    "points + phones": Mixture(lambda m: (m.points(), m.photos(PHONE))),
    "points + phones that drift": Mixture(lambda m: (m.points(), m.photos(PHONE, drift=0.5))),
    "points + exact photos": Mixture(lambda m: (m.points(), m.photos(PHONE, noise=0.0))),
    "points + RTK": Mixture(lambda m: (m.points(), m.photos(RTK))),
    "points + phones at altitude 0": Mixture(lambda m: (m.points(), m.photos(PHONE, m.zero)), "altitude_zero"),
    "points + phones above take-off": Mixture(lambda m: (m.points(), m.photos(PHONE, m.takeoff)), "above_takeoff"),
    "points + RTK above take-off": Mixture(lambda m: (m.points(), m.photos(RTK, m.takeoff)), "above_takeoff"),
    "points + phones in feet": Mixture(lambda m: (m.points(), m.photos(PHONE, m.feet)), "feet"),
    "points + RTK in feet": Mixture(lambda m: (m.points(), m.photos(RTK, m.feet)), "feet"),
    "points + RTK of another height system": Mixture(lambda m: (m.points(), m.photos(RTK, m.geoid())), "height_system"),
    "points + RTK of another datum": Mixture(lambda m: (m.points(), m.photos(RTK, m.aside())), "horizontal_shift"),
    "points + RTK of another flight": Mixture(lambda m: (m.points(), m.photos(RTK, m.elsewhere)), "shape"),
    "points + scenes": Mixture(lambda m: (m.points(), m.scenes(0.3))),
    "points + scenes of another height system": Mixture(
        lambda m: (m.points(), m.scenes(0.1, m.geoid()(np.zeros(3)).tolist())), "height_system"
    ),
    "points + bars": Mixture(lambda m: (m.points(), m.bars())),
    "points + bars in feet": Mixture(lambda m: (m.points(), m.bars(1 / FEET)), "feet"),
    "phones + points": Mixture(lambda m: (m.photos(PHONE), m.points())),
    "RTK + points": Mixture(lambda m: (m.photos(RTK), m.points())),
    "RTK + two points": Mixture(lambda m: (m.photos(RTK), m.points(keep=2)), near=False),
    "RTK + points in feet": Mixture(lambda m: (m.photos(RTK), m.points(m.feet)), "feet", near=False),
    "RTK + one capture of another height system": Mixture(
        lambda m: _one_capture(m, m.geoid()), "height_system", near=False
    ),
    "scenes + phones above take-off": Mixture(
        lambda m: (m.scenes(0.1), m.photos(PHONE, m.takeoff)), "above_takeoff", near=False, tied=None
    ),
    "points + scenes + RTK of another height system": Mixture(
        lambda m: (both(m.points(), m.scenes(0.1)), m.photos(RTK, m.geoid())), "height_system"
    ),
    "points + RTK without a stated common error, of another height system": Mixture(
        lambda m: (m.points(), m.photos(SURE, m.geoid())), "height_system"
    ),
    "points + phones of one capture": Mixture(lambda m: (m.points(), m.photos(PHONE, captures=[0]))),
    "points, one wrong + phones": Mixture(lambda m: (_blundered(m), m.photos(PHONE))),
    "points, one wrong + phones above take-off": Mixture(
        lambda m: (_blundered(m), m.photos(PHONE, m.takeoff)), "above_takeoff"
    ),
    "points of 5 times the stated error + phones": Mixture(
        lambda m: (_scattered(m, 5), m.photos(PHONE)), near=False, tied=None
    ),
    "points of 30 times the stated error + phones": Mixture(
        lambda m: (_scattered(m, 30), m.photos(PHONE)), near=False, tied=None
    ),
    "three points + phones": Mixture(lambda m: (m.points(keep=3), m.photos(PHONE))),
    "three points + RTK in feet": Mixture(lambda m: (m.points(keep=3), m.photos(RTK, m.feet)), "feet"),
    "phones + points in feet": Mixture(lambda m: (m.photos(PHONE), m.points(m.feet)), "feet", near=False),
    "phones + one capture above take-off": Mixture(
        lambda m: _corners(m, PHONE, m.takeoff), "above_takeoff", near=False
    ),
    "phones + bars": Mixture(lambda m: (m.photos(PHONE), m.bars()), near=False),
    "half of points + half of another height system": Mixture(_half_points, "split", near=False, tied=False),
    "half of RTK + half of another height system": Mixture(_equal_photos, "split", near=False, tied=False),
    "half of scenes + half elsewhere": Mixture(_equal_scenes, "split", near=False, tied=False),
}


def made(seed: int) -> Made:
    """A site, the same for the same seed."""
    rng = np.random.default_rng(seed)
    side = int(rng.choice([2, 3]))
    wide = float(np.exp(rng.uniform(np.log(6), np.log(600))))
    frame = WorldFrame("EPSG:25832", 48.137, 11.575, float(rng.choice([5.0, 60.0, 250.0, 520.0, 1609.0])))
    params = SiteParams(
        rows=side, columns=side, spacing_m=wide / (side - 1), cross_every=1, num_control=side + 2, num_check=0
    )
    return Made(surveyed_site(seed, params, frame), rng)


def solved(site: Site, survey: Survey) -> tuple[Georeference, float, float]:
    """The tie, how far off it has the first capture's origin, and the standard deviation of that, m."""
    answer = optimize(site.names, site.edges, survey=survey)
    tie = answer.world[0]
    if tie.S_world_map is None or tie.covariance is None:
        return tie, np.nan, np.nan
    S = tie.S_world_map @ answer.poses[site.names[0]].S_map_scene
    sigma = float(np.sqrt(np.trace(tie.covariance[3:6, 3:6])) * tie.S_world_map.scale)
    return tie, float(np.linalg.norm(S.translation - site.truth[0].translation)), sigma


@dataclass
class Tally:
    """Counts of one mixture."""

    count: int = 0
    tied: int = 0
    wrong: int = 0
    lost: int = 0
    beyond: int = 0
    hidden: int = 0
    named: int = 0
    first: int = 0
    unsaid: int = 0


def is_beyond(m: Made, first: Survey, added: Survey) -> bool:
    """Whether the common error of what was added is more than five standard deviations of what both state."""
    truth = {
        (n, k): S.apply(c.centers)[j]
        for n, S, c in zip(m.site.names, m.site.truth, m.site.cameras, strict=True)
        for j, k in enumerate(c.names)
    }
    marks = {one.name: one.true_m for one in m.site.marks}
    off = [f.position - truth[f.scene, f.name] for f in added.fixes if (f.scene, f.name) in truth]
    off += [p.position - marks[p.name] for p in added.points]
    fixes = [*first.fixes, *added.fixes]
    if not off or not fixes:
        return True
    bars = [np.hypot(np.hypot(f.sigma_m, f.common_sigma_m), [0, f.sea_level_sigma_m]) for f in fixes]
    middle, bar = np.abs(np.median(off, axis=0)), 5 * np.max(bars, axis=0)
    return bool(middle[:2].max() > bar[0] or middle[2] > bar[1])


def run(name: str, mixture: Mixture, seed: int, tally: Tally, *, verbose: bool = False) -> None:
    """One mixture on one site."""
    m = made(seed)
    m = replace(m, rng=np.random.default_rng([seed, len(name)]))
    first, added = mixture.make(m)
    before, off_before, sigma_before = solved(m.site, first)
    tie, off, sigma = solved(m.site, both(first, added))
    tied = tie.S_world_map is not None
    beyond = bool(mixture.cause) and is_beyond(m, first, added)
    hidden = bool(mixture.cause) and not beyond
    tally.hidden += hidden
    if hidden and not mixture.near:  # nothing can tell which group is right
        return
    near = mixture.near and all(len(one.points) != 2 for one in (first, added))
    wrong = tied and (off > 5 * sigma + 0.005 or (near and off > 0.1) or mixture.tied is False)
    right_before = before.S_world_map is not None and off_before <= 5 * sigma_before + 0.005
    lost = mixture.tied is not False and right_before and not tied
    tally.count += 1
    tally.tied += tied
    tally.wrong += bool(wrong)
    tally.lost += bool(lost)
    causes = [one.cause for one in tie.contradictions]
    listed = [*causes, *(cause for one in tie.contradictions for cause in one.other_causes)]
    tally.beyond += beyond
    tally.named += beyond and mixture.cause in listed
    tally.first += beyond and mixture.cause in causes
    tally.unsaid += not mixture.cause and bool(causes)
    if verbose and (wrong or lost or (beyond and mixture.cause not in listed) or (not mixture.cause and causes)):
        print(
            f"  {name}, seed {seed} ({len(m.site.names)} captures, {m.site.frame.height_m:g} m up): "
            f"{'wrong' if wrong else ''} {'lost' if lost else ''} off {off:.3g} +- {sigma:.3g} "
            f"(before {off_before:.3g} +- {sigma_before:.3g}), {causes} of {listed}; "
            f"{tie.problem} {[one.text for one in tie.contradictions]}"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--each", type=int, default=3, help="mixtures on each site")
    parser.add_argument("--only", help="a part of a mixture's name")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args(arguments)
    names = [name for name in MIXTURES if options.only is None or options.only in name]
    tallies = {name: Tally() for name in names}
    start = time.process_time()
    for k in range(options.seeds):
        for j in range(min(options.each, len(names))):
            name = names[(k * options.each + j) % len(names)]
            run(name, MIXTURES[name], options.first + k, tallies[name], verbose=options.verbose)
    print(
        f"{'mixture':70} {'n':>4} {'tied':>5} {'wrong':>6} {'lost':>5} {'contradict':>10} {'named':>6} {'first':>6} "
        f"{'false':>6} {'hidden':>7}"
    )
    total: Counter[str] = Counter()
    for name, t in tallies.items():
        total.update(vars(t))
        print(
            f"{name:70} {t.count:4} {t.tied:5} {t.wrong:6} {t.lost:5} {t.beyond:10} {t.named:6} "
            f"{t.first:6} {t.unsaid:6} {t.hidden:7}"
        )
    share = 100 * total["named"] / max(1, total["beyond"])
    leading = 100 * total["first"] / max(1, total["beyond"])
    print(
        f"{total['count']} mixtures on {options.seeds} sites: {total['wrong']} wrong ties, {total['lost']} ties "
        f"lost by adding observations, reason among those named in {share:.1f} % of {total['beyond']} "
        f"contradictions "
        f"(first in {leading:.1f} %), {total['unsaid']} contradictions where there are none; "
        f"{time.process_time() - start:.0f} CPU s"
    )
    return int(total["wrong"] > 0 or total["lost"] > 0 or share < 95)


if __name__ == "__main__":
    raise SystemExit(main())
