"""One made place for all tests of the demo: painted coarsely, which is what takes the time."""

import pytest

from gsmap.demo import make_place


@pytest.fixture(scope="session")
def place():
    return make_place(3, texel_m=0.04)
