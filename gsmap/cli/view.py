"""gsmap view: show a map in a browser."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say
from gsmap.cli.stopping import StopSignal

PANEL = "View and query", 1
OUTPUTS = {"view": Output("maps.ViewReport")}


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Context that Ctrl-C ends, as the normal way to end the server; other signals end the process as for any verb."""
    try:
        yield
    except StopSignal as stop:
        if stop.signum != signal.SIGINT:
            stop.add_note("reviews and edits are kept")
            raise


def command(
    map: MapPath,
    port: Annotated[int, typer.Option("--port", help="Port on this machine; 0 selects a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    tiles: Annotated[
        Path | None,
        typer.Option(
            "--tiles", metavar="DIR", help="Also show the 3D Tiles in this folder, to which the map was exported."
        ),
    ] = None,
    read_only: Annotated[bool, typer.Option("--read-only", help="Do not allow reviews and edits on the page.")] = False,
    export: Annotated[
        Path | None,
        typer.Option(
            "--export", metavar="DIR", help="Write the page as files for any web server, instead of serving it."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Serve a page that shows the map, on this machine, until Ctrl-C.

    The page shows the captures at every level of detail, edges with their evidence, changes, objects and revisions,
    and takes reviews.

    Example: `gsmap view site.gsmap`
    """
    from gsmap.types.rows.maps import ViewReport

    if export is not None:
        with opened(map, bars=True) as m:
            report = m.write_site(export, tiles=tiles)
        for note in report.notes:
            say(note)
        print_rows("view", report, json) if json else say(f"{report.num_bytes:,} bytes in {report.path}")
        return

    with opened(map) as m, m.view(port=port, tiles=tiles, read_only=read_only) as server, until_interrupted():
        if json:
            print_rows("view", ViewReport(url=server.url), json)
        else:  # also with -q: the user needs the address
            print(f"{server.url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
        if browser:
            import webbrowser

            webbrowser.open(server.url)
        server.serve_forever()
