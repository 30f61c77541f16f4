"""A street of rooms that look alike, through the whole pipeline."""

import argparse

import pytest

from tools.bench import alike as bench_alike


@pytest.mark.slow
def test_no_wrong_edge_of_a_street_of_look_alikes_is_used(tmp_path):
    args = argparse.Namespace(cache=tmp_path, seed=31, repeats="decoration", rooms=15, decorations=5, steps=60)
    street = bench_alike.read(args)
    pairs = [one.registration for one in street.map.store.registrations.current()]
    refused = [r for r in pairs if r.reason_code == "look_alike" and not street.is_right(r.target, r.source)]
    assert len(refused) >= 10  # or there would be nothing to tell apart
    assert all(street.is_right(r.target, r.source) for r in pairs if r.status == "accepted")
    answer = street.map.pose_graph()
    assert all(outcome.use != "unused" for key, outcome in answer.outcomes.items() if street.is_right(*key))
    assert {pose.component for pose in answer.poses.values()} == {0}
    assert bench_alike.off_m(street, answer, 0) < bench_alike.FOLDED_M
