"""The command line: one file per verb. The only room that prints or exits."""

from __future__ import annotations


def main() -> None:
    """Entry point of the ``gsmap`` command."""
    from gsmap.cli.stopping import stoppable

    with stoppable():  # before all else: importing takes a moment, too
        from gsmap.cli.app import run

        run()
