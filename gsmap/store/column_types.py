"""Column types that validate their values, because a map may come from an untrusted source.

A value that gsmap cannot have written raises when its row is read, before it is used, and an invalid value raises
before it is written. Values in comparisons and in textual SQL are not validated.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from sqlalchemy import LargeBinary, Text
from sqlalchemy.types import TypeDecorator, TypeEngine

from gsmap.errors import MALFORMED, CorruptError, GsmapError, InputError
from gsmap.texts import control_characters

_DIGEST = re.compile(r"[0-9a-f]{32}|[0-9a-f]{64}")
_ARRAY_KIND = re.compile(r"(?!staging$)[a-z]{1,32}")


@lru_cache(maxsize=1 << 16)  # the same ids are read repeatedly
def is_digest(text: str) -> bool:
    """Return True for 32 or 64 hex digits."""
    return _DIGEST.fullmatch(text) is not None


def is_array_kind(text: str) -> bool:
    """Return True for the name of a kind of array groups, which is a folder beside ``arrays/staging``."""
    return _ARRAY_KIND.fullmatch(text) is not None


def is_relative(path: str) -> bool:
    """Return True for a relative path that leads downwards only: non-empty parts separated by ``/``, without ``.`` and
    ``..``."""
    parts = path.split("/")
    return not control_characters(path) and "\\" not in path and not any(part in ("", ".", "..") for part in parts)


class _CheckedText(TypeDecorator[Any]):
    """A text column whose values are validated."""

    impl = Text
    cache_ok = True
    what = "a text"
    is_required = False

    def __init__(self, where: str = "") -> None:
        super().__init__()
        self.where = where

    def for_column(self, where: str) -> _CheckedText:
        """Return a copy of this type that names its column (``table.column``) in messages."""
        made: _CheckedText = self.copy()
        made.where = where
        return made

    def is_valid(self, value: str) -> bool:
        raise NotImplementedError

    def process_bind_param(self, value: Any, dialect: Any) -> Any:
        if value is not None and not (isinstance(value, str) and self.is_valid(value)):
            raise InputError(f"{self.where} must be {self.what}, got {_short(value)}", code="invalid_column_value")
        return value

    def result_processor(self, dialect: Any, coltype: Any) -> Callable[[Any], Any] | None:
        # Instead of `process_result_value`: with millions of values, a wrapper call would take half of the time.
        is_valid, where, what, is_required = self.is_valid, self.where, self.what, self.is_required

        def checked(value: Any) -> Any:
            if (value is None and not is_required) or (isinstance(value, str) and is_valid(value)):
                return value
            raise corrupt_value(where, value, what)

        return checked

    def coerce_compared_value(self, op: Any, value: Any) -> TypeEngine[Any]:
        return Text()


class DigestText(_CheckedText):
    """32 or 64 hex digits."""

    cache_ok = True
    what = "32 or 64 hex digits"

    def is_valid(self, value: str) -> bool:
        return is_digest(value)


class KeyText(_CheckedText):
    """The key of a result, which is never used as a path: a digest, or empty."""

    cache_ok = True
    what = "a text without control characters"

    def is_valid(self, value: str) -> bool:
        return not control_characters(value)


class PairText(_CheckedText):
    """Two scene ids separated by a colon."""

    cache_ok = True
    what = "two digests separated by a colon"

    def is_valid(self, value: str) -> bool:
        return all(map(is_digest, value.split(":"))) and value.count(":") == 1


class SceneListText(_CheckedText):
    """Scene ids separated by spaces."""

    cache_ok = True
    what = "digests separated by spaces"

    def is_valid(self, value: str) -> bool:
        return all(map(is_digest, value.split(" ")))


class ArrayKindText(_CheckedText):
    """The kind of an array group: the name of a folder."""

    cache_ok = True
    what = "lower-case letters"

    def is_valid(self, value: str) -> bool:
        return is_array_kind(value)


class EnumText(_CheckedText):
    """One of a fixed set of words."""

    cache_ok = True

    def __init__(self, words: tuple[str, ...], where: str = "") -> None:
        super().__init__(where)
        self.words = words
        self.what = f"one of {', '.join(words)}"

    def is_valid(self, value: str) -> bool:
        return value in self.words


class RelativePathText(_CheckedText):
    """A relative path that leads downwards only; empty if there is no file."""

    cache_ok = True
    what = "a relative path inside the map"

    def is_valid(self, value: str) -> bool:
        return not value or is_relative(value)


class LineText(_CheckedText):
    """One line of text written by a person; not validated when read, but escaped when printed."""

    cache_ok = True
    what = "a text without control characters"
    lines = False

    def is_valid(self, value: str) -> bool:
        return not control_characters(value, lines=self.lines)

    def result_processor(self, dialect: Any, coltype: Any) -> None:
        return None


class MultilineText(LineText):
    """Lines of text written by a person."""

    cache_ok = True
    lines = True


class JsonText(TypeDecorator[Any]):
    """JSON in a text column: identical on every database, with exact floats and infinity.

    Args:
        fits: predicate for values that are read, one of the functions below; default: any value.
    """

    impl = Text
    cache_ok = True

    def __init__(self, fits: Callable[[Any], bool] | None = None, where: str = "") -> None:
        super().__init__()
        self.fits = fits
        self.where = where

    def for_column(self, where: str) -> JsonText:
        """Return a copy of this type that names its column (``table.column``) in messages."""
        made: JsonText = self.copy()
        made.where = where
        return made

    def process_bind_param(self, value: Any, dialect: Any) -> str | None:
        return None if value is None else json.dumps(value, separators=(",", ":"))

    def process_result_value(self, value: Any, dialect: Any) -> Any:
        if value is None:
            return None
        try:
            found = json.loads(value)
        except (ValueError, TypeError, RecursionError) as error:
            raise corrupt_value(self.where, value, "JSON") from error
        if self.fits is not None and not self.fits(found):
            raise corrupt_value(
                self.where, value, f"JSON of {self.fits.__name__.removeprefix('is_').replace('_', ' ')}"
            )
        return found


class PackedNumbers(TypeDecorator[Any]):
    """Numbers stored as bytes (`gsmap.store.matrices`), ten times as fast as JSON and in a third of its space.

    Args:
        pack: converts a value to bytes; bytes are stored as they are.
        unpack: converts bytes to a value; raises `InputError` for invalid bytes.
    """

    impl = LargeBinary
    cache_ok = True

    def __init__(self, pack: Callable[[Any], bytes], unpack: Callable[[bytes], Any], where: str = "") -> None:
        super().__init__()
        self.pack, self.unpack, self.where = pack, unpack, where

    def for_column(self, where: str) -> PackedNumbers:
        """Return a copy of this type that names its column (``table.column``) in messages."""
        made: PackedNumbers = self.copy()
        made.where = where
        return made

    def process_bind_param(self, value: Any, dialect: Any) -> bytes | None:
        return value if value is None or isinstance(value, bytes) else self.pack(value)

    def process_result_value(self, value: Any, dialect: Any) -> Any:
        if value is None:
            return None
        with malformed_as_corrupt(f"a value in {self.where}"):
            return self.unpack(bytes(value))


@contextmanager
def malformed_as_corrupt(what: str) -> Iterator[None]:
    """Raise `CorruptError` for errors while decoding a stored value.

    Args:
        what: description of the value and its row.
    """
    try:
        yield
    except (GsmapError, *MALFORMED, zlib.error) as error:
        raise CorruptError(
            f"the catalog holds {what} that is invalid ({error}) and that gsmap did not write: restore the catalog "
            "from a backup, and do not trust the map if you received it like this",
            code="catalog_invalid",
        ) from error


def is_object(value: Any) -> bool:
    return isinstance(value, dict)


def is_text_list(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def is_direction(value: Any) -> bool:
    return _numbers(value, 3)


def is_number_dict(value: Any) -> bool:
    """Return True for a dict of numbers."""
    return isinstance(value, dict) and all(_numbers(item) for item in value.values())


def is_sigmas(value: Any) -> bool:
    return _numbers(value, 7)


def is_box(value: Any) -> bool:
    return _numbers(value, 2, 3)


def is_pose(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _numbers(value.get("rotation"), 3, 3)
        and _numbers(value.get("translation"), 3)
        and _numbers(value.get("scale"))
    )


def is_world_ties(value: Any) -> bool:
    """Return True for a list of world ties; `gsmap.store.world_ties` validates the rest."""
    return isinstance(value, list) and all(
        isinstance(one, dict) and isinstance(one.get("component"), int) for one in value
    )


def is_poses_by_scene(value: Any) -> bool:
    return isinstance(value, dict) and all(is_digest(scene) and is_pose(pose) for scene, pose in value.items())


def is_thinning(value: Any) -> bool:
    """Return True for the record of a thinned scene."""
    return (
        isinstance(value, dict)
        and isinstance(value.get("at"), str)
        and isinstance(value.get("num_gaussians"), int)
        and (value.get("up") is None or is_direction(value["up"]))
    )


def is_graph(value: Any) -> bool:
    """Return True for the metadata of a scene graph."""
    if not isinstance(value, dict) or not isinstance(value.get("layers"), dict):
        return False
    layers, things = value["layers"].values(), value.get("things", {"count": 0, "unit_m": 1.0})
    return (
        (value.get("up") is None or is_direction(value["up"]))
        and _numbers(value.get("unit_m"))
        and _numbers(value.get("working_m", 1.0))
        and is_text_list(value.get("notes"))
        and isinstance(things, dict)
        and isinstance(things.get("count"), int)
        and _kept_arrays(value.get("arrays", {}))
        and _numbers(things.get("unit_m"))
        and all(isinstance(x, dict) and isinstance(x.get("count"), int) and is_object(x.get("rest")) for x in layers)
    )


def _kept_arrays(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(how, dict) for how in value.values())


def is_index_segment(value: Any) -> bool:
    """Return True for the metadata of an index segment."""
    members = value.get("members") if isinstance(value, dict) else None
    return isinstance(members, list) and all(
        isinstance(one, list)
        and len(one) == 5
        and all(isinstance(text, str) and is_digest(text) for text in one[:2])
        and all(isinstance(flag, bool) for flag in one[2:4])
        and _numbers(one[4])
        and one[4] > 0
        for one in members
    )


def is_object_set(value: Any) -> bool:
    """Return True for the metadata of an object set; `gsmap.store.objects` validates the rest."""
    return isinstance(value, dict) and is_poses_by_scene(value.get("poses"))


def is_counts(value: Any) -> bool:
    """Return True for a dict of numbers that are not negative."""
    return is_number_dict(value) and all(number >= 0 for number in value.values())


def is_candidate_list(value: Any) -> bool:
    """Return True for the candidates of a lookup."""
    return isinstance(value, list) and all(
        isinstance(one, list)
        and len(one) == 3
        and isinstance(one[0], str)
        and is_digest(one[0])
        and _numbers(one[1:], 2)
        for one in value
    )


def _numbers(value: Any, *shape: int) -> bool:
    if not shape:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    return isinstance(value, list) and len(value) == shape[0] and all(_numbers(item, *shape[1:]) for item in value)


def corrupt_value(where: str, value: Any, what: str) -> CorruptError:
    """Return the error for a stored value that gsmap cannot have written."""
    return CorruptError(
        f"the catalog holds {_short(value)} in {where}, which is not {what} and which gsmap did not write: "
        "restore the catalog from a backup, and do not trust the map if you received it like this",
        code="catalog_invalid",
    )


def _short(value: Any) -> str:
    """Quote a value for a message, shortened."""
    quoted = repr(value)
    return quoted if len(quoted) <= 60 else f"{quoted[:57]}..."
