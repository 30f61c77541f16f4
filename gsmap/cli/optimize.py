"""gsmap optimize: solve the pose graph."""

from __future__ import annotations

from gsmap.cli.console import AsJson, MapPath, Output, Preset, Sets, opened, print_rows, say

PANEL = "Map", 6
OUTPUTS = {"optimize": Output("revisions.RevisionRow")}


def command(map: MapPath, sets: Sets = None, preset: Preset = None, json: AsJson = False) -> None:
    """Estimate all scene poses from the edges, and store them as a new revision.

    Example: `gsmap optimize site.gsmap`
    """
    from gsmap.cli.update import print_map

    with opened(map, bars=True, sets=sets, preset=preset) as m:
        row = m.optimize()
        scenes, edges = m.scene_rows(), m.edge_rows()
    for note in row.notes:
        say(f"revision {row.number}: {note}")
    if json:
        print_rows("optimize", row, json)
    else:
        print_map(scenes, edges)
