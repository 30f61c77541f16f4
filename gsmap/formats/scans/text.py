"""Read point clouds as text (``.xyz``): one point per line, ``x y z`` with or without ``r g b`` after it."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.scans import limits
from gsmap.formats.scans.points import scan_of
from gsmap.types.scan import Scan

_MAX_HEAD_LINES = 20
_MOST_BYTES = 4 << 30  # beyond it a text takes longer to read than anybody waits
_BYTE = 255.0
_COLOUR_STARTS = {4: (1, 0), 6: (0, 3, 1)}  # by the number of columns after x y z: intensity first, and normals first


def read(path: Path) -> Scan:
    """Read points from the first three columns. Three more columns of whole numbers from 0 to 255, directly after the
    point, after an intensity or after a normal, are the colour; of four such columns, those that are most alike.
    Spaces, commas or semicolons separate columns; lines before the first point, and lines that begin with ``#`` or
    ``//``, are skipped.

    Raises:
        InputError: no numbers, fewer than three in a line, or lines of different lengths.
    """
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(
            f"{path} is larger than {_MOST_BYTES >> 30} GiB of text: convert it to .ply or .laz first",
            code="file_too_large",
        )
    skip, split, width = _layout(path)
    with open(path, encoding="utf-8", errors="replace") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lines = (split.sub(" ", line.replace("//", "#")) for line in file)
        try:
            rows = np.loadtxt(lines, np.float64, comments="#", skiprows=skip, ndmin=2)
        except ValueError as error:
            raise InputError(
                f"{path}: its rows cannot be read as {width} numbers each: {error}", code="invalid_row"
            ) from error
    total = len(rows)
    rows = rows[:: -(-total // limits.MAX_POINTS)] if total else rows
    points, rest = rows[:, :3], rows[:, 3:]
    notes: tuple[str, ...] = ()
    starts = _COLOUR_STARTS.get(rest.shape[1], (0, 1, 3))
    found = [c for k in starts if _are_bytes(c := rest[:, k : k + 3])]
    # Where an intensity and a class are bytes, too: the channels of a colour are alike.
    colours = max(found, key=_likeness) if len(found) > 1 and rest.shape[1] == 4 else next(iter(found), None)
    if colours is None and rest.shape[1]:
        notes = (f"no colours from 0 to 255 were found in columns 4 to {3 + rest.shape[1]}, which were not used",)
    elif colours is not None and rest.shape[1] == 4 and len(found) > 1:
        first = 4 if np.array_equal(colours, rest[:, :3]) else 5
        notes = (f"columns {first} to {first + 2} of 4 to 7 were read as the colour",)
    return scan_of(points, None if colours is None else colours / _BYTE, path, total, notes=notes)


def _layout(path: Path) -> tuple[int, re.Pattern[str], int]:
    """Return the number of lines before the first point, the separator of columns, and the number of columns."""
    split = re.compile(r"[,;\t]")
    with open(path, encoding="utf-8", errors="replace") as file:
        for number in range(_MAX_HEAD_LINES):
            line = file.readline(4096)
            if not line:
                break
            words = split.sub(" ", line.partition("#")[0].partition("//")[0]).split()
            try:
                numbers = [float(word) for word in words]
            except ValueError:
                continue
            if len(numbers) >= 3:
                return number, split, len(numbers)
            if len(numbers) not in (0, 1):  # a count in the first line is common
                raise InputError(
                    f"{path}: line {number + 1} has {len(numbers)} numbers, but a point needs x, y and z",
                    code="invalid_line",
                )
    raise InputError(
        f"{path} has no point in its first lines: a .xyz needs x y z in every line, with or without r g b after them",
        code="wrong_file_type",
    )


def _likeness(values: np.ndarray) -> float:
    """Return the mean correlation of three columns, 0 where one is constant."""
    some = values[:: -(-len(values) // 100_000)]
    if len(some) < 2 or (np.ptp(some, axis=0) == 0).any():
        return 0.0
    return float(np.corrcoef(some.T)[np.triu_indices(3, 1)].mean())


def _are_bytes(values: np.ndarray) -> bool:
    """Return true for colours in [0, 255]: integers that are not all 0 or 1, as normals would be."""
    if values.shape[1] < 3 or not len(values):
        return False
    whole = np.isfinite(values).all() and (values == np.round(values)).all()
    return bool(whole and values.min() >= 0 and 1 < values.max() <= _BYTE)
