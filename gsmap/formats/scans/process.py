"""Read files with libraries that may crash, in a separate process (`gsmap.formats.scans.child`)."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import threading
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.scans import child, limits

_MIB = 1 << 20


def read_in_process(path: Path, kind: str, params: limits.Params) -> dict[str, np.ndarray]:
    """Read a file with a library in a separate process, with limits on time and memory.

    Args:
        kind: ``cloud`` or ``mesh`` (open3d), ``las`` (laspy), or ``usd`` (usd-core).

    Raises:
        InputError: the library cannot read the file, or not within the limits.
    """
    end, out = os.pipe()
    command = [sys.executable, "-P", child.__file__, str(out), str(path.resolve()), kind]
    with os.fdopen(end, "rb") as pipe:
        process = subprocess.Popen(
            [*command, str(params.max_memory_mb * _MIB), str(limits.MAX_POINTS)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(out,),
            start_new_session=True,
        )
        os.close(out)
        try:
            output = _read_output(pipe, process, params, path)
        finally:
            process.kill()
            process.wait()
    try:
        with np.load(io.BytesIO(output), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(
            f"{path} cannot be read: the reading process failed, or needs more than {params.max_memory_mb} MB; the "
            "file is "
            "damaged or too large; convert it to a .ply",
            code="reader_failed",
        ) from error


def _read_output(pipe: Any, process: subprocess.Popen[bytes], params: limits.Params, path: Path) -> bytes:
    """Read all output of the reading process within the limits of time and size."""
    timer = threading.Timer(params.max_seconds, process.kill)
    timer.start()
    parts, size = [], 0
    try:
        while part := pipe.read(_MIB):
            parts.append(part)
            size += len(part)
            if size > params.max_memory_mb * _MIB:
                raise InputError(
                    f"{path} is larger than {params.max_memory_mb} MB in memory: thin it first", code="file_too_large"
                )
        if not timer.is_alive():
            raise InputError(
                f"{path} takes longer than {params.max_seconds:g} s to read: thin it first", code="file_too_large"
            )
    finally:
        timer.cancel()
    return b"".join(parts)
