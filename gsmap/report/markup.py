"""HTML and SVG put together as elements, so that no text of a map can become markup.

A map's names, notes and reasons come from strangers. Every text passes `text_markup`: control characters and those that
turn the direction of writing are shown as escapes (a line feed is white space in HTML, and stays), and what HTML gives
a meaning is quoted. Only `Markup` goes into a page as it is, and only `tag`, `text_markup` and `joined` make it.
"""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass

from gsmap.texts import escaped

_VOID = {"meta", "img", "br", "link"}


@dataclass(frozen=True)
class Markup:
    """HTML that is safe to put into a page."""

    html: str

    def __bool__(self) -> bool:
        return bool(self.html)


Part = Markup | str | int | float | None


def text_markup(text: object) -> Markup:
    """A text that a page shows as it reads, whatever it holds."""
    return Markup(html.escape(escaped(str(text), lines=True), quote=True))


def joined(*parts: Part | Iterable[Part]) -> Markup:
    """Parts one after the other; None is nothing."""
    return Markup("".join(_html(parts)))


def tag(name: str, /, *parts: Part | Iterable[Part], **attributes: object) -> Markup:
    """An element. Of an attribute's name ``_`` is ``-`` and a ``_`` at its end is dropped; None leaves it out.

    An attribute that tells a browser to load or run something is for this room's own values only.
    """
    told = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{text_markup(value).html}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{told}>")
    return Markup(f"<{name}{told}>{''.join(_html(parts))}</{name}>")


def _html(parts: Iterable[Part | Iterable[Part]]) -> Iterable[str]:
    for part in parts:
        if part is None:
            continue
        if isinstance(part, Markup):
            yield part.html
        elif isinstance(part, str | int | float):
            yield text_markup(part).html
        else:
            yield from _html(part)
