"""A few points of every kind of verb, of the thousands that `tools/sweep_faults.py` goes through."""

import pytest
from fault_shim import MODES
from fault_verbs import VERBS

# Of each verb: how far into its changes (0 to 1), and in which way. The commit lies near the end.
POINTS = {
    "init": [(0.0, "kill-before"), (0.4, "kill-after"), (0.5, "enospc-ever"), (0.97, "kill-before")],
    "ingest": [
        (0.2, "kill-before"),
        (0.5, "short-once"),
        (0.6, "eio-once"),
        (0.88, "kill-after"),
        (0.9, "enospc-ever"),
    ],
    "ingest-two": [(0.5, "enospc-once"), (0.75, "kill-after"), (0.8, "eio-ever")],
    "optimize": [(0.5, "kill-after"), (0.6, "enospc-once"), (0.6, "eio-once"), (0.9, "eio-ever")],
    "export": [
        (0.1, "kill-before"),
        (0.2, "kill-after"),
        (0.4, "enospc-ever"),
        (0.5, "kill-before"),
        (0.8, "eio-once"),
    ],
    "export-shrunk": [(0.5, "kill-after"), (0.8, "kill-before"), (0.9, "eio-once")],
    "prune": [(0.4, "kill-before"), (0.5, "eio-ever"), (0.7, "kill-after"), (0.8, "enospc-once")],
    "remove": [(0.3, "eio-once"), (0.5, "kill-after"), (0.5, "enospc-ever"), (0.7, "eio-ever"), (0.8, "kill-before")],
    "models-add": [(0.4, "kill-after"), (0.45, "enospc-ever"), (0.6, "eio-once")],
    "migrate": [(0.5, "kill-after"), (0.6, "enospc-once"), (0.9, "kill-before")],
}
CUTS = {"remove": 8, "ingest": 6, "export": 6, "models-add": 4, "prune": 4}


@pytest.mark.parametrize("verb", POINTS)
def test_a_verb_that_is_disturbed(verb, client, sound):
    if not VERBS[verb].possible:
        pytest.skip(f"needs the package {VERBS[verb].needs}")
    count = len(client.ask("ops", verb=verb))
    assert count > 10
    sound([client.ask("point", verb=verb, n=1 + int(at * (count - 1)), mode=mode) for at, mode in POINTS[verb]])


@pytest.mark.parametrize("verb", CUTS)
def test_the_power_goes(verb, client, sound):
    if not VERBS[verb].possible:
        pytest.skip(f"needs the package {VERBS[verb].needs}")
    sound(client.ask("power", verb=verb, states=CUTS[verb]))


def test_every_way_to_fail_is_sampled():
    assert {mode for points in POINTS.values() for _, mode in points} == set(MODES)
