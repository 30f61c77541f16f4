"""The errors that gsmap raises.

::

    GsmapError
    ├── InputError (ValueError)            a file, array or argument cannot be used as given
    │   └── NotGaussiansError              a sound file that holds something other than Gaussians
    ├── ConfigError (ValueError)           an option or combination of options makes no sense
    ├── NotFoundError (LookupError)        a scene, edge, revision or file that is named does not exist
    ├── StoreError                         the map on disk
    │   ├── CorruptError                   bytes differ from what was written
    │   ├── SchemaVersionError             the map was made by another version of gsmap
    │   ├── BusyError                      another process holds the map
    │   ├── DiskFullError                  the disk, or a quota, is used up
    │   ├── ReadOnlyError                  the disk or the folder cannot be written
    │   └── DiskError                      the disk failed: an I/O error
    └── MissingDependencyError (ImportError)   an optional package is not installed

`of_system` maps an error of the operating system to one of them. A message states what is wrong, where, and what to do,
in one line; `GsmapError.code` names the cause for programs. "No overlap", "ambiguous" and "not enough nodes" are
results with a status and a reason, never errors.
"""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

from gsmap.version import DISTRIBUTION

MALFORMED = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
"""Exceptions that Python raises for JSON or TOML that is damaged, too deeply nested, or of another structure."""

_MAX_MESSAGE = 1000  # characters; longer messages quote the content of a file


class GsmapError(Exception):
    """Base class of all errors that gsmap raises on purpose; its message is one printable line, whatever it quotes.

    Args:
        args: the message.
        code: the cause in lower_snake_case for programs, listed in docs/reference/json.md; default: that of the
            class. Codes stay as they are from version to version, messages do not.
    """

    code = "error"

    def __init__(self, *args: object, code: str | None = None) -> None:
        super().__init__(*(_one_line(arg) if isinstance(arg, str) else arg for arg in args))
        if code is not None:
            self.code = code  # an attribute of the instance, which pickling keeps

    def __str__(self) -> str:
        """Return the message; it names options as the command line does there, and as arguments elsewhere."""
        text = super().__str__()
        return text if _names_options else with_arguments(text)


_names_options = False


@contextmanager
def on_command_line() -> Iterator[None]:
    """Let messages of this process name options as they are typed."""
    global _names_options
    before, _names_options = _names_options, True
    try:
        yield
    finally:
        _names_options = before


# A command to type stays as it is, up to the end of its clause.
_OPTION = re.compile(r"\b(?:gsmap|pyproj|pip) [a-z](?:(?![:;,] |\)).)*|--set ([\w.]+)=([^\s,;)]+)|--([a-z][a-z0-9-]*)")
_ARGUMENTS = {  # options whose argument of `gsmap.map.Map` is called otherwise
    "budget": "budget_bytes",
    "from": "source",
    "photo-size": "photo_size_px",
    "scale-bar": "bars",
    "tile-size": "tile_size_m",
}


def with_arguments(text: str) -> str:
    """Return a message with arguments in place of options: ``masks=`` for ``--masks``."""

    def argument(found: re.Match[str]) -> str:
        if found[1]:
            return f"with_settings({{{found[1]!r}: {found[2]!r}}})"
        if found[3]:
            return f"{_ARGUMENTS.get(found[3], found[3].replace('-', '_'))}="
        return found[0]

    return _OPTION.sub(argument, text)


def _one_line(text: str) -> str:
    """Return a text without control characters; shorten a long text in its middle, as its end states what to do."""
    if not text.isprintable():
        text = " ".join("".join(c if c.isprintable() or c.isspace() else "?" for c in text).split())
    return text if len(text) <= _MAX_MESSAGE else f"{text[:600]} ... {text[605 - _MAX_MESSAGE :]}"


class InputError(GsmapError, ValueError):
    """A file, an array or an argument is invalid."""

    code = "input"


class NotGaussiansError(InputError):
    """A valid file holds something other than Gaussians, such as a point cloud or a mesh."""

    code = "not_gaussians"


class NotPinholesError(InputError):
    """The cameras have lenses that no pinhole camera approximates, such as panoramas and wide fisheyes."""

    code = "not_pinholes"


class ConfigError(GsmapError, ValueError):
    """An option, a setting or a combination of them is invalid."""

    code = "config"


class NotFoundError(GsmapError, LookupError):
    """A scene, edge, revision or file that the user named does not exist."""

    code = "not_found"


class StoreError(GsmapError):
    """The map on disk cannot be read or written."""

    code = "store"


class CorruptError(StoreError):
    """Bytes on disk differ from what was written."""

    code = "corrupt"


class SchemaVersionError(StoreError):
    """The map was written by another version of gsmap."""

    code = "schema_version"


class BusyError(StoreError):
    """Another process holds the map."""

    code = "busy"


class DiskFullError(StoreError):
    """The disk or the user's quota on it is full."""

    code = "disk_full"


class ReadOnlyError(StoreError):
    """The disk or the folder does not permit writing."""

    code = "read_only"


class DiskError(StoreError):
    """The disk failed with an I/O error."""

    code = "disk_failed"


class MissingDependencyError(GsmapError, ImportError):
    """An optional package is not installed.

    Args:
        args: the message.
        extra: the extra of gsmap that installs the package; the command that does so ends the message.
    """

    code = "missing_dependency"

    def __init__(self, *args: object, extra: str | None = None, code: str | None = None) -> None:
        if extra is not None:
            args = (f"{args[0]}: pip install '{DISTRIBUTION}[{extra}]'", *args[1:])
        super().__init__(*args, code=code)


def failed_path(error: OSError) -> str | None:
    """Return the path at which a system call failed; None if the error names none.

    A failed copy names its source first: a full disk is that of the target.
    """
    names = [name for name in (error.filename, error.filename2) if isinstance(name, (str, bytes))]
    if not names:
        return None
    return os.fsdecode(names[-1] if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS) else names[0])


def of_system(error: OSError) -> type[StoreError]:
    """Return the error class that an error of the operating system is converted to, by its number."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFullError
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        return ReadOnlyError
    return DiskError if error.errno == errno.EIO else StoreError
