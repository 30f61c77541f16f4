"""gsmap view: the map in a browser."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows
from gsmap.cli.stopping import Stopped


def command(
    map: MapPath,
    port: Annotated[int, typer.Option("--port", help="Port on this machine; 0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    json: AsJson = False,
) -> None:
    """Serve a page on this machine with the map's splats, graphs, poses and edges. Ctrl-C ends it.

    Example: `gsmap view site.gsmap`
    """
    from gsmap.types.rows import ViewReport

    # A signal is the way to end it, and no interruption.
    with opened(map) as m, m.view(port=port) as server, suppress(Stopped):
        if json:
            print_rows("view", ViewReport(url=server.url), json)
        else:  # with -q too: without it nobody finds the page
            print(f"{server.url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
        if browser:
            import webbrowser

            webbrowser.open(server.url)
        server.serve_forever()
