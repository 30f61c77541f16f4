"""Reports that were written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class WrittenReport(Row):
    """A page about the map that was written.

    Args:
        path: the file.
        num_bytes: of it.
        standing: ``good``, ``look`` (something wants a person's judgement), ``act`` (the map is not solved as it is, or
            work failed) or ``empty``.
        verdict: the same in a few sentences, as the page says it.
        sections: ids of the sections that it has, in order.
        num_pictures: pictures of pairs and changes in it.
        notes: what could not be shown, and why.
    """

    columns: ClassVar[Mapping[str, str]] = {"path": "page", "num_bytes": "bytes", "standing": "standing"}

    path: str
    num_bytes: int
    standing: str
    verdict: str
    sections: tuple[str, ...]
    num_pictures: int
    notes: tuple[str, ...] = ()
