"""LAS and LAZ: integers with a scale and an offset, kept in float64; read by laspy (extra ``las``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmap.errors import InputError, MissingDependencyError
from gsmap.formats.scans.params import Params
from gsmap.formats.scans.points import scan_of
from gsmap.types.scan import Scan

_CHUNK = 1 << 20
_SIXTEEN_BITS, _EIGHT_BITS = 65535.0, 255.0


def read(path: Path, params: Params) -> Scan:
    """The points with their colours, about an origin near them.

    Raises:
        InputError: damaged, truncated, or a scale or offset that is no number.
        MissingDependencyError: laspy or lazrs is not installed.
    """
    try:
        import laspy
        import lazrs  # noqa: F401  # laspy reads no .laz without it, and says so obscurely
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: .las and .laz are read by laspy, which is not installed: pip install 'gsmap[las]'"
        ) from error

    try:
        with laspy.open(path) as reader:
            header = reader.header
            total, scales, offsets = int(header.point_count), np.array(header.scales), np.array(header.offsets)
            if not (np.isfinite(scales).all() and np.isfinite(offsets).all() and (scales > 0).all()):
                raise InputError(f"{path}: its scales {scales.tolist()} or offsets {offsets.tolist()} make no sense")
            is_packed = header.are_points_compressed
            _require_room(path, total, int(header.offset_to_point_data), int(header.point_format.size), is_packed)
            step = max(1, -(-total // params.max_points))
            raw, colours, seen = [], [], 0
            has_colour = {"red", "green", "blue"} <= set(header.point_format.dimension_names)
            for chunk in reader.chunk_iterator(_CHUNK):
                rows = slice(-seen % step, None, step)
                raw.append(np.stack([np.asarray(chunk[axis])[rows] for axis in "XYZ"], axis=1).astype(np.float64))
                if has_colour:
                    colours.append(np.stack([np.asarray(chunk[c])[rows] for c in ("red", "green", "blue")], axis=1))
                seen += len(chunk)
    except InputError:
        raise
    except Exception as error:  # laspy and lazrs raise what they meet: struct.error, LaspyException, panics of Rust
        raise InputError(f"{path} is not a LAS file that can be read: {type(error).__name__}: {error}") from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # of lazrs, which is no Exception
            raise
        raise InputError(f"{path} is a damaged LAZ file: {error}") from error
    counts = np.concatenate(raw) if raw else np.zeros((0, 3))
    if seen < total:
        raise InputError(f"{path} is truncated: its header promises {total:,} points, {seen:,} were found")
    # The integers are exact, and so is an origin that is one of them: nothing is lost to large coordinates.
    middle = np.round(np.median(counts, axis=0)) if len(counts) else np.zeros(3)
    points = (counts - middle) * scales
    seen_colours = _colours(np.concatenate(colours)) if has_colour and colours else None
    return scan_of(points, seen_colours, path, total, origin=middle * scales + offsets)


def _require_room(path: Path, total: int, offset: int, stride: int, is_packed: bool) -> None:
    """Refuse a header that promises more points than the file can hold.

    A packed point of a real scan takes more than a bit, however it is coded.
    """
    present = path.stat().st_size - offset
    if total <= 0:
        raise InputError(f"{path} has no points: there is nothing to look for")
    if total * stride > (present * 8 * stride if is_packed else present):
        raise InputError(
            f"{path} is truncated: its header promises {total:,} points of {stride} bytes, "
            f"but {max(0, present):,} bytes follow"
        )


def _colours(values: np.ndarray) -> np.ndarray | None:
    """(N, 3) in [0, 1]; None where the file has room for colours and none in it. Some writers fill 8 of the 16 bits."""
    most = int(values.max(initial=0))
    return None if most == 0 else values / (_SIXTEEN_BITS if most > _EIGHT_BITS else _EIGHT_BITS)
