from dataclasses import replace

import numpy as np
import pytest
from made_worlds import PLACING, city, poses_at, true_edges

from gsmap.optimize import Params, optimize

QUICK = Params(marginals=False)


def world(names, pairs, duplicates):
    """Scenes on a circle, with an edge per pair of names; those in ``duplicates`` connect two copies of one capture."""
    angle = np.linspace(0, 2 * np.pi, len(names), endpoint=False)
    truth = poses_at(4.0 * np.c_[np.cos(angle), np.sin(angle), 0 * angle])
    rows = [[names.index(name) for name in pair] for pair in pairs]
    edges = true_edges(truth, rows, np.random.default_rng(0), list(names))
    return list(names), [replace(e, duplicate=e.target + e.source in duplicates) for e in edges]


@pytest.mark.parametrize(
    ("pairs", "duplicates"),
    [
        (["ab", "ac", "bc"], ["ac"]),  # c is a copy of a
        (["ab", "ac", "bc"], ["ac", "bc"]),  # c merges a and b, as an exported map
        (["ab", "ac", "ad", "bc", "bd", "cd"], ["ac", "ad", "cd"]),  # two copies of a
        (["ab", "ac", "ad", "bc", "bd", "cd"], ["ac", "bd"]),  # copies of both
        (["ac", "bc", "bd", "ad"], ["ac", "bd"]),  # copies of both, and the captures themselves have no edge
    ],
)
def test_a_duplicate_confirms_no_edge(pairs, duplicates):
    names, edges = world("abcd"[: 3 + any("d" in pair for pair in pairs)], pairs, duplicates)
    answer = optimize(names, edges, params=QUICK)
    assert {pose.component for pose in answer.poses.values()} == {0}
    between = [answer.outcomes[e.target, e.source] for e in edges if not e.duplicate]
    assert {(one.use, one.reason_code, one.undecided) for one in between} == {("tentative", "unconfirmed", False)}
    plain = optimize(names, [replace(e, duplicate=False) for e in edges], params=QUICK)
    assert {one.use for one in plain.outcomes.values()} == {"used"}


def test_a_duplicate_is_placed_with_its_capture_and_keeps_what_others_confirm():
    # d copies a; the cycle a, b, c confirms its edges, and e has an edge to the copy alone.
    names, edges = world("abcde", ["ab", "ac", "bc", "ad", "bd", "ed"], ["ad"])
    answer = optimize(names, edges, params=QUICK)
    uses = {e.target + e.source: answer.use(e.target, e.source) for e in edges}
    assert uses == {"ab": "used", "ac": "used", "bc": "used", "ad": "used", "bd": "used", "ed": "tentative"}
    assert [answer.poses[name].status for name in names] == ["placed"] * 4 + ["tentative"]


def test_a_new_duplicate_needs_a_full_solve():
    known = city(30, 0.0, seed=1)
    ids = [s for s in known.ids if s != known.ids[29]]
    before = optimize(ids, [e for e in known.edges if {e.target, e.source} <= set(ids)], params=PLACING)
    edges = [replace(e, duplicate=e.source == known.ids[29]) for e in known.edges]
    methods = [
        optimize(known.ids, of, previous=before, params=PLACING).provenance.method for of in (known.edges, edges)
    ]
    assert methods == ["incremental", "batch"]
