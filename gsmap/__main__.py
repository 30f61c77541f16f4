"""``python -m gsmap``: the command line."""

from gsmap.cli import main

main()
