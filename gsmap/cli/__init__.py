"""The command line: one file per verb. The only room that prints or exits."""

from __future__ import annotations

COLLECT_AFTER = 100_000
"""New objects between two looks for cycles of them."""


def main() -> None:
    """Entry point of the ``gsmap`` command."""
    import gc

    from gsmap.cli.stopping import stoppable

    # Ten thousand rows are many objects and no cycle: looking for cycles after every 700 takes a fourth of the time.
    gc.set_threshold(COLLECT_AFTER)

    with stoppable():  # before all else: importing takes a moment, too
        from gsmap.cli.app import run

        run()
