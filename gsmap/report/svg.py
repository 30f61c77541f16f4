"""Draw the axes, ticks and frames of plots as SVG, in units of the view box.

Colours and fonts are classes of ``style.css``, so that one drawing serves light and dark pages and print.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.markup import Markup, Part, tag

WIDTH = 470.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 14.0, 12.0, 40.0


@dataclass(frozen=True)
class Axis:
    """Axis of a plot.

    Args:
        low, high: Values at the ends.
        start, end: Positions of the ends in the drawing.
        log: Logarithmic scale.
    """

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, value: float) -> float:
        """Return the position of a value, clamped to the axis."""
        low, high, value = (math.log10(v) if self.log else v for v in (self.low, self.high, max(value, _least(self))))
        share = 0.0 if high <= low else (value - low) / (high - low)
        return self.start + min(1.0, max(0.0, share)) * (self.end - self.start)

    def ticks(self, most: int = 6) -> list[float]:
        """Return about ``most`` round values."""
        if self.log:
            low, high = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            every = max(1, -(-(high - low + 1) // most))
            return [10.0**k for k in range(low, high + 1, every)]
        span = self.high - self.low
        if span <= 0:
            return [self.low]
        raw = span / max(1, most - 1)
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(s * power for s in (1, 2, 5, 10) if s * power >= raw - 1e-12)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def _least(axis: Axis) -> float:
    return axis.low if axis.log else -math.inf


def log_axis(values: Sequence[float], start: float, end: float) -> Axis:
    """Return a logarithmic axis that contains all positive values and begins and ends at powers of ten."""
    found = np.array([v for v in values if np.isfinite(v) and v > 0] or [1.0])
    low, high = 10.0 ** np.floor(np.log10(found.min())), 10.0 ** np.ceil(np.log10(found.max()))
    return Axis(float(low), float(high if high > low else low * 10), start, end, log=True)


@dataclass(frozen=True)
class Frame:
    """Frame of a plot: a view of ``WIDTH`` by ``height`` with margins for labels.

    Args:
        height: Height of the view.
        left: Left margin for the labels of the y axis.
    """

    height: float = 260.0
    left: float = _LEFT

    @property
    def x_span(self) -> tuple[float, float]:
        return self.left, WIDTH - _RIGHT

    @property
    def y_span(self) -> tuple[float, float]:
        return self.height - _BOTTOM, _TOP


def plot(
    frame: Frame, x: Axis, y: Axis | None, labels: tuple[str, str], title: str, *parts: Part | Iterable[Part]
) -> Markup:
    """Draw a frame with grid, ticks and axis labels; ``title`` is for screen readers."""
    (left, right), (bottom, top) = frame.x_span, frame.y_span
    lines: list[Markup] = []
    for value in x.ticks():
        at = x.at(value)
        lines.append(line(at, top, at, bottom, "grid"))
        lines.append(label(at, bottom + 15, tick_text(value), "tick", anchor="middle"))
    for value in y.ticks(5) if y is not None else ():
        at = y.at(value) if y is not None else 0.0
        lines.append(line(left, at, right, at, "grid"))
        lines.append(label(left - 6, at + 4, tick_text(value), "tick", anchor="end"))
    lines.append(line(left, bottom, right, bottom, "axis"))
    lines.append(label((left + right) / 2, frame.height - 6, labels[0], "name", anchor="middle"))
    if labels[1]:
        middle = (top + bottom) / 2
        lines.append(
            tag("text", labels[1], x=f(14), y=f(middle), class_="name", text_anchor="middle",
                transform=f"rotate(-90 14 {f(middle)})")
        )  # fmt: skip
    return drawing(WIDTH, frame.height, title, lines, *parts)


def drawing(
    width: float,
    height: float,
    title: str,
    *parts: Part | Iterable[Part],
    class_: str = "plot",
    stretched: bool = False,
) -> Markup:
    """Return an SVG element that scales with the page.

    Args:
        width, height: Size of the view box.
        title: Title for screen readers.
        parts: Content.
        class_: Class of the style sheet.
        stretched: Fill the box without keeping the aspect ratio.
    """
    return tag(
        "svg", tag("title", title), *parts, viewBox=f"0 0 {f(width)} {f(height)}", class_=class_, role="img",
        xmlns="http://www.w3.org/2000/svg", preserveAspectRatio="none" if stretched else None,
    )  # fmt: skip


def line(x0: float, y0: float, x1: float, y1: float, class_: str, *parts: Part) -> Markup:
    return tag("line", *parts, x1=f(x0), y1=f(y0), x2=f(x1), y2=f(y1), class_=class_)


def label(x: float, y: float, text: str, class_: str, *, anchor: str | None = None) -> Markup:
    return tag("text", text, x=f(x), y=f(y), class_=class_, text_anchor=anchor)


def dot(x: float, y: float, radius: float, class_: str, tip: str = "") -> Markup:
    return tag("circle", tag("title", tip) if tip else None, cx=f(x), cy=f(y), r=f(radius), class_=class_)


def bar(x: float, y: float, width: float, height: float, class_: str, tip: str = "") -> Markup:
    return tag(
        "rect", tag("title", tip) if tip else None, x=f(x), y=f(y), width=f(max(width, 0.0)),
        height=f(max(height, 0.0)), class_=class_,
    )  # fmt: skip


def path(points: np.ndarray, class_: str, *, closed: bool = False) -> Markup:
    """Draw straight lines through (N, 2) points."""
    if len(points) == 0:
        return Markup("")
    data = "M" + "L".join(f"{f(x)} {f(y)}" for x, y in points) + "Z" * closed
    return tag("path", d=data, class_=class_)


def paths(lines: Sequence[np.ndarray], class_: str, *, closed: bool = True, tip: str = "") -> Markup:
    """Draw several lines as one element; closed lines are filled by the even-odd rule."""
    data = "".join("M" + "L".join(f"{f(x)} {f(y)}" for x, y in points) + "Z" * closed for points in lines)
    if not data:
        return Markup("")
    return tag("path", tag("title", tip) if tip else None, d=data, class_=class_, fill_rule="evenodd")


def marks(points: np.ndarray, class_: str, tip: str = "") -> Markup:
    """Draw a round mark at each point (N, 2), all in one element of zero-length lines with round ends."""
    data = "".join(f"M{f(x)} {f(y)}h0" for x, y in points)
    return tag("path", tag("title", tip) if tip else None, d=data, class_=class_) if data else Markup("")


def tick_text(value: float) -> str:
    """Format the number of a tick as short as possible."""
    if value == 0:
        return "0"
    return f"{value:g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")


def f(value: float) -> str:
    """Format a coordinate with one decimal."""
    return f"{value:.1f}".removesuffix(".0")
