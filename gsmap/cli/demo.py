"""gsmap demo: run the whole workflow on small synthetic captures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, Output, print_rows, print_table, progress_bars, say

if TYPE_CHECKING:
    from gsmap.map import Map

PANEL = "Map", 11
OUTPUTS = {"demo": Output("demo.DemoReport")}


def command(
    folder: Annotated[
        str, typer.Argument(metavar="[DIR]", help="Working folder, which is created if it is missing.")
    ] = "gsmap-demo",
    seed: Annotated[int, typer.Option("--seed", help="Random seed of the flat and the camera paths.")] = 0,
    json: AsJson = False,
) -> None:
    """Make three small captures of a furnished flat, map them, and print the errors of the poses.

    Example: `gsmap demo`
    """
    import gsmap.map
    import gsmap_synthetic
    from gsmap.cli.update import print_map
    from gsmap.types.rows.demo import DemoReport

    root = Path(folder)
    map_path = root / "demo.gsmap"
    root.mkdir(parents=True, exist_ok=True)  # fail now, not after a minute of making captures
    with progress_bars() as progress:
        draw = progress or (lambda stage, fraction, text: None)
        captures = gsmap_synthetic.make_captures(seed, progress=lambda fraction, text: draw("capture", fraction, text))
        gsmap_synthetic.write_captures(root / "captures", captures)
        with gsmap.map.open_or_create(map_path, progress=progress) as m:
            m.update(root / "captures")
            scenes, edges = m.scene_rows(), m.edge_rows()
            exported = m.export(root / "tiles", tile_size_m=0)
            _draw(m, root / "map.png")
            truth = m.evaluate(root / "captures" / "truth")
    report = DemoReport(
        map=str(map_path),
        picture=str(root / "map.png"),
        scenes=tuple(scenes),
        edges=tuple(edges),
        tiles=exported.tiles,
        truth=truth,
    )
    if json:
        print_rows("demo", report, json)
    else:
        print_map(report.scenes, report.edges)
        columns = {"pair": "pair", "rre_deg": "RRE, deg", "centroid_m": "centroid, m"}
        print_table("errors against the truth", columns, truth.pairs)
    for tile in report.tiles:
        say(f"merged tile: {root / 'tiles' / tile.path} ({tile.num_gaussians} Gaussians; any 3DGS viewer opens it)")
    say(f"picture: {report.picture}")
    say(f"to explore the map: gsmap view {map_path}")


def _draw(m: Map, path: Path) -> None:
    """Draw the map: all placed scenes, the edges between them, and the camera paths."""
    from PIL import Image

    from gsmap.durable import write_output
    from gsmap_synthetic.map_picture import map_picture

    parts = [(scene.name, *m.read(scene.name, frame="map")) for scene in m.scenes()]
    edges = [(row.target_name, row.source_name) for row in m.edge_rows() if row.used]
    picture = Image.fromarray(map_picture(parts, edges))
    write_output(path, lambda staged: picture.save(staged, optimize=True))
