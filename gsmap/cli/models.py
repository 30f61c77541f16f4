"""gsmap models: ONNX models a map describes its scenes with."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say

app = typer.Typer(
    no_args_is_help=True,
    help="ONNX models for masks (`sam`), image features (`clip`), words (`clip-text`), local features (`extractor`).",
)


@app.command()
def add(
    map: MapPath,
    kind: Annotated[
        str,
        typer.Argument(
            help="`sam-encoder`, `sam-decoder`, `clip` (image encoder), `clip-text`, `clip-tokenizer`, or `extractor`."
        ),
    ],
    path: Annotated[
        str, typer.Argument(metavar="FILE", help="The .onnx file; of `clip-tokenizer` the tokenizer.json.")
    ],
    preset: Annotated[
        str,
        typer.Option("--preset", help="Pixel scaling: `clip`, `imagenet`, `unit`, or `mean=..,..,..;std=..,..,..`."),
    ] = "clip",
    reference: Annotated[
        bool, typer.Option("--reference", help="Leave the file where it is; keep its digest.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Register a model: checked, copied into the map, and used by every later describe.

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
    """List the map's models.

    Example: `gsmap models list site.gsmap`
    """
    with opened(map) as m:
        rows = m.model_rows()
    print_rows("models list", rows, json, "models")
