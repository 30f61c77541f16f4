"""A made family of methods in a package of its own, and an installed package that adds to it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsmap.methods import Family
from gsmap.methods.family import _DECLARED, _loaded

PARAMS = '''
from dataclasses import dataclass

@dataclass(frozen=True)
class Params:
    """Settings.

    Args:
        size_m: side of a block.
        label: what to call it; none where it has no name.
    """

    size_m: float = {size}
    label: str | None = None

VERSION = {version}

def build(x, params):
    return x * params.size_m
'''


def write_package(root: Path) -> None:
    blocks = root / "toy_blocks"
    blocks.mkdir(parents=True)
    (blocks / "__init__.py").write_text("")
    (blocks / "_shared.py").write_text("")
    (blocks / "base.py").write_text("")
    (blocks / "wood.py").write_text(PARAMS.format(size=0.5, version=3))
    (blocks / "stone.py").write_text(PARAMS.format(size=2.0, version=1))
    (blocks / "bare.py").write_text("VERSION = 1\n")
    (blocks / "loose.py").write_text(PARAMS.format(size=1.0, version=1).replace("(frozen=True)", ""))
    (root / "toy_added.py").write_text(PARAMS.format(size=7.0, version=12))
    about = root / "toys-2.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: toys\nVersion: 2.0\n")
    points = "[gsmap.toys]\nglass = toy_added\nwood = toy_added\ntorn = no_such_module\n"
    (about / "entry_points.txt").write_text(points)


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Family]:
    write_package(tmp_path / "site")
    monkeypatch.syspath_prepend(tmp_path / "site")
    family = Family("toy", "toy_blocks", ("build",))
    monkeypatch.setitem(_DECLARED, "toy", family)
    _loaded.cache_clear()
    yield family
    _loaded.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] in ("toy_blocks", "toy_added")]:
        del sys.modules[name]
