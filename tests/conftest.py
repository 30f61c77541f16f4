"""Fixtures shared by all rooms."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def _shared_data() -> Path | None:
    """Real captures beside the checkout (or at GSMAP_SHARED_DATA); never part of the project."""
    named = os.environ.get("GSMAP_SHARED_DATA")
    root = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    return root if (root / "house").is_dir() else None


@pytest.fixture(scope="session")
def shared_data() -> Path:
    root = _shared_data()
    if root is None:
        pytest.skip("needs real captures: set GSMAP_SHARED_DATA to a folder holding house/, kitchen_splats/, formats/")
    return root
