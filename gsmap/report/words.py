"""Format numbers, dates and the state of a map for readers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, assert_never

from gsmap.report.content import EdgeEntry, Report
from gsmap.types.metric_scale import KnownBy, MetricScale
from gsmap.types.rows.maps import TodoKind

_SHOWN = 3  # maximum number of names in a sentence


def count(number: int, one: str, many: str = "") -> str:
    """Format a number with its noun: ``1 scene``, ``2,000 scenes``."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def number(value: float | None, digits: int = 3) -> str:
    """Format a number with significant digits; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    return f"{value:.{digits}g}" if 1e-4 <= abs(value) < 10**digits else _large_or_small(value, digits)


def _large_or_small(value: float, digits: int) -> str:
    return f"{value:,.0f}" if 1 <= abs(value) < 1e9 else f"{value:.{digits - 1}e}"


def length(metres: float | None) -> str:
    """Format a length in millimetres (below 0.1 m), metres or kilometres."""
    if metres is None or not math.isfinite(metres):
        return "–"
    size_m = abs(metres)
    if size_m == 0:
        return "0"
    if size_m < 5e-5:
        return "< 0.1 mm"
    if size_m < 0.1:
        return f"{_two(metres * 1e3)} mm"
    return f"{number(metres)} m" if size_m < 2e3 else f"{number(metres / 1e3)} km"


def _two(value: float) -> str:
    """Format a number with two significant digits, or as an integer."""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}".removesuffix(".0")


def angle(degrees: float | None) -> str:
    """Format an angle in degrees."""
    if degrees is None or not math.isfinite(degrees):
        return "–"
    return f"{degrees:.2g}°" if degrees == 0 or abs(degrees) >= 1e-3 else "< 0.001°"


def chi_square(value: float | None) -> str:
    """Format a chi-square; for an edge in no cycle, whose chi-square is a rounding error, format 0."""
    return "0" if value is not None and abs(value) < NOT_PULLED else number(value)


def probability(value: float | None) -> str:
    """Format a probability with three digits, at most 0.999."""
    return "–" if value is None or not math.isfinite(value) else number(min(value, 0.999))


def size(num_bytes: int) -> str:
    """Format a size: ``12.3 MB``; a megabyte is a million bytes."""
    for power, unit in ((9, "GB"), (6, "MB"), (3, "kB")):
        if num_bytes >= 10**power:
            return f"{num_bytes / 10**power:.3g} {unit}"
    return f"{num_bytes} bytes"


def duration(seconds: float) -> str:
    """Format a duration: ``3.2 s``, ``4 min``, ``2.5 h``."""
    if seconds < 90:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.3g} min" if seconds < 5400 else f"{seconds / 3600:.3g} h"


def day(when: str | None) -> str:
    """Return the day of an ISO 8601 date; a dash if unknown."""
    return when[:10] if when else "–"


def moment(when: str | None) -> str:
    """Return an ISO 8601 date down to the minute; a dash if unknown."""
    return when[:16].replace("T", " ") if when else "–"


def some(names: Sequence[str]) -> str:
    """Join names to a list such as ``a, b, c and 4 more``."""
    if len(names) > _SHOWN:
        return f"{', '.join(names[:_SHOWN])} and {len(names) - _SHOWN} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""


def cut(name: str, most: int = 22) -> str:
    """Shorten a name for a drawing."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


def cut_pair(pair: tuple[str, str], most: int = 22) -> str:
    """Shorten two names for a drawing; keep their ends, where names mostly differ."""
    if sum(map(len, pair)) + 1 <= most:
        return ":".join(pair)
    half = (most - 1) // 2
    return ":".join(name if len(name) <= half else f"…{name[1 - half :]}" for name in pair)


def metre(one: MetricScale) -> str:
    """Describe how the metric scale is known."""
    how = _how(one.known_by)
    if not one.is_known or not math.isfinite(one.sigma):
        return how
    return (
        f"{how}, to {'a factor of ' + format(math.exp(one.sigma), '.2g') if one.sigma > 0.2 else _percent(one.sigma)}"
    )


def _how(known_by: KnownBy) -> str:
    match known_by:
        case "surveyed":
            return "lengths are measured by control points, position fixes or scale bars"
        case "measured":
            return "lengths are measured by captures in metres"
        case "told":
            return "lengths follow a metric scale that a person specified"
        case "assumed":
            return "lengths assume that the captures are in metres"
        case "guessed":
            return "lengths are estimated from the distances between cameras and surfaces"
        case "unknown":
            return "lengths have no known unit"
        case _:
            assert_never(known_by)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def verdict(report: Report) -> tuple[str, tuple[str, ...]]:
    """Return the state of a map (``good``, ``look``, ``act`` or ``empty``) and sentences that explain it.

    ``act``: the poses are missing or outdated, or a job failed. ``look``: something needs a review.
    """
    scenes, status = [entry.row for entry in report.scenes], report.status
    if not scenes:
        return "empty", ("This map is empty: no capture has been ingested yet.",)
    placed = [row.name for row in scenes if row.status == "placed"]
    tentative = [row.name for row in scenes if row.status == "tentative" and not row.one_pair]
    one_pair = [row.name for row in scenes if row.one_pair]
    alone = [row.name for row in scenes if row.status == "isolated"]
    if report.revision is None:
        return "act", (
            f"The map holds {count(len(scenes), 'scene')} without poses: poses were never solved.",
            *_next_step(report),
        )
    sentences = []
    tied = len({row.component for row in scenes if row.status in ("placed", "tentative")})
    if placed:
        parts = " in one component" if tied == 1 else f" in {tied:,} components, which share no frame" if tied else ""
        all_of = "All" if len(placed) == len(scenes) and len(scenes) > 1 else f"{len(placed):,} of"
        are = "is" if len(placed) == 1 else "are"
        sentences.append(
            f"{all_of} {count(len(scenes), 'scene')} {are} placed{parts}: a cycle of edges, a pose prior "
            "or a review confirms each pose."
        )
    else:
        sentences.append(f"The map holds {count(len(scenes), 'scene')}; no pose is confirmed by a cycle of edges.")
    sigmas = sorted(
        (entry.position_sigma_m, entry.row.name) for entry in report.scenes if entry.position_sigma_m is not None
    )
    sigmas = [one for one in sigmas if one[0] > 0]
    if sigmas:
        worst = sigmas[-1]
        sentences.append(
            f"Standard deviations of position have a median of {length(sigmas[len(sigmas) // 2][0])}; "
            f"the largest is {length(worst[0])} ({worst[1]})."
        )
    if report.islands:
        largest = report.islands[0]
        name = "" if len(report.islands) == 1 else "In the largest component, "
        text = metre(largest.metre)
        sentences.append(f"{name}{text}." if name else f"{text[0].upper()}{text[1:]}.")
    if tentative:
        rest = "rests" if len(tentative) == 1 else "rest"
        sentences.append(
            f"Doubtful: {some(tentative)} {rest} on edges that no cycle confirms; review them and confirm or reject."
        )
    if one_pair:
        sentences.append(
            f"Placed by one pair, which nothing contradicts: {some(one_pair)}; a capture that closes a loop, or a "
            "review, would confirm it."
        )
    undecided = [edge.row.pair for edge in report.edges if edge.use == "undecided"]
    if undecided:
        sentences.append(f"Contradictory: {some(undecided)}; a review has to decide.")
    if alone and len(scenes) > 1:
        sentences.append(f"Isolated: no edge connects {some(alone)} to other scenes.")
    behind = [row.name for row in scenes if row.status in ("ingested", "described")]
    if behind:
        has = "has" if len(behind) == 1 else "have"
        sentences.append(f"Not in the solution yet: {some(behind)} {has} no pose.")
    strain = strained(report.edges)
    if strain:
        sentences.append(
            f"Large residuals: {count(len(strain), 'used edge has a residual', 'used edges have residuals')} beyond "
            f"{'its' if len(strain) == 1 else 'their'} standard deviations ({some([e.row.pair for e in strain])})."
        )
    sentences += _next_step(report)
    wants = {_wants(row.what) for row in status.todo}
    if "act" in wants or behind:
        return "act", tuple(sentences)
    return ("look" if "look" in wants or tentative or undecided else "good"), tuple(sentences)


def _wants(what: TodoKind) -> Literal["act", "look"]:
    """Return ``act`` for a task of computation, ``look`` for a review by a person."""
    match what:
        case "undescribed" | "unregistered" | "unsolved" | "set_aside" | "contradicted_priors":
            return "act"
        case "stale_graphs" | "stale_edges" | "stale_poses" | "dirty_tiles" | "tentative" | "undecided" | "changes":
            return "look"
        case "world_outliers" | "untied" | "duplicates" | "isolated" | "one_pair":
            return "look"
        case _:
            assert_never(what)


def _next_step(report: Report) -> list[str]:
    if not report.status.todo:
        return ["Nothing to do."]
    first = report.status.todo[0]
    rest = len(report.status.todo) - 1
    more = f" {count(rest, 'more task is', 'more tasks are')} listed below." if rest else ""
    return [f"Next: {first.meaning} ({first.count:,}).{more}"]


def strained(edges: Sequence[EdgeEntry]) -> list[EdgeEntry]:
    """Return used edges with a chi-square above the 99.9 % quantile, largest first."""
    return sorted((edge for edge in edges if edge.kind == "strained"), key=lambda edge: -(edge.chi2 or 0.0))


NOT_PULLED = 1e-6
"""Largest chi-square of an edge that counts as not being in any cycle."""
