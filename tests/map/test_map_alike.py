"""A street of rooms that look alike, through the whole pipeline."""

import argparse
from collections import Counter
from dataclasses import replace

import pytest

from tools.bench import alike as bench_alike


@pytest.mark.slow
def test_no_wrong_edge_of_a_street_of_look_alikes_is_used(tmp_path):
    from gsmap.map.stages.optimize import pose_inputs
    from gsmap.optimize import optimize

    args = argparse.Namespace(cache=tmp_path, seed=31, repeats="decoration", rooms=15, decorations=5, steps=60)
    street = bench_alike.read(args)
    given = pose_inputs(street.map.store, street.map.settings)
    wrong = [e for e in given.edges if not street.is_right(e.target, e.source)]
    assert len(wrong) >= 10  # or there would be nothing to tell apart
    answer = street.map.pose_graph()
    uses = Counter((street.is_right(*key), outcome.use) for key, outcome in answer.outcomes.items())
    assert uses[False, "used"] == uses[False, "tentative"] == 0
    assert uses[True, "unused"] == 0
    assert {pose.component for pose in answer.poses.values()} == {0}
    assert bench_alike.off_m(street, answer, 0) < bench_alike.FOLDED_M
    # Who does not look at what disagrees folds it.
    blind = [replace(e, disagreement=float("nan"), log_odds_wrong=float("nan")) for e in given.edges]
    folded = optimize(given.scenes, blind, params=street.map.settings.optimize)
    assert bench_alike.off_m(street, folded, 0) > bench_alike.FOLDED_M
