"""The command line, for the page that lists it (`tools/make/docs.py`)."""

from gsmap.cli.app import build

app = build()
