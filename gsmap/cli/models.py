"""gsmap models: ONNX models a map describes its scenes with."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, print_json, print_table, say

app = typer.Typer(no_args_is_help=True, help="ONNX models for masks (`sam`) and image features (`clip`).")


@app.command()
def add(
    map: MapPath,
    kind: Annotated[str, typer.Argument(help="`sam-encoder`, `sam-decoder` or `clip` (any image encoder).")],
    path: Annotated[str, typer.Argument(metavar="FILE", help="The .onnx file.")],
    preset: Annotated[
        str,
        typer.Option("--preset", help="Pixel scaling: `clip`, `imagenet`, `unit`, or `mean=..,..,..;std=..,..,..`."),
    ] = "clip",
    reference: Annotated[
        bool, typer.Option("--reference", help="Leave the file where it is; keep its digest.")
    ] = False,
) -> None:
    """Register a model: checked, copied into the map, and used by every later describe.

    Example: `gsmap models add site.gsmap clip mobilenet.onnx --preset imagenet`
    """
    import gsmap

    with gsmap.open(map) as m:
        m.add_model(kind, path, preset=preset, copy=not reference)
    say(f"registered {kind}; run: gsmap update {map}")


@app.command(name="list")
def list_models(map: MapPath, json: AsJson = False) -> None:
    """List the map's models.

    Example: `gsmap models list site.gsmap`
    """
    import gsmap

    with gsmap.open(map) as m:
        rows = m.model_rows()
    if json:
        print_json(rows)
        return
    columns = ["kind", "name", "sha256", "preset", "path"]
    print_table("models", columns, [[row[c] for c in columns] for row in rows])
