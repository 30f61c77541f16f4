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

`of_system` maps an error of the operating system to one of them. A message states what is wrong, where, and what to do,
in one line; `GsmapError.code` names the cause for programs. "No overlap", "ambiguous" and "not enough nodes" are
results with a status and a reason, never errors.
"""

import errno

MALFORMED = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
"""What Python raises where parsed JSON or TOML is damaged, nested without end or of another shape than expected."""

_MAX_MESSAGE = 1000  # characters; longer messages quote the content of a file


class GsmapError(Exception):
    """Root of every error that gsmap raises on purpose; its message is one printable line, whatever it quotes.

    Args:
        args: the message.
        code: the cause in lower_snake_case for programs, a key of `gsmap.reason_codes.ERRORS`; default: that of the
            class. Codes stay as they are from version to version, messages do not.
    """

    code = "error"

    def __init__(self, *args: object, code: str | None = None) -> None:
        super().__init__(*(_one_line(arg) if isinstance(arg, str) else arg for arg in args))
        if code is not None:
            self.code = code  # an attribute of the instance, which pickling keeps


def _one_line(text: str) -> str:
    """The text without control characters, and without its middle where it is long: what to do stands at its end."""
    if not text.isprintable():
        text = " ".join("".join(c if c.isprintable() or c.isspace() else "?" for c in text).split())
    return text if len(text) <= _MAX_MESSAGE else f"{text[:600]} ... {text[605 - _MAX_MESSAGE :]}"


class InputError(GsmapError, ValueError):
    """A file, array or argument cannot be used as given."""

    code = "input"


class NotGaussiansError(InputError):
    """A sound file that holds something other than Gaussians, such as a point cloud or a mesh."""

    code = "not_gaussians"


class NotPinholesError(InputError):
    """Cameras of lenses that no pinhole stands for, such as panoramas and wide fisheyes."""

    code = "not_pinholes"


class ConfigError(GsmapError, ValueError):
    """An option, or a combination of options, makes no sense."""

    code = "config"


class NotFoundError(GsmapError, LookupError):
    """A scene, edge, revision or file that is named does not exist."""

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
    """The disk, or a quota on it, is used up."""

    code = "disk_full"


class ReadOnlyError(StoreError):
    """The disk or the folder cannot be written."""

    code = "read_only"


class DiskError(StoreError):
    """The disk failed: an I/O error."""

    code = "disk_failed"


class MissingDependencyError(GsmapError, ImportError):
    """An optional package is not installed."""

    code = "missing_dependency"


def of_system(error: OSError) -> type[StoreError]:
    """Return the class of error that an error of the operating system becomes, by its code."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFullError
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        return ReadOnlyError
    return DiskError if error.errno == errno.EIO else StoreError
