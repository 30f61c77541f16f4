import math
from types import SimpleNamespace

import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.settings.ranges import require_range


@pytest.mark.parametrize(
    ("interval", "inside", "outside"),
    [
        ("(0, 1)", [0.5], [0, 1, -1, 2, math.nan]),
        ("[0, 1)", [0, 0.9], [1, math.nan]),
        ("(0, 1]", [1, 0.1], [0, 1.1]),
        ("[1, inf]", [1, 5, math.inf], [0, math.nan]),
        ("[0, inf)", [0, 1e300], [math.inf, -1]),
    ],
)
def test_values_outside_an_interval_are_refused_by_name(interval, inside, outside):
    for value in inside:
        require_range(SimpleNamespace(halo_m=value, steps=-5), interval, "halo_m")
    for value in outside:
        with raises(ConfigError, code="out_of_range", match="halo_m"):
            require_range(SimpleNamespace(halo_m=value, fine=0.5), interval, "halo_m")
