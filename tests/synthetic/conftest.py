"""One synthetic place for all tests here: painted coarsely, which is what takes the time."""

import pytest

from gsmap_synthetic import make_place


@pytest.fixture(scope="session")
def place():
    return make_place(3, texel_m=0.04)
