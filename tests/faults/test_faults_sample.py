"""A few points of every kind of verb, of the thousands that `tools/check/disk_faults.py` goes through."""

import re

import pytest
from fault_shim import MODES
from fault_verbs import VERBS

# Of each verb: how far into its changes (0 to 1), and in which way. The commit lies near the end.
POINTS = {
    "init": [(0.4, "kill-after"), (0.5, "enospc-ever"), (0.97, "kill-before")],
    "ingest": [(0.5, "short-once"), (0.6, "eio-once"), (0.88, "kill-after")],
    "optimize": [(0.5, "kill-after"), (0.6, "enospc-once")],
    "export": [(0.1, "kill-before"), (0.3, "enospc-ever")],
    "changes": [(0.5, "kill-after"), (0.6, "enospc-once")],
    "prune": [(0.4, "kill-before"), (0.5, "eio-ever")],
    "remove": [(0.3, "eio-once"), (0.5, "kill-after"), (0.7, "eio-ever")],
    "purge": [(0.3, "kill-before"), (0.6, "eio-once")],
    "models-add": [(0.4, "kill-after"), (0.6, "eio-once")],
    "split": [(0.044, "kill-before")],
    "migrate": [(0.5, "kill-after"), (0.6, "enospc-once")],
}
CUTS = {"remove": 6, "purge": 4, "ingest": 5, "export": 4, "export-shrunk": 4, "models-add": 4}


def need(verb: str) -> None:
    if not VERBS[verb].possible:
        pytest.skip(f"needs the package {VERBS[verb].needs}")


@pytest.mark.parametrize("verb", POINTS)
def test_a_verb_that_is_disturbed(verb, client, sound):
    need(verb)
    count = len(client.ask("ops", verb=verb))
    assert count > 10
    sound([client.ask("point", verb=verb, n=1 + int(at * (count - 1)), mode=mode) for at, mode in POINTS[verb]])


@pytest.mark.parametrize("verb", CUTS)
def test_the_power_goes(verb, client, sound):
    need(verb)
    sound(client.ask("power", verb=verb, states=CUTS[verb]))


def after(ops: list[str], *patterns: str) -> int:
    """The number of the first change that matches the last pattern, after a match of the one before, and so on."""
    n = 0
    for pattern in patterns:
        n = next(i for i, op in enumerate(ops[n:], n + 1) if re.search(pattern, op))
    return n


def test_a_tile_that_the_map_could_not_be_told_of_is_made_again(client, sound):
    n = after(client.ask("ops", verb="export"), *["rename out/.partial"] * 3, "write .*-wal")
    sound([client.ask("point", verb="export", n=n, mode=mode) for mode in ("enospc-once", "kill-before")])


def test_a_commit_that_could_not_be_synchronised_is_not_folded_in(client, sound):
    ops = client.ask("ops", verb="purge")
    commits = [n for n, op in enumerate(ops[: after(ops, " out/")], 1) if op == "fsync site.gsmap/map.sqlite-wal"]
    sound([client.ask("point", verb="purge", n=commits[-1], mode="eio-once")])


def test_a_thinned_capture_and_its_things_are_one_commit(client, sound):
    ops = client.ask("ops", verb="thin")
    commits = [n for n, op in enumerate(ops, 1) if op == "fsync site.gsmap/map.sqlite-wal"]
    sound([client.ask("point", verb="thin", n=n, mode="kill-after") for n in commits])


def test_what_an_export_had_begun_is_gone_though_nothing_is_to_be_done(client, sound):
    ops = client.ask("ops", verb="export")
    last = max(n for n, op in enumerate(ops, 1) if op == "rmdir out/.partial")
    sound([client.ask("point", verb="export", n=last, mode="kill-before")])


def test_tiles_that_were_to_go_go_in_the_end(client, sound):
    first = after(client.ask("ops", verb="export-shrunk"), "unlink out/component")
    sound([client.ask("point", verb="export-shrunk", n=n, mode="kill-before") for n in (first, first + 1)])


def test_the_log_is_folded_in_once_at_the_end(client):
    ops = [op for op in client.ask("ops", verb="ingest-two") if op.split()[0] in ("write", "fsync")]
    folded = [n for n, op in enumerate(ops) if op == "write site.gsmap/map.sqlite"]
    committed = [n for n, op in enumerate(ops) if op == "write site.gsmap/map.sqlite-wal"]
    assert len(folded) > 3
    assert min(folded) > max(committed)


def test_every_way_to_fail_is_sampled():
    assert {mode for points in POINTS.values() for _, mode in points} == set(MODES)
