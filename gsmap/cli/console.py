"""Print the output of verbs: data on stdout, progress and notes on stderr.

Names, notes and paths may come from untrusted files and maps, so all printed text passes `escaped`.
"""

from __future__ import annotations

import json as _json
import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmap.texts import escaped, shown

if TYPE_CHECKING:
    from gsmap.map import Map
    from gsmap.store.quarantine import QuarantineRecord
    from gsmap.types.progress import StageProgress
    from gsmap.types.rows.base import Row

MapPath = Annotated[
    str,
    typer.Argument(
        metavar="MAP",
        help="Folder of the map, such as site.gsmap, or site.gsmap@NAME for a branch or tag.",
        show_default=False,
    ),
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout; docs/reference/json.md lists its keys.")
]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=VALUE", help="Change a setting for this run; `gsmap settings MAP` lists them."),
]
AsOf = Annotated[
    str | None,
    typer.Option(
        "--as-of",
        metavar="DATE",
        help="Use only captures dated at or before this ISO 8601 time; a date without time includes the whole day.",
    ),
]
Preset = Annotated[str | None, typer.Option("--preset", help="Preset of settings for this run: `default` or `paper`.")]
Executor = Annotated[
    str | None,
    typer.Option(
        "--executor",
        help="Run jobs on this machine (`local`) or a cluster (`dask`); default: environment variable GSMAP_EXECUTOR.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="URL",
        help="Address of the Dask scheduler, tcp://HOST:8786; default: environment variable GSMAP_SCHEDULER.",
    ),
]


# --- notes and logs --------------------------------------------------------------------------------------------------


class _Stderr(logging.StreamHandler[Any]):
    """A log handler that writes to the current ``sys.stderr``, which progress bars replace while they are drawn."""

    def format(self, record: logging.LogRecord) -> str:
        return escaped(super().format(record), lines=True)

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)


def start_logging(verbose: int, quiet: bool) -> None:
    """Send the library's log (loggers ``gsmap.<room>``) to stderr, at the level of ``-q``, ``-v`` or ``-vv``."""
    logger = logging.getLogger("gsmap")
    logger.setLevel(logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)])
    if not any(isinstance(handler, _Stderr) for handler in logger.handlers):
        handler = _Stderr()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logger.addHandler(handler)
        logger.propagate = False


def say(text: str) -> None:
    """Print a note for the user on stderr, unless ``-q`` is given."""
    if logging.getLogger("gsmap").isEnabledFor(logging.WARNING):
        print(escaped(text), file=sys.stderr, flush=True)


def say_heights(rows: Sequence[Row]) -> None:
    """Print the CRS of the rows' world coordinates, with the unit and zero of their heights."""
    for crs, heights in dict.fromkeys((getattr(row, "crs", None), getattr(row, "heights", None)) for row in rows):
        if heights is None:
            continue
        say(f"world coordinates are in {crs}; heights are {heights}")


# --- data ------------------------------------------------------------------------------------------------------------


def print_rows(verb: str, rows: Row | Sequence[Row] | None, json: bool, title: str = "") -> None:
    """Print the rows of a verb on stdout, as one JSON object or as a table.

    Args:
        verb: Key of the verb in `gsmap.cli.objects.OBJECTS`.
        rows: Row or rows of the type declared there.
        title: Title of the table; default: the verb.
    """
    if json:
        print_json(json_object(verb, rows))
        return
    from gsmap.cli.objects import OBJECTS
    from gsmap.types.rows.base import Row

    many = [] if rows is None else [rows] if isinstance(rows, Row) else list(rows)
    print_table(title or verb, OBJECTS[verb].type.columns, many)


_has_printed_json = False
_MANY_ROWS = 500


def print_json(data: dict[str, Any]) -> None:
    """Print one JSON object on stdout."""
    global _has_printed_json
    _has_printed_json = True
    print(_json.dumps(data, indent=1, allow_nan=False), flush=True)


def print_json_error(code: str, message: str) -> None:
    """Print the JSON object of a failed command, unless the command has already printed its own object."""
    from gsmap.types.rows.base import SCHEMA

    if not _has_printed_json:
        print_json({"schema": SCHEMA, "error": {"code": code, "message": message}})


def expect_json() -> None:
    """Forget that JSON was printed, as a new command begins."""
    global _has_printed_json
    _has_printed_json = False


def json_object(verb: str, rows: Row | Sequence[Row] | None) -> dict[str, Any]:
    """Return the object that a verb prints with ``--json``."""
    from gsmap.cli.objects import OBJECTS, ManyRows, OptionalRow
    from gsmap.types.rows.base import SCHEMA, Row

    shape = OBJECTS[verb]
    for row in [rows] if isinstance(rows, Row) else rows or ():
        if type(row) is not shape.type:
            raise TypeError(f"{verb} prints {shape.type.__name__}, not {type(row).__name__}")
    if isinstance(rows, Row):
        data = rows.to_json()
        return {"schema": SCHEMA, **({shape.key: data} if isinstance(shape, OptionalRow) else data)}
    if isinstance(shape, ManyRows):
        return {"schema": SCHEMA, shape.key: [row.to_json() for row in rows or ()]}
    if isinstance(shape, OptionalRow):
        return {"schema": SCHEMA, shape.key: None}
    raise TypeError(f"{verb} prints one {shape.type.__name__}")


def print_table(title: str, columns: Mapping[str, str], rows: Sequence[Row]) -> None:
    """Print fields of rows as a table on stdout, with numbers right-aligned; a pipe gets all columns at full width."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from gsmap.types.notebook import cell_text

    table = Table(title=Text(escaped(title), "table.title"), title_justify="left", box=box.SIMPLE_HEAD)
    values = [[getattr(row, name) for name in columns] for row in rows]
    numeric = [
        any(isinstance(line[i], (int, float)) and not isinstance(line[i], bool) for line in values)
        for i in range(len(columns))
    ]
    cells = [[cell_text(name, value) for name, value in zip(columns, line, strict=True)] for line in values]
    if len(cells) > _MANY_ROWS:  # which rich draws at some milliseconds each
        _print_lines(escaped(title), list(columns.values()), cells, numeric)
        return
    for heading, is_numeric in zip(columns.values(), numeric, strict=True):
        table.add_column(heading, justify="right" if is_numeric else "left", overflow="fold")
    for texts in cells:
        table.add_row(*map(Text, texts))
    _print(table)


def _print_lines(title: str, headings: list[str], cells: list[list[str]], numeric: Sequence[bool]) -> None:
    """Print a table as `print_table`, without folding cells to the width of the terminal."""
    from rich.cells import cell_len

    lines = [headings, *cells]
    widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
    out = []
    for line in lines:
        padded = (
            " " * (width - cell_len(text)) + text if right else text + " " * (width - cell_len(text))
            for text, width, right in zip(line, widths, numeric, strict=True)
        )
        out.append(f"  {'   '.join(padded)}".rstrip())
    out.insert(1, f" {'─' * (sum(widths) + 3 * len(widths) - 1)}")
    print(title, *out, sep="\n")


def print_facts(title: str, facts: Mapping[str, Any]) -> None:
    """Print facts on stdout, one per line; leave out facts that are None or empty."""
    from rich.table import Table
    from rich.text import Text

    heading = Text(escaped(title), "table.title")
    table = Table(title=heading, title_justify="left", box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(overflow="fold")
    table.add_column(overflow="fold")
    for name, value in facts.items():
        if value is not None and shown(value) != "":
            table.add_row(Text(escaped(name)), Text(shown(value, lines=True)))
    _print(table)


def _print(table: Any) -> None:
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 200, highlight=False).print(table)


# --- maps ------------------------------------------------------------------------------------------------------------


@contextmanager
def opened(
    path: str,
    *,
    create: bool = False,
    bars: bool = False,
    sets: Sequence[str] | None = None,
    preset: str | None = None,
    executor: str | None = None,
    scheduler: str | None = None,
) -> Iterator[Map]:
    """Open a map for one verb.

    Args:
        path: Folder or URL of the map.
        create: Create the map if it is missing.
        bars: Show progress bars.
        sets, preset: Settings for this run, in the form of ``--set`` and ``--preset``.
        executor, scheduler: Executor of jobs and URL of the Dask scheduler.
    """
    import gsmap.map
    from gsmap.settings import parse

    values = dict(parse(one) for one in sets or ())
    if scheduler is not None:
        values |= {"engine.executors.dask.scheduler": scheduler, "engine.executor": "dask"}
    if executor is not None:
        values["engine.executor"] = executor
    open_map = gsmap.map.open_or_create if create else gsmap.map.open
    with progress_bars() if bars else _no_bars() as progress, open_map(path, progress=progress) as m:
        if values or preset is not None:
            m.with_settings(values, preset)
        yield m
        _left.extend(m.store.quarantine.encountered.values())


_left: list[QuarantineRecord] = []


def left() -> str:
    """Return a sentence on the jobs and captures that were quarantined since the last call; empty without any."""
    if not _left:
        return ""
    from gsmap.store.quarantine import CAPTURE

    captures = [one for one in _left if one.what.startswith(f"{CAPTURE} ")]
    jobs = len(_left) - len(captures)
    _left.clear()
    parts = [f"{len(captures)} capture{'s' * (len(captures) != 1)}"] if captures else []
    parts += [f"{jobs} job{'s' * (jobs != 1)}"] if jobs else []
    names = f" ({', '.join(one.about for one in captures)})" if captures else ""
    verb = "is" if len(captures) + jobs == 1 else "are"
    return f"{' and '.join(parts)} {verb} quarantined{names}: run gsmap status MAP for the reasons"


@contextmanager
def _no_bars() -> Iterator[None]:
    yield None


@contextmanager
def progress_bars() -> Iterator[StageProgress | None]:
    """Yield a callback that draws one progress bar per stage on stderr (plain lines in a pipe).

    Yields None with ``-q``, and with ``-v``, because the log then shows the progress.
    """
    if logging.getLogger("gsmap").getEffectiveLevel() != logging.WARNING:
        yield None
        return
    if not sys.stderr.isatty():
        yield _progress_lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    with Progress(
        TextColumn("{task.fields[stage]:<10}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
        console=Console(stderr=True),
    ) as bars:
        tasks: dict[str, TaskID] = {}

        def progress(stage: str, fraction: float, text: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task("", total=1.0, stage=stage)
            bars.update(tasks[stage], completed=fraction, description=escaped(text))

        yield progress


def _progress_lines() -> StageProgress:
    """Return a callback for pipes, which prints a line whenever the current work changes and when a stage ends."""
    last: dict[str, str] = {}

    def progress(stage: str, fraction: float, text: str = "") -> None:
        subject = text.split(":")[0].split(",")[0]
        if last.get(stage) == subject:
            return
        last[stage] = subject
        if subject:
            print(escaped(f"{stage}: {text}"), file=sys.stderr, flush=True)

    return progress
