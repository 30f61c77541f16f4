"""gsmap init: create an empty map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, print_rows, say

PANEL = "Map", 1
OUTPUTS = {"init": Output("maps.InitReport")}


def command(
    map: MapPath,
    catalog: Annotated[
        str | None,
        typer.Option(
            "--catalog",
            metavar="URL",
            help="Keep the catalog in this empty PostgreSQL database (SQLAlchemy URL), for concurrent writers.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Create an empty map in a folder, or in a bucket (s3://BUCKET/PREFIX, with --catalog).

    Example: `gsmap init site.gsmap`
    """
    import gsmap.map
    from gsmap.store.catalog import url_without_password
    from gsmap.types.rows.maps import InitReport

    gsmap.map.create(map, catalog_url=catalog).close()
    say(f"created an empty map at {map}; next: gsmap update {map} CAPTURES...")
    if json:
        report = InitReport(map=map, catalog=None if catalog is None else url_without_password(catalog))
        print_rows("init", report, json)
