"""Fixtures of the settings: the tree, with a made family of methods."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))
from settings_tree import Tree
from toys import toys

__all__ = ["toys"]


@pytest.fixture
def tree(toys) -> Tree:
    """The methods that do not keep the contract are no part of a tree: only two are left in the folder."""
    folder = Path(next(p for p in sys.path if (Path(p) / "toy_blocks").is_dir())) / "toy_blocks"
    for broken in ("bare.py", "loose.py"):
        (folder / broken).unlink()
    (folder.parent / "toys-2.0.dist-info" / "entry_points.txt").write_text("[gsmap.toys]\nglass = toy_added\n")
    return Tree()
