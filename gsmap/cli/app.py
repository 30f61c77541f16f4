"""The ``gsmap`` program, which collects the verbs and turns each error into one line and an exit code.

Exit codes: 0 ok, 1 failed, 2 wrong usage, 3 done except for quarantined jobs or captures; 130 after Ctrl-C,
143 after SIGTERM, 129 after SIGHUP (`gsmap.cli.stopping`).
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
import platform
import sys
import tempfile
import traceback
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from gsmap.cli.console import Output, begin_output, left, print_json_error, print_wide_tables, start_logging
from gsmap.errors import (
    ConfigError,
    DiskFullError,
    GsmapError,
    StoreError,
    failed_path,
    of_system,
    on_command_line,
)
from gsmap.texts import escaped
from gsmap.version import __version__

PANELS = (
    "Map",
    "Scenes and edges",
    "Changes over time",
    "View and query",
    "Export",
    "Branches and backups",
    "Maintenance",
)
"""Panels of ``gsmap -h``."""


def verb_module(verb: str) -> ModuleType | None:
    """Return the file of a verb, ``gsmap/cli/<verb>.py``; None if there is none.

    It defines ``command`` (or ``app`` if it has sub-verbs), ``PANEL`` (its panel of ``gsmap -h``, and its place there),
    ``OUTPUTS`` (what it prints with ``--json``), and ``TAKES_POINTS`` if an argument may be a point ``X,Y,Z``.
    """
    name = f"gsmap.cli.{verb.replace('-', '_')}"
    if "_" in verb or not verb.isascii() or not verb.replace("-", "_").isidentifier() or not find_spec(name):
        return None
    module = importlib.import_module(name)
    return module if hasattr(module, "PANEL") else None


@cache
def verbs() -> dict[str, ModuleType]:
    """Return the files of all verbs, in the order of ``gsmap -h``, in which a new user needs them."""
    names = [one.name.replace("_", "-") for one in pkgutil.iter_modules([str(Path(__file__).parent)])]
    found = {name: module for name in names if (module := verb_module(name)) is not None}

    def place(verb: str) -> tuple[int, int]:
        panel, number = found[verb].PANEL
        return PANELS.index(panel), number

    return {verb: found[verb] for verb in sorted(found, key=place)}


def outputs() -> dict[str, Output]:
    """Return what each verb prints with ``--json``; verbs with several forms have one entry per form."""
    return {form: output for module in verbs().values() for form, output in module.OUTPUTS.items()}


def _version(value: bool) -> None:
    if value:
        print(f"gsmap {__version__}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Print errors only: no progress and no notes.")] = False,
    wide: Annotated[
        bool, typer.Option("--wide", help="Print tables with all columns at full width, also in a pipe.")
    ] = False,
    verbose: Annotated[
        int, typer.Option("-v", "--verbose", count=True, help="Log each step; -vv logs every detail.")
    ] = 0,
) -> None:
    start_logging(verbose, quiet)
    print_wide_tables(wide)


def build(modules: Mapping[str, ModuleType] | None = None) -> typer.Typer:
    """Return the typer application with these verbs; default: all."""
    app = typer.Typer(
        name="gsmap",
        help="Map-management database for 3D Gaussian Splatting: merge many captures into one maintained map.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_root)
    for verb, module in (verbs() if modules is None else modules).items():
        panel, _ = module.PANEL
        if hasattr(module, "app"):
            app.add_typer(module.app, name=verb, rich_help_panel=panel)
        else:
            # A point may begin with a minus sign, so an unknown option is an argument.
            points = {"ignore_unknown_options": True} if getattr(module, "TAKES_POINTS", False) else None
            app.command(name=verb, context_settings=points, rich_help_panel=panel)(module.command)
    return app


@on_command_line()
def run(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its exit code; typer exits with 2 if the usage is wrong.

    Args:
        arguments: Command-line arguments; default: those of the process.
    """
    left()
    begin_output()
    given = sys.argv[1:] if arguments is None else arguments
    # Attaching all verbs takes longer than most of them do.
    first = next((one for one in given if not one.startswith("-")), "")
    reason = ""
    try:
        module = verb_module(first)
        build({first: module} if module else None)(arguments)
    except SystemExit as ended:
        if ended.code or not (message := left()):
            raise
        code = 3
    except ConfigError as error:
        code, message, reason = 2, str(error), error.code
    except GsmapError as error:
        code, message, reason = 1, str(error), error.code
    except OSError as error:
        where, kind = failed_path(error), of_system(error)
        if kind is DiskFullError:
            message = f"{where or 'a disk'}: the disk is full ({error.strerror}); free some space and try again"
        else:
            message = (
                f"the operating system reported an error{f' for {where}' if where else ''}: {error.strerror or error}"
            )
        code, reason = 1, "system_refused" if kind is StoreError else kind.code
    except MemoryError:
        code, message, reason = 1, _OUT_OF_MEMORY, "out_of_memory"
    except Exception as error:
        if isinstance(error, RuntimeError) and str(error) == "can't start new thread":  # no memory for its stack
            code, message, reason = 1, _OUT_OF_MEMORY, "out_of_memory"
        else:
            code, message, reason = 1, _internal_error(error), "internal_error"
    if reason and "--json" in given:
        print_json_error(reason, message)
    print(escaped(f"gsmap: {message}"), file=sys.stderr)
    sys.exit(code)


_OUT_OF_MEMORY = "there is not enough memory: close other programs, raise the limit, or use fewer workers"


def _internal_error(error: Exception) -> str:
    """Describe an unexpected error in one line, and write its traceback to a log file."""
    logging.getLogger("gsmap.cli").info("internal error", exc_info=error)  # shown with -v
    text = str(error).strip().partition("\n")[0]
    about = f"gsmap {__version__}, Python {platform.python_version()}, {platform.platform()}\n"
    trace = "".join(traceback.format_exception(error))
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="gsmap-error-", suffix=".log", encoding="utf-8", errors="backslashreplace", delete=False
        ) as log:
            log.write(about + trace)
    except OSError:
        print(escaped(trace, lines=True), file=sys.stderr, end="")
        return str(GsmapError(f"internal error: {type(error).__name__}: {text}"))
    where = f"Traceback: {log.name} (gsmap -v prints it)"
    return f"{GsmapError(f'internal error: {type(error).__name__}: {text}')}. {where}"
