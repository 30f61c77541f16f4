from types import SimpleNamespace

import numpy as np
import pytest

from gsmap.map.reports.common import up_directions

Z, Y = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("of_thinned", "of_graphs", "expected"),
    [(Z, [], Z), (Z, [None], Z), (Z, [Y], Y), (None, [Z, Y], Y), (None, [Z, None], None), (None, [None], None)],
)
def test_what_the_last_graph_does_not_know_is_taken_from_thinning_alone(of_thinned, of_graphs, expected) -> None:
    scene = SimpleNamespace(id="a", thinning=of_thinned and SimpleNamespace(up=of_thinned))
    found = up_directions([SimpleNamespace(scene="a", up=up) for up in of_graphs], [scene])
    assert list(found) == ([] if expected is None else ["a"])
    if expected is not None:
        np.testing.assert_array_equal(found["a"], expected)
