"""The errors gsmap raises.

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

`of_system` tells which of them an error of the operating system is. A message says what is wrong, where, and what to
do, in one line. "No overlap", "ambiguous" and "not enough nodes" are results with a status and a reason, never errors.
"""

import errno

MALFORMED = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
"""What Python raises where parsed JSON or TOML is damaged, nested without end or of another shape than expected."""

_MAX_MESSAGE = 1000  # characters; beyond it a message quotes what somebody put into a file


class GsmapError(Exception):
    """Root of every error that gsmap raises on purpose; its message is one printable line, whatever it quotes."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(_one_line(arg) if isinstance(arg, str) else arg for arg in args))


def _one_line(text: str) -> str:
    """The text without control characters, and without its middle where it is long: what to do stands at its end."""
    if not text.isprintable():
        text = " ".join("".join(c if c.isprintable() or c.isspace() else "?" for c in text).split())
    return text if len(text) <= _MAX_MESSAGE else f"{text[:600]} ... {text[605 - _MAX_MESSAGE :]}"


class InputError(GsmapError, ValueError):
    """A file, array or argument cannot be used as given."""


class NotGaussiansError(InputError):
    """A sound file that holds something other than Gaussians, such as a point cloud or a mesh."""


class NotPinholesError(InputError):
    """Cameras of lenses that no pinhole stands for, such as panoramas and wide fisheyes."""


class ConfigError(GsmapError, ValueError):
    """An option, or a combination of options, makes no sense."""


class NotFoundError(GsmapError, LookupError):
    """A scene, edge, revision or file that is named does not exist."""


class StoreError(GsmapError):
    """The map on disk cannot be read or written."""


class CorruptError(StoreError):
    """Bytes on disk differ from what was written."""


class SchemaVersionError(StoreError):
    """The map was written by another version of gsmap."""


class BusyError(StoreError):
    """Another process holds the map."""


class DiskFullError(StoreError):
    """The disk, or a quota on it, is used up."""


class ReadOnlyError(StoreError):
    """The disk or the folder cannot be written."""


class DiskError(StoreError):
    """The disk failed: an I/O error."""


class MissingDependencyError(GsmapError, ImportError):
    """An optional package is not installed."""


def of_system(error: OSError) -> type[StoreError]:
    """Which error of ours an error of the operating system is, by its code."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFullError
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        return ReadOnlyError
    return DiskError if error.errno == errno.EIO else StoreError
