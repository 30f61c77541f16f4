"""The command line, with one file per verb; no other room prints or exits."""

from __future__ import annotations

COLLECT_AFTER = 100_000
"""Number of allocations between two runs of the garbage collector."""


def main() -> None:
    """Run the ``gsmap`` command."""
    import gc

    from gsmap.cli.stopping import stoppable

    # Rows are many objects without reference cycles: collecting after every 700 objects takes a quarter of the time.
    gc.set_threshold(COLLECT_AFTER)

    with stoppable():  # first, because importing takes a moment, too
        from gsmap.cli.app import run

        run()
