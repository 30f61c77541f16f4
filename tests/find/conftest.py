"""A map of two captures of one room in which stools repeat."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from find_room import SETTINGS, fill

import gsmap
from gsmap.map import Map


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    path = tmp_path_factory.mktemp("find") / "site.gsmap"
    with pytest.MonkeyPatch.context() as patched, gsmap.map.create(path) as m:
        patched.setenv("GSMAP_WORKERS", "1")
        m.change_settings(SETTINGS)
        fill(m)
        m.describe()
        yield m
