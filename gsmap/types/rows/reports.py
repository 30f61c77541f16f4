"""Written report pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class WrittenReport(Row):
    """A written report page.

    Args:
        path: file of the page.
        num_bytes: size of the page.
        standing: ``good``, ``look`` (something needs a review), ``act`` (the map is out of date, or work failed) or
            ``empty``.
        verdict: summary in a few sentences, as on the page.
        sections: ids of its sections, in order.
        num_pictures: number of images of pairs and changes.
        notes: omitted content, with the reason.
    """

    columns: ClassVar[Mapping[str, str]] = {"path": "page", "num_bytes": "bytes", "standing": "standing"}

    path: str
    num_bytes: int
    standing: str
    verdict: str
    sections: tuple[str, ...]
    num_pictures: int
    notes: tuple[str, ...] = ()
