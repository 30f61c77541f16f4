"""Draw the plots of a report in the style of evo: plain axes, and a tooltip for each value."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.markup import Markup, joined, tag
from gsmap.report import svg
from gsmap.report.content import CHI2_95, CHI2_999, CHI2_DOF, EdgeEntry, SceneEntry
from gsmap.report.svg import Axis, Frame
from gsmap.report.words import NOT_PULLED, cut, cut_pair, length, number
from gsmap.types.rows.revisions import RevisionRow

MAX_BARS = 24  # maximum number of bars in a plot
_ROW = 17.0
_NAMES, _CHARACTERS = 150.0, 19  # width of the column of names, in pixels and characters


def residual_bars(edges: Sequence[EdgeEntry]) -> Markup:
    """Plot the chi-square of each edge, largest first, with quantiles of the expected distribution."""
    chosen = sorted(pulled(edges), key=lambda e: -(e.chi2 or 0.0))[:MAX_BARS]
    values = [max(e.chi2 or 0.0, 1e-2) for e in chosen]
    frame = Frame(_ROW * len(chosen) + 62, _NAMES)
    x = svg.log_axis([0.1, 100.0, *values], *frame.x_span)
    parts = [_expected(frame, x)]
    for i, (edge, value) in enumerate(zip(chosen, values, strict=True)):
        y = frame.y_span[1] + _ROW * (i + 0.5)
        tip = f"{edge.row.pair}: chi2 {number(edge.chi2)}, off by {length(edge.translation_m)}"
        parts.append(svg.line(x.start, y, x.at(value), y, f"stem {edge.kind}"))
        parts.append(svg.dot(x.at(value), y, 4.5, f"mark {edge.kind}", tip))
        parts.append(svg.label(_NAMES - 6, y + 4, _ends(edge), "tick", anchor="end"))
    return svg.plot(frame, x, None, ("chi² of the residual (7 degrees of freedom)", ""), "Residual of each edge", parts)


def pulled(edges: Sequence[EdgeEntry]) -> list[EdgeEntry]:
    """Return the edges in cycles; only they have a residual."""
    return [edge for edge in edges if edge.chi2 is not None and edge.chi2 > NOT_PULLED]


def _ends(edge: EdgeEntry) -> str:
    return cut_pair((edge.row.target_name, edge.row.source_name), _CHARACTERS)


def _expected(frame: Frame, x: Axis) -> Markup:
    bottom, top = frame.y_span
    out = []
    for value, name in ((CHI2_95, "95 %"), (CHI2_999, "99.9 %")):
        at = x.at(value)
        out.append(svg.line(at, top, at, bottom, "limit", tag("title", f"{name} of correct edges lie below")))
    return joined(out)


def residual_distribution(edges: Sequence[EdgeEntry]) -> Markup:
    """Plot the distribution of the edges' chi-square beside the expected one."""
    from scipy.special import gammainc

    values = np.sort([e.chi2 for e in edges if e.chi2 is not None])
    frame = Frame()
    x, y = Axis(0.0, max(30.0, min(float(np.quantile(values, 0.98)), 200.0)), *frame.x_span), Axis(0, 1, *frame.y_span)
    along = np.linspace(0, x.high, 160)
    expected = [[x.at(v), y.at(float(gammainc(CHI2_DOF / 2, v / 2)))] for v in along]
    found = [[x.start, y.start]]
    for i, value in enumerate(values):
        if value > x.high:
            break
        found += [[x.at(value), y.at(i / len(values))], [x.at(value), y.at((i + 1) / len(values))]]
    found.append([x.end, found[-1][1]])
    parts = (svg.path(np.array(expected), "expected"), svg.path(np.array(found), "found"))
    words = ("chi² of the residual", "share of edges")
    return svg.plot(frame, x, y, words, "Residuals against expectation", parts)


def offset_bars(edges: Sequence[EdgeEntry]) -> Markup:
    """Plot the distance in metres between each edge's measurement and the poses, the largest first."""
    chosen = [e for e in pulled(edges) if e.translation_m is not None]
    chosen = sorted(chosen, key=lambda e: -(e.translation_m or 0.0))[:MAX_BARS]
    values = [max(e.translation_m or 0.0, 1e-5) for e in chosen]
    names = [_ends(e) for e in chosen]
    tips = [f"{e.row.pair}: {length(e.translation_m)}, {number(e.rotation_deg, 2)}°" for e in chosen]
    kinds = [e.kind for e in chosen]
    return _metre_bars(names, values, tips, kinds, "distance between edge and poses", "Residuals in metres")


def sigma_bars(scenes: Sequence[SceneEntry]) -> Markup:
    """Plot the standard deviation of each scene's position, largest first."""
    chosen = sorted((s for s in scenes if s.position_sigma_m), key=lambda s: -(s.position_sigma_m or 0.0))[:MAX_BARS]
    values = [s.position_sigma_m or 0.0 for s in chosen]
    names = [s.row.name for s in chosen]
    tips = [f"{s.row.name}: {length(s.position_sigma_m)}, {number(s.rotation_sigma_deg, 2)}°" for s in chosen]
    kinds = ["tentative" if s.row.status == "tentative" else "used" for s in chosen]
    return _metre_bars(names, values, tips, kinds, "standard deviation of position", "Position sigma of each scene")


def sigma_distribution(scenes: Sequence[SceneEntry]) -> Markup:
    """Plot the distribution of the scenes' standard deviations."""
    values = np.sort([s.position_sigma_m for s in scenes if s.position_sigma_m])
    unit, factor = _unit(values.tolist())
    frame = Frame()
    x, y = svg.log_axis((values * factor).tolist(), *frame.x_span), Axis(0, 1, *frame.y_span)
    found = [[x.start, y.start]]
    for i, value in enumerate(values * factor):
        found += [[x.at(value), y.at(i / len(values))], [x.at(value), y.at((i + 1) / len(values))]]
    found.append([x.end, y.end])
    words = (f"standard deviation of position, {unit}", "share of scenes")
    return svg.plot(frame, x, y, words, "Position sigma of all scenes", svg.path(np.array(found), "found"))


def _metre_bars(
    names: Sequence[str], values: Sequence[float], tips: Sequence[str], kinds: Sequence[str], axis: str, title: str
) -> Markup:
    unit, factor = _unit(values)
    frame = Frame(_ROW * len(values) + 62, _NAMES)
    x = svg.log_axis([v * factor for v in values], *frame.x_span)
    parts = []
    for i, (name, value, tip, kind) in enumerate(zip(names, values, tips, kinds, strict=True)):
        y = frame.y_span[1] + _ROW * (i + 0.5)
        parts.append(svg.line(x.start, y, x.at(value * factor), y, f"stem {kind}"))
        parts.append(svg.dot(x.at(value * factor), y, 4.5, f"mark {kind}", tip))
        parts.append(svg.label(_NAMES - 6, y + 4, cut(name, _CHARACTERS), "tick", anchor="end"))
    return svg.plot(frame, x, None, (f"{axis}, {unit}", ""), title, parts)


def _unit(values: Sequence[float]) -> tuple[str, float]:
    middle = float(np.median(values))
    return ("mm", 1e3) if middle < 0.01 else ("cm", 1e2) if middle < 1 else ("m", 1.0)


def growth(revisions: Sequence[RevisionRow]) -> Markup:
    """Plot the number of scenes and of edges by use over revisions."""
    frame = Frame(230)
    first, last = revisions[0].number, revisions[-1].number
    x = Axis(first - 0.5, last + 0.5, *frame.x_span)
    most = max(max(r.scenes, r.edges_used + r.edges_tentative, r.components) for r in revisions)
    y = Axis(0, max(1, most) * 1.05, *frame.y_span)
    parts = []
    for field, kind in (("scenes", "line-scenes"), ("edges_used", "line-used"), ("edges_tentative", "line-tentative")):
        points = np.array([[x.at(r.number), y.at(getattr(r, field))] for r in revisions])
        parts.append(svg.path(points, f"series {kind}"))
        words = field.replace("_", " ")
        parts += [
            svg.dot(px, py, 3, f"point {kind}", f"revision {r.number}: {getattr(r, field)} {words}")
            for r, (px, py) in zip(revisions, points, strict=True)
        ]
    return svg.plot(frame, x, y, ("revision", "count"), "Scenes and edges by revision", parts)


def stacked(parts: Sequence[tuple[str, float, str]], title: str) -> Markup:
    """Plot the parts of a whole, each (name, value, tooltip), as one stacked bar."""
    total, x, width = sum(value for _, value, _ in parts), 0.0, svg.WIDTH
    drawn = []
    for i, (_, value, tip) in enumerate(parts):
        wide = width * value / total if total else 0.0
        drawn.append(svg.bar(x, 0, wide, 26, f"share s{i % 8}", tip))
        x += wide
    return svg.drawing(width, 26, title, drawn, class_="stack", stretched=True)


def matrix(names: Sequence[str], cells: Sequence[tuple[int, int, str, str]], title: str) -> Markup:
    """Plot the outcome of each pair as a square in a matrix, below the diagonal.

    Args:
        names: Names of the scenes, in the order of rows and columns.
        cells: (row, column, kind, tooltip) of each pair, with row > column.
        title: Title of the plot.
    """
    count = len(names)
    room = 130.0 if count <= 40 else 8.0
    wide = (svg.WIDTH - room - 6) / max(count, 4)
    wide = min(wide, 30.0)
    gap = 0.12 * wide if count <= 60 else 0.0
    parts = [
        svg.bar(room + column * wide, 4 + row * wide, wide - gap, wide - gap, f"cell {kind}", tip)
        for row, column, kind, tip in cells
    ]
    for i, name in enumerate(names):
        parts.append(svg.bar(room + i * wide, 4 + i * wide, wide - gap, wide - gap, "cell self", name))
        if count <= 40:
            parts.append(svg.label(room - 6, 4 + i * wide + 0.68 * wide, cut(name, 18), "tick", anchor="end"))
    return svg.drawing(svg.WIDTH, count * wide + 8, title, parts)
