"""The ``gsmap`` program: collects the verbs and turns errors into one line and an exit code.

Exit codes: 0 ok, 1 failed, 2 wrong usage.
"""

from __future__ import annotations

import importlib
import sys

import typer

import gsmap
from gsmap.errors import ConfigError, GsmapError

VERBS = (
    "init",
    "ingest",
    "describe",
    "register",
    "optimize",
    "update",
    "confirm",
    "reject",
    "prior",
    "export",
    "list",
    "show",
    "diff",
    "convert",
    "models",
    "evaluate",
    "remove",
    "check",
    "prune",
    "migrate",
    "view",
    "demo",
)
"""In the order a newcomer meets them. ``gsmap/cli/<verb>.py`` holds ``command`` (or ``app`` where it has sub-verbs)."""


def _version(value: bool) -> None:
    if value:
        print(f"gsmap {gsmap.__version__}")
        raise typer.Exit


def build() -> typer.Typer:
    """The typer application with every verb attached."""
    app = typer.Typer(
        name="gsmap",
        help="The map-management database for 3D Gaussian Splatting: many captures in, one maintained map out.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
    )

    @app.callback()
    def root(
        version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
    ) -> None:
        pass

    for verb in VERBS:
        module = importlib.import_module(f"gsmap.cli.{verb}")
        if hasattr(module, "app"):
            app.add_typer(module.app, name=verb)
        else:
            app.command(name=verb)(module.command)
    return app


def run() -> None:
    """Run the command line and exit with its code. typer itself exits with 2 on wrong usage."""
    try:
        build()()
    except ConfigError as error:
        code, message = 2, str(error)
    except GsmapError as error:
        code, message = 1, str(error)
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        code, message = 1, f"the system refused{where}: {error.strerror or error}"
    print(f"gsmap: {message}", file=sys.stderr)
    sys.exit(code)
