"""Print the output of verbs: data on stdout, progress and notes on stderr.

Names, notes and paths may come from untrusted files and maps, so all printed text passes `escaped`.
"""

from __future__ import annotations

import itertools
import json as _json
import logging
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
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


@dataclass(frozen=True)
class Output:
    """The JSON object that a verb prints with ``--json``: ``schema`` and the fields of a row, or rows under a key.

    Args:
        row: Module and class in `gsmap.types.rows`; a verb loads only the row classes that it prints.
        key: Key of a list of rows, or of a row or null; empty for the fields of one row.
        is_list: The key holds a list.
    """

    row: str
    key: str = ""
    is_list: bool = True

    @property
    def row_type(self) -> type[Row]:
        module, name = self.row.split(".")
        found: type[Row] = getattr(import_module(f"gsmap.types.rows.{module}"), name)
        return found


def output_of(verb: str) -> Output:
    """Return the output of a verb, or of one of its forms, such as ``list scenes``, by `OUTPUTS` of its file."""
    found: Output = import_module(f"gsmap.cli.{verb.split()[0].replace('-', '_')}").OUTPUTS[verb]
    return found


def print_rows(verb: str, rows: Row | Sequence[Row] | None, json: bool, title: str = "") -> None:
    """Print the rows of a verb on stdout, as one JSON object or as a table.

    Args:
        verb: Key in `OUTPUTS` of the verb's file.
        rows: Row or rows of the type declared there.
        title: Title of the table; default: the verb.
    """
    if json:
        print_json(json_object(verb, rows))
        return
    from gsmap.types.rows.base import Row

    many = [] if rows is None else [rows] if isinstance(rows, Row) else list(rows)
    print_table(title or verb, output_of(verb).row_type.columns, many)


_has_printed_json = _has_printed_table = False


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


def begin_output() -> None:
    """Forget what was printed, as a new command begins."""
    global _has_printed_json, _has_printed_table
    _has_printed_json = _has_printed_table = False


def json_object(verb: str, rows: Row | Sequence[Row] | None) -> dict[str, Any]:
    """Return the object that a verb prints with ``--json``."""
    from gsmap.types.rows.base import SCHEMA, Row

    output, many = output_of(verb), [rows] if isinstance(rows, Row) else list(rows or ())
    for row in many:
        if type(row) is not output.row_type:
            raise TypeError(f"{verb} prints {output.row_type.__name__}, not {type(row).__name__}")
    data = [row.to_json() for row in many]
    if output.key:
        return {"schema": SCHEMA, output.key: data if output.is_list else data[0] if data else None}
    if len(data) != 1:
        raise TypeError(f"{verb} prints one {output.row_type.__name__}")
    return {"schema": SCHEMA, **data[0]}


def print_table(title: str, columns: Mapping[str, str], rows: Sequence[Row]) -> None:
    """Print fields of rows as a table on stdout.

    A terminal gets a table that fits its width: sentences are wrapped between words, and columns that have no room are
    left out, which a note says. ``--wide`` prints all columns at full width. A pipe or file gets lines of values
    separated by tabs, headings first; before each table but the first an empty line and ``# title``.
    """
    from gsmap.texts import cell_text

    global _has_printed_table

    values = [[getattr(row, name) for name in columns] for row in rows]
    cells = [[cell_text(name, value) for name, value in zip(columns, line, strict=True)] for line in values]
    headings = list(columns.values())
    if not (_is_wide or sys.stdout.isatty()):
        if _has_printed_table:
            print(f"\n# {escaped(title)}")
        _has_printed_table = True
        print(*("\t".join(line) for line in (headings, *cells)), sep="\n", flush=True)
        return
    numeric = [
        any(isinstance(line[i], (int, float)) and not isinstance(line[i], bool) for line in values)
        for i in range(len(columns))
    ]
    shown_columns, widths = list(range(len(headings))), None
    if not _is_wide:
        shown_columns, widths = _fitting(headings, cells, shutil.get_terminal_size().columns)
    chosen = [[line[i] for i in shown_columns] for line in (headings, *cells)]
    _print_lines(escaped(title), chosen, widths or _widths(chosen), [numeric[i] for i in shown_columns])
    left_out = [heading for i, heading in enumerate(headings) if i not in shown_columns]
    if left_out:
        say(f"no room for {', '.join(left_out)}: gsmap --wide {' '.join(sys.argv[1:2])} prints all columns")


_is_wide = False


def print_wide_tables(wide: bool) -> None:
    """Choose whether tables are printed with all columns at full width, wherever they go (``--wide``)."""
    global _is_wide
    _is_wide = wide


_INDENT, _GAP = 2, 3  # of tables, in characters
_MIN_SENTENCE = 20  # characters of a wrapped column, at least


def _widths(lines: Sequence[Sequence[str]]) -> list[int]:
    from rich.cells import cell_len

    return [max(map(cell_len, column)) for column in zip(*lines, strict=True)]


def _fitting(headings: Sequence[str], cells: Sequence[Sequence[str]], width: int) -> tuple[list[int], list[int]]:
    """Return the columns of a table that fit a width, and their widths.

    Columns with sentences are narrowed first, but not below their longest word; then columns are left out from the
    right, those with sentences last, and never the first.
    """
    natural = _widths([headings, *cells])
    least = list(natural)
    for i in range(1, len(headings)):
        texts = [heading_and_cells[i] for heading_and_cells in (headings, *cells)]
        if any(" " in text for text in texts[1:]):
            words = _widths([[word] for text in texts for word in text.split() or [""]])[0]
            least[i] = min(natural[i], max(words, _MIN_SENTENCE))
    kept = list(range(len(headings)))
    while len(kept) > 1 and _total([least[i] for i in kept]) > width:
        plain = [i for i in kept[1:] if least[i] == natural[i]]
        kept.remove(plain[-1] if plain else kept[-1])
    widths = {i: least[i] for i in kept}
    room = width - _total(list(widths.values()))
    for i in sorted(kept, key=lambda i: natural[i] - least[i]):
        share = min(natural[i] - least[i], max(room, 0))
        widths[i], room = widths[i] + share, room - share
    return kept, [widths[i] for i in kept]


def _total(widths: Sequence[int]) -> int:
    return _INDENT + sum(widths) + _GAP * (len(widths) - 1)


def _print_lines(title: str, lines: Sequence[Sequence[str]], widths: Sequence[int], numeric: Sequence[bool]) -> None:
    """Print a table, headings first, with numbers right-aligned and longer texts wrapped between words."""
    from rich.cells import cell_len

    out = []
    for number, line in enumerate(lines):
        wrapped = [
            [text]
            if cell_len(text) <= width
            else textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)
            for text, width in zip(line, widths, strict=True)
        ]
        for part in itertools.zip_longest(*wrapped, fillvalue=""):
            padded = (
                " " * (width - cell_len(text)) + text if right else text + " " * (width - cell_len(text))
                for text, width, right in zip(part, widths, numeric, strict=True)
            )
            out.append(f"{' ' * _INDENT}{(' ' * _GAP).join(padded)}".rstrip())
        if number == 0:
            out.append(f" {'─' * (_total(widths) - _INDENT + 1)}")
    print(title, *out, sep="\n", flush=True)


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


def refuse_options(context: typer.Context, options: Sequence[str], what: str) -> None:
    """Raise an error for the first of these options that a command was given."""
    from gsmap.errors import ConfigError

    values = ((one.opts, context.params[str(one.name)]) for one in context.command.params)
    names = {name for opts, value in values if value is not None and value is not False for name in opts}
    if useless := [option for option in options if option in names]:
        raise ConfigError(f"{useless[0]} does not apply to {what}", code="conflicting_options")


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
