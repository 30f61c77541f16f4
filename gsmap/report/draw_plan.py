"""Draw a floor plan as SVG: top view, outlines, camera paths, edges by use, and error ellipses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gsmap.geometry.uncertainty import largest_sigma
from gsmap.markup import Markup, joined, tag
from gsmap.report import svg
from gsmap.report.plan import Plan
from gsmap.report.top import data_address
from gsmap.report.words import cut, length

_WIDTH = 900.0
_MOST_HEIGHT = 760.0
_FOOT = 34.0
_COLOURS = 8  # classes c0 to c7 of style.css
_MANY = 30  # number of scenes above which only doubtful scenes are labelled
_LINE_PX = 17.0
_CHARACTER_PX = 8.0
_JUMP, _STRIDE_M = 2.5, 1.0  # longest step of a path, in median steps and in metres
_QUANTILE_95 = 5.991  # 95 % quantile of chi-square with 2 degrees of freedom
_MAGNIFIED = tuple(step * 10**power for power in range(5) for step in (1, 2, 5))
_ELLIPSE_SHARE = 0.08  # usual maximum of the half axis of an ellipse, as a fraction of the plan diagonal


def draw_plan(plan: Plan, title: str) -> tuple[Markup, int]:
    """Draw a plan; return the drawing and the factor by which its error ellipses are magnified (0 without ellipses)."""
    low, high = plan.bounds
    span = high - low
    scale = min(_WIDTH / span[0], _MOST_HEIGHT / span[1])
    size = span * scale

    def at(points: np.ndarray) -> np.ndarray:
        return np.stack([(points[:, 0] - low[0]) * scale, (high[1] - points[:, 1]) * scale], axis=1)

    middles = at(plan.middles)
    magnified = _magnification(plan)
    parts: list[Markup] = []
    if plan.picture:
        parts.append(
            tag("image", href=data_address(plan.picture), x="0", y="0", width=svg.f(size[0]),
                height=svg.f(size[1]), preserveAspectRatio="none", class_=f"under {plan.picture_kind}")
        )  # fmt: skip
    order, crowded = list(range(len(plan.names))), len(plan.names) > _MANY
    for i in order:
        outlines = [at(ring) for ring in plan.footprints[i]]
        parts.append(svg.paths(outlines, f"foot {_colour(i)}", tip=plan.names[i]))
    for i in order:
        track = at(plan.tracks[i])
        steps = [track[k : k + 2] for k in _walked(plan.tracks[i])]
        parts.append(svg.paths(steps, f"walk {_colour(i)}", closed=False))
        parts.append(svg.marks(track, f"stand {_colour(i)}", plan.names[i]))
    for edge in sorted(plan.edges, key=lambda edge: _RANK.get(edge.use, 0)):
        (x0, y0), (x1, y1) = middles[edge.a], middles[edge.b]
        if edge.use != "unused":
            parts.append(svg.line(x0, y0, x1, y1, "edge-halo"))
        parts.append(svg.line(x0, y0, x1, y1, f"edge {edge.use}", tag("title", edge.tip)))
    for i in order:
        covariance = plan.covariances[i]
        if covariance is not None and magnified:
            outline = plan.middles[i] + magnified * ellipse(covariance)
            parts.append(svg.path(at(outline), "ellipse", closed=True))
        x, y = middles[i]
        parts.append(svg.dot(x, y, 3 if crowded else 5, f"node {plan.statuses[i]} {_colour(i)}", plan.names[i]))
    parts.append(_names(plan, middles, size))
    parts.append(_scale_bar(scale, size))
    parts.append(_axes(plan, size))
    return svg.drawing(size[0], size[1] + _FOOT, title, parts, class_="plan dense" if crowded else "plan"), magnified


def _walked(track: np.ndarray) -> np.ndarray:
    """Return the indices of cameras close to the next camera, so that gaps in the path stay open."""
    steps = np.linalg.norm(np.diff(track, axis=0), axis=1)
    walked = steps[steps > 0]
    found: np.ndarray = np.flatnonzero(steps <= min(_JUMP * (np.median(walked) if len(walked) else 0.0), _STRIDE_M))
    return found


_RANK = {"unused": 0, "used": 1, "strained": 2, "tentative": 3, "undecided": 4}


def _colour(index: int) -> str:
    return f"c{index % _COLOURS}"


def ellipse(covariance: np.ndarray) -> np.ndarray:
    """Return the 95 % confidence ellipse (N, 2) of a covariance (2, 2), around zero."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    found: np.ndarray = (vectors @ (np.sqrt(_QUANTILE_95 * np.maximum(values, 0))[:, None] * circle)).T
    return found


def _magnification(plan: Plan) -> int:
    """Choose a round factor at which most ellipses are visible, at least 1; 0 without ellipses."""
    largest = [largest_sigma(covariance) for covariance in plan.covariances if covariance is not None]
    known = [2.4477 * value for value in largest if value > 0]
    if not known:
        return 0
    room = _ELLIPSE_SHARE * float(np.linalg.norm(plan.bounds[1] - plan.bounds[0]))
    if len(plan.middles) > _MANY:  # so that neighbours' ellipses do not cover each other
        room = min(room, float(np.median(cKDTree(plan.middles).query(plan.middles, k=2)[0][:, 1])))
    fits = [factor for factor in _MAGNIFIED if factor * float(np.quantile(known, 0.9)) <= room]
    return fits[-1] if fits else 1


def _names(plan: Plan, middles: np.ndarray, size: np.ndarray) -> Markup:
    """Draw the names of scenes beside their dots, shifted up or down to avoid overlap."""
    taken: list[tuple[float, float, float]] = []
    out = []
    crowded = len(plan.names) > _MANY
    for i in np.lexsort((middles[:, 0], middles[:, 1])):
        if crowded and plan.statuses[i] == "placed":
            continue
        text = cut(plan.names[i])
        wide = _CHARACTER_PX * len(text)
        x = min(max(middles[i, 0] + 10, 4), max(size[0] - wide, 4))
        y = middles[i, 1] + 5
        shifts = sorted((k * _LINE_PX for k in range(-6, 7)), key=abs)
        y += next((s for s in shifts if _is_free(taken, x, y + s, wide, size)), 0.0)
        taken.append((x, y, wide))
        out.append(svg.label(x, y, text, "scene"))
    return joined(out)


def _is_free(taken: Sequence[tuple[float, float, float]], x: float, y: float, wide: float, size: np.ndarray) -> bool:
    if not 12 <= y <= size[1] - 4:
        return False
    return all(abs(y - other_y) >= _LINE_PX or x > other_x + w or other_x > x + wide for other_x, other_y, w in taken)


def _scale_bar(scale: float, size: np.ndarray) -> Markup:
    raw = 0.22 * size[0] / scale
    power = 10.0 ** np.floor(np.log10(raw))
    metres = float(next(s * power for s in (5, 2, 1) if s * power <= raw))
    x0, y = 8.0, size[1] + 18
    x1 = x0 + metres * scale
    return joined(
        svg.path(np.array([[x0, y - 5], [x0, y], [x1, y], [x1, y - 5]]), "ruler"),
        svg.label(x1 + 8, y + 1, length(metres), "ruler-text"),
    )


def _axes(plan: Plan, size: np.ndarray) -> Markup:
    """Return the directions on the page of those map axes that are parallel to the page."""
    x, y = size[0] - 48, size[1] + 8
    out = []
    for k, name in enumerate("xyz"):
        along = plan.R_plan_map[:2, k]
        if np.linalg.norm(along) > 0.3:
            tip = np.array([x, y]) + 18 * along * [1, -1]
            out += [svg.line(x, y, tip[0], tip[1], "ruler"), svg.label(tip[0] + 3, tip[1] + 4, name, "ruler-text")]
    return joined(out)
