"""Write HTML and SVG as elements, so that text of a map cannot become markup.

Names, notes and reasons of a map are untrusted. All text passes `text_markup`, which escapes control and bidirectional
characters (line feeds stay) and quotes HTML's special characters. Only `Markup` enters a page unchanged: elements that
this module creates, and scripts and style sheets of this package.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
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
    """Escape a text so that a page shows it literally."""
    return Markup(html.escape(escaped(str(text), lines=True), quote=True))


def joined(*parts: Part | Iterable[Part]) -> Markup:
    """Concatenate parts, skipping None."""
    return Markup("".join(_html(parts)))


def tag(name: str, /, *parts: Part | Iterable[Part], **attributes: object) -> Markup:
    """Create an element. In attribute names ``_`` becomes ``-``, and a trailing ``_`` and None values are dropped.

    Pass attributes that make a browser load or run something only with constant values of this package.
    """
    text = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{text_markup(value).html}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{text}>")
    return Markup(f"<{name}{text}>{''.join(_html(parts))}</{name}>")


def policy_text(policy: Mapping[str, str]) -> str:
    """Return a Content-Security-Policy with these directives."""
    return "; ".join(f"{name} {value}" for name, value in policy.items())


def policy_meta(policy: Mapping[str, str]) -> Markup:
    """Return the element that gives a page its Content-Security-Policy."""
    return tag("meta", http_equiv="Content-Security-Policy", content=policy_text(policy))


def source_of(text: str) -> str:
    """Return the source by which a Content-Security-Policy allows a script or style sheet."""
    import base64
    import hashlib

    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


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
