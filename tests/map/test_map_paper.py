"""The preset ``paper``: Graph-GSReg's stages with the values that were published, end to end."""

import numpy as np

from gsmap.map.settings import PRESETS, settings_of
from gsmap.settings import differences


def test_the_preset_is_what_was_published():
    settings = settings_of({}, "paper")
    describe, register, merge = settings.describe, settings.register, settings.merge
    graph = register.proposers["graph"]
    # Nodes are objects alone, of masks of single views, lifted without a depth test, in their context over three hops.
    assert (describe.landmarks, describe.objects, graph.context.hops) == (False, True, 3)
    assert describe.object.segmenter == "per_view"
    assert np.isinf(describe.object.depth_tolerance)
    # One relative test of distances, and nothing of gravity; the clique is searched to its end by default limits.
    assert (register.proposer, register.fallback, graph.kinds) == ("graph", "never", ("objects",))
    assert graph.consistency.test == "ratio"
    assert np.isinf(graph.consistency.height_slope)
    # ICP on the Gaussians' means, straight from the clique's pose.
    assert (register.coarse_refiner, register.refiner, register.polisher) == ("none", "icp", "none")
    assert register.refiners["icp"].means
    # Voxels of 1 cm of the union, nothing pruned, no capture before another, and L1 alone.
    tto = merge.mergers["tto"]
    assert (merge.method, tto.voxel_m, tto.ssim_weight, tto.kept_fraction, tto.min_weight) == (
        "tto",
        0.01,
        0.0,
        1.0,
        0.0,
    )
    assert (tto.huber_delta, tto.momentum) == (0.0, 0.9)
    assert (tto.owner_cells, tto.prefer, tto.balance_exposure) == (False, "both", False)


def test_the_preset_says_nothing_that_is_the_default_anyway():
    """But for what names the method: those stay if the default moves."""
    said = set(PRESETS["paper"])
    changed = set(differences(settings_of({}, "paper"), settings_of({})))
    assert changed <= said
    assert said - changed <= {
        "merge.method",
        "merge.mergers.tto.voxel_m",
    }
