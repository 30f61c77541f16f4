"""The ``gsmap`` program: collects the verbs and turns errors into one line and an exit code.

Exit codes: 0 ok, 1 failed, 2 wrong usage.
"""

from __future__ import annotations

import importlib
import os
import sys

import typer
from click.exceptions import Abort, ClickException, Exit

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
    """Run the command line and exit with its code."""
    try:
        result = build()(standalone_mode=False)
        code = result if isinstance(result, int) else 0
    except Exit as leave:
        code = leave.exit_code
    except Abort:
        print("gsmap: interrupted; the map is as it was after the last finished step", file=sys.stderr)
        code = 130
    except ClickException as error:
        error.show(sys.stderr)
        code = 2
    except ConfigError as error:
        print(f"gsmap: {error}", file=sys.stderr)
        code = 2
    except GsmapError as error:
        print(f"gsmap: {error}", file=sys.stderr)
        code = 1
    except BrokenPipeError:
        # Whoever read our output has left (`gsmap list ... | head`): not an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:
        print("gsmap: interrupted; the map is as it was after the last finished step", file=sys.stderr)
        code = 130
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        print(f"gsmap: the system refused{where}: {error.strerror or error}", file=sys.stderr)
        code = 1
    sys.stdout.flush()
    sys.exit(code)
