"""The recorded Python API and JSON: nothing that a release has is missing or changed without a version number."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest

from tools.make.public_api import RECORD, breaks, surface


def test_nothing_public_is_broken() -> None:
    """Additions are free; after an announced removal run ``python -m tools.make.public_api``."""
    assert breaks(json.loads(RECORD.read_text()), surface()) == []


SMALL: dict[str, Any] = {
    "version": "1.2.0",
    "python": {"gsmap.open": ["path", "mode=", "*strict="], "gsmap.Map.update": []},
    "schema": 2,
    "rows": {"EdgeRow": {"pair": "text"}},
    "verbs": {"list edges": "list of EdgeRow"},
}


@pytest.mark.parametrize(
    ("change", "is_broken", "announced_by"),
    [
        (lambda s: s["python"].pop("gsmap.open"), True, "version"),
        (lambda s: s["python"]["gsmap.open"].remove("mode="), True, "version"),
        (lambda s: s["python"]["gsmap.open"].append("*needed"), True, "version"),
        (lambda s: s["python"]["gsmap.open"].__setitem__(1, "mode"), True, "version"),
        (lambda s: s["python"]["gsmap.open"].__setitem__(1, "*mode="), True, "version"),
        (lambda s: s["python"]["gsmap.open"].append("*more="), False, ""),
        (lambda s: s["python"].update({"gsmap.read": ["path"]}), False, ""),
        (lambda s: s["rows"]["EdgeRow"].pop("pair"), True, "schema"),
        (lambda s: s["rows"]["EdgeRow"].update(pair="number"), True, "schema"),
        (lambda s: s["rows"]["EdgeRow"].update(status="text"), False, ""),
        (lambda s: s["verbs"].pop("list edges"), True, "schema"),
    ],
)
def test_what_breaks(change: Callable[[dict[str, Any]], object], is_broken: bool, announced_by: str) -> None:
    now = copy.deepcopy(SMALL)
    change(now)
    assert bool(breaks(SMALL, now)) == is_broken
    if is_broken:
        now[announced_by] = {"version": "2.0.0", "schema": 3}[announced_by]
        assert breaks(SMALL, now) == []
