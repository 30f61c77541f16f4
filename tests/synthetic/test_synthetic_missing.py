"""Without the distribution that makes synthetic scenes, ``gsmap demo`` says how to get it."""

from __future__ import annotations

import sys

from raising import raises

from gsmap.cli import demo
from gsmap.errors import MissingDependencyError


def test_demo_says_how_to_install_it(monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "gsmap_synthetic", None)
    with raises(MissingDependencyError, code="missing_dependency") as caught:
        demo.command(str(tmp_path / "out"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
