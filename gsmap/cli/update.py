"""gsmap update: ingest captures and compute all missing results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import (
    AsJson,
    Executor,
    MapPath,
    Output,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    say,
)
from gsmap.cli.ingest import CapturedAt, Clean, NoCreate, makes_map, refuse_capture_as_map
from gsmap.texts import escaped

if TYPE_CHECKING:
    from gsmap.types.rows.pairs import EdgeRow
    from gsmap.types.rows.scenes import SceneRow

PANEL = "Map", 3
OUTPUTS = {"update": Output("revisions.UpdateReport")}


def command(
    map: MapPath,
    paths: Annotated[
        list[str] | None, typer.Argument(metavar="[FILE_OR_FOLDER...]", help="Captures to ingest first.")
    ] = None,
    captured_at: CapturedAt = None,
    clean: Clean = False,
    no_create: NoCreate = False,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Ingest captures, then compute all missing scene graphs, edges and poses. Creates MAP if it is missing.

    Example: `gsmap update house.gsmap captures/*.ply`
    """
    from gsmap.errors import NotFoundError
    from gsmap.ingest import given_date
    from gsmap.store import Store

    given_date(captured_at)  # fail before a map is created
    refuse_capture_as_map("update", map, paths or [])
    if not no_create and not paths and not Store.exists(map):
        raise NotFoundError(
            f"no map at {map}: pass captures to create it, or run gsmap init {map}", code="map_not_found"
        )
    create = not no_create and makes_map(map, paths or [], captured_at, clean=clean)
    with opened(map, create=create, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        if create:
            say(f"created {map}")
        report = m.update(*(paths or ()), captured_at=captured_at, clean=clean)
        status = None if json else m.status()
        held = [] if status is None or not status.tentative else m.edge_rows(status="tentative")
    for row in report.ingested:
        for note in row.notes:
            say(f"{row.scene_name}: {note}")
        if not row.new:
            say(f"{row.scene_name}: {row.outcome}")
    for note in report.notes:
        say(note)
    if json:
        print_rows("update", report, json)
    else:
        print_rows_of(report.scenes, report.edges)
        if not report.scenes and not report.edges:
            print("nothing is new")
        if (newest := report.revision) is not None:
            by_one = sum(row.use == "one pair" for row in held)
            print(
                f"the map has {newest.scenes} scenes in {newest.components} component{'s' * (newest.components != 1)}; "
                f"{newest.edges_used} edges used, {by_one} placed by one pair, "
                f"{newest.edges_tentative - by_one} in doubt, {newest.edges_refused} refused"
            )
    if status is not None:
        for todo in status.todo:
            if todo.wants_person and (todo.what != "isolated" or status.scenes > 1):
                print(escaped(f"next: {todo.meaning} ({todo.count}): {todo.verb}"))


def print_map(scenes: Sequence[SceneRow], edges: Sequence[EdgeRow]) -> None:
    """Print the tables of scenes and edges of a map, with a summary line."""
    print_rows_of(scenes, edges)
    placed = [row for row in scenes if row.S_map_scene is not None]
    components = {row.component for row in placed}
    accepted = sum(row.status == "accepted" for row in edges)
    print(
        f"{len(placed)} of {len(scenes)} scenes placed in {len(components)} component{'s' * (len(components) != 1)}; "
        f"{accepted} edges accepted, {len(edges) - accepted} not"
    )


def print_rows_of(scenes: Sequence[SceneRow], edges: Sequence[EdgeRow]) -> None:
    """Print a table of scenes and a table of edges with reasons; leave out an empty table."""
    columns = {
        "name": "scene",
        "standing": "status",
        "component": "component",
        "num_gaussians": "Gaussians",
        "num_nodes": "nodes",
    }
    if scenes:
        print_table("scenes", columns, scenes)
    columns = {
        "pair": "pair",
        "status": "status",
        "use": "use",
        "overlap": "overlap",
        "num_inliers": "inliers",
        "reason": "reason",
    }
    if edges:
        print_table("edges", columns, edges)
