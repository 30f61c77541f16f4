"""A scene graph is the same, bit for bit, for any number of threads."""

import numpy as np
from describe_places import room

from gsmap import _native
from gsmap.describe import Params, describe
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.geometry.threads import map_ahead
from gsmap.types.plain import plain


def test_threads_change_no_bit_of_a_scene_graph():
    gaussians, cameras = room(n=25_000)
    params = Params(object=ObjectParams(render_backend="native", num_cameras=6, longest_side_px=96))
    graphs, before = [], _native.num_threads()
    for threads in (1, 5):
        _native.set_num_threads(threads)
        graphs.append(describe("room", gaussians, cameras, params))
    _native.set_num_threads(before)
    one, five = graphs
    assert len(one.layers["objects"]) > 3
    assert plain(one.notes) == plain(five.notes)
    for name, layer in one.layers.items():
        for field in ("positions", "embeddings", "types", "weights", "extents", "features", "num_views"):
            np.testing.assert_array_equal(getattr(layer, field), getattr(five.layers[name], field), err_msg=field)
    np.testing.assert_array_equal(one.segments.members, five.segments.members)


def test_results_come_in_the_order_of_their_items_which_are_taken_as_needed():
    taken = []

    def items():
        for i in range(30):
            taken.append(i)
            yield i

    results = map_ahead(lambda i: -i, items(), 2)
    assert next(results) == 0
    assert len(taken) == 5
    assert list(results) == [-i for i in range(1, 30)]
