"""Shared parts of the tools: arguments, CPU time and memory, notes and tables."""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")


def argument_parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is the docstring of the tool."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def cpu_s() -> float:
    """Return the CPU seconds, user and system, of this process and of those that it started and that ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def timed(function: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> tuple[_T, float]:
    """Call a function; return its result and the CPU seconds of the call (`cpu_s`)."""
    began = cpu_s()
    result = function(*args, **kwargs)
    return result, cpu_s() - began


def peak_mb() -> float:
    """Return the most memory, in MiB, that this process or the largest of its ended children has held."""
    return max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024


def say(text: str) -> None:
    """Print a note on stderr, beside the figures on stdout."""
    print(text, file=sys.stderr, flush=True)


def print_table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print rows under their heads: the first column on the left, the others on the right, None as a dash."""
    lines = [list(heads), *(["-" if cell is None else str(cell) for cell in row] for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]
    for first, *others in lines:
        print(
            "  ".join([first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(others, widths[1:], strict=True))]).rstrip()
        )
