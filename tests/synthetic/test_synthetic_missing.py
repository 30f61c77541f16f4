"""Without the distribution that makes synthetic scenes, ``gsmap demo`` says how to get it."""

from __future__ import annotations

import sys

import pytest

from gsmap.cli import demo
from gsmap.errors import MissingDependencyError


def test_demo_says_how_to_install_it(monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "gsmap_synthetic", None)
    with pytest.raises(MissingDependencyError, match="pip install the folder synthetic/") as caught:
        demo.command(str(tmp_path / "out"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
