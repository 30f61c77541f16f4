"""gsmap models: manage the ONNX models of a map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Map", 12
OUTPUTS = {"models add": Output("maps.ModelRow"), "models list": Output("maps.ModelRow", "models")}
app = typer.Typer(
    no_args_is_help=True,
    help="Manage ONNX models: masks (`sam`), image and text features (`clip`), local features (`extractor`).",
)


@app.command()
def add(
    map: MapPath,
    kind: Annotated[
        str,
        typer.Argument(
            help="`sam-encoder`, `sam-decoder`, `clip` (any image encoder), `clip-text`, `clip-tokenizer`, `extractor`."
        ),
    ],
    path: Annotated[
        str, typer.Argument(metavar="FILE", help="The .onnx file, or the tokenizer.json for `clip-tokenizer`.")
    ],
    preset: Annotated[
        str,
        typer.Option(
            "--preset", help="Pixel normalization: `clip`, `imagenet`, `unit`, or `mean=..,..,..;std=..,..,..`."
        ),
    ] = "clip",
    reference: Annotated[
        bool, typer.Option("--reference", help="Store the path and digest of the file instead of a copy.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Check a model, copy it to the map, and use it from now on.

    Example: `gsmap models add site.gsmap clip mobilenet.onnx --preset imagenet`
    """
    with opened(map) as m:
        m.add_model(kind, path, preset=preset, copy=not reference)
        row = next(row for row in m.model_rows() if row.kind == kind)
    say(f"registered {kind}" + ("" if kind in ("clip-text", "clip-tokenizer") else f"; run: gsmap update {map}"))
    if json:
        print_rows("models add", row, json)


@app.command(name="list")
def list_models(map: MapPath, json: AsJson = False) -> None:
    """List the models of a map.

    Example: `gsmap models list site.gsmap`
    """
    with opened(map) as m:
        rows = m.model_rows()
    print_rows("models list", rows, json, "models")
