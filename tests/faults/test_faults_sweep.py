"""Every change of every verb, in every way: as `tools/check/disk_faults.py`."""

import os

import pytest
from fault_shim import FAULTS, KILLS
from fault_sweep import Point, Tally, points, run
from fault_verbs import VERBS

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("verb", VERBS)
def test_every_change_of(verb, client):
    if not VERBS[verb].possible:
        pytest.skip(f"needs the package {VERBS[verb].needs}")
    every = int(os.environ.get("GSMAP_FAULTS_EVERY", "1"))
    ops = client.ask("ops", verb=verb)
    tally = Tally()
    run([Point(verb, "power", 48), *points(verb, ops, (*KILLS, *FAULTS), every)], [client], tally.add)
    assert tally.ok, f"{tally.table()}\n{tally.report()}"
