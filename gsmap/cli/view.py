"""gsmap view: the map in a browser."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, say


def command(
    map: MapPath,
    port: Annotated[int, typer.Option("--port", help="Port on this machine; 0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Serve a page on this machine with the map's splats, graphs, poses and edges. Ctrl-C ends it.

    Example: `gsmap view site.gsmap`
    """
    import gsmap

    with gsmap.open(map) as m, m.view(port=port) as server:
        say(f"{server.url} (Ctrl-C ends it)")
        if browser:
            import webbrowser

            webbrowser.open(server.url)
        server.serve_forever()
