"""Column types that check what they hold: a map may come from a stranger, and rows become paths, keys and text.

A value that gsmap cannot have written raises where its row is read, before anything is done with it, and one that it
must not write raises before it is written. Values that are only compared with are not checked, and neither is what
passes by the tables: SQL given as text.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from sqlalchemy import LargeBinary, Text
from sqlalchemy.types import TypeDecorator, TypeEngine

from gsmap.errors import CorruptError, GsmapError, InputError
from gsmap.texts import control_characters

_DIGEST = re.compile(r"[0-9a-f]{32}|[0-9a-f]{64}")
KINDS = ("scenes", "graphs", "changes", "indexes", "views", "photos")
"""Of groups of arrays: the folders below ``arrays``."""


@lru_cache(maxsize=1 << 16)  # the same ids are read again and again
def is_digest(text: str) -> bool:
    """Whether a text is 32 or 64 hex digits."""
    return _DIGEST.fullmatch(text) is not None


def is_relative(path: str) -> bool:
    """Whether a path leads downwards only: parts with ``/`` between them, none empty, ``.`` or ``..``."""
    parts = path.split("/")
    return not control_characters(path) and "\\" not in path and not any(part in ("", ".", "..") for part in parts)


class _Checked(TypeDecorator[Any]):
    """A text column whose values are checked."""

    impl = Text
    cache_ok = True
    what = "a text"

    def __init__(self, where: str = "") -> None:
        super().__init__()
        self.where = where

    def at(self, where: str) -> _Checked:
        """The same type, knowing its column (``table.column``)."""
        made: _Checked = self.copy()
        made.where = where
        return made

    def fits(self, value: str) -> bool:
        raise NotImplementedError

    def process_bind_param(self, value: Any, dialect: Any) -> Any:
        if value is not None and not (isinstance(value, str) and self.fits(value)):
            raise InputError(f"{self.where} must be {self.what}, got {_short(value)}", code="invalid_column_value")
        return value

    def result_processor(self, dialect: Any, coltype: Any) -> Callable[[Any], Any] | None:
        # In place of `process_result_value`: a map has millions of values, and a call around each is half its cost.
        fits, where, what = self.fits, self.where, self.what

        def checked(value: Any) -> Any:
            if value is None or (isinstance(value, str) and fits(value)):
                return value
            raise corrupt(where, value, what)

        return checked

    def coerce_compared_value(self, op: Any, value: Any) -> TypeEngine[Any]:
        return Text()


class Digest(_Checked):
    """32 or 64 hex digits."""

    cache_ok = True
    what = "32 or 64 hex digits"

    def fits(self, value: str) -> bool:
        return is_digest(value)


class Key(_Checked):
    """What a result is kept under: compared and shown, never a path. A digest today; schema 0001 had other words."""

    cache_ok = True
    what = "a text without control characters"

    def fits(self, value: str) -> bool:
        return not control_characters(value)


class Pair(_Checked):
    """Two scene ids with a colon between them."""

    cache_ok = True
    what = "two digests with a colon between them"

    def fits(self, value: str) -> bool:
        return all(map(is_digest, value.split(":"))) and value.count(":") == 1


class Kind(_Checked):
    """The kind of a group of arrays: the name of a folder."""

    cache_ok = True
    what = " or ".join(KINDS)

    def fits(self, value: str) -> bool:
        return value in KINDS


class Word(_Checked):
    """One of a few words."""

    cache_ok = True

    def __init__(self, words: tuple[str, ...], where: str = "") -> None:
        super().__init__(where)
        self.words = words
        self.what = f"one of {', '.join(words)}"

    def fits(self, value: str) -> bool:
        return value in self.words


class RelativePath(_Checked):
    """A path that leads downwards only; empty where there is no file."""

    cache_ok = True
    what = "a path that stays inside"

    def fits(self, value: str) -> bool:
        return not value or is_relative(value)


class Line(_Checked):
    """What a person wrote, on one line. Read as it is: it is escaped where it is printed."""

    cache_ok = True
    what = "a text without control characters"
    lines = False

    def fits(self, value: str) -> bool:
        return not control_characters(value, lines=self.lines)

    def result_processor(self, dialect: Any, coltype: Any) -> None:
        return None


class Lines(Line):
    """What a person wrote, on any number of lines."""

    cache_ok = True
    lines = True


class Json(TypeDecorator[Any]):
    """JSON in a text column: the same on every database, floats to the last bit, infinity allowed.

    Args:
        fits: what a value that is read must be, one of the functions below; anything where None.
    """

    impl = Text
    cache_ok = True

    def __init__(self, fits: Callable[[Any], bool] | None = None, where: str = "") -> None:
        super().__init__()
        self.fits = fits
        self.where = where

    def at(self, where: str) -> Json:
        """The same type, knowing its column (``table.column``)."""
        made: Json = self.copy()
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
            raise corrupt(self.where, value, "JSON") from error
        if self.fits is not None and not self.fits(found):
            raise corrupt(self.where, value, f"JSON of {self.fits.__name__.strip('_').replace('_', ' ')}")
        return found


class Numbers(TypeDecorator[Any]):
    """Numbers as bytes (`gsmap.store.matrices`): a tenth of the time of JSON, a third of the room.

    Args:
        pack: the bytes of a value; bytes are taken as they are.
        unpack: the value of bytes; raises `InputError` where they are none.
    """

    impl = LargeBinary
    cache_ok = True

    def __init__(self, pack: Callable[[Any], bytes], unpack: Callable[[bytes], Any], where: str = "") -> None:
        super().__init__()
        self.pack, self.unpack, self.where = pack, unpack, where

    def at(self, where: str) -> Numbers:
        """The same type, knowing its column (``table.column``)."""
        made: Numbers = self.copy()
        made.where = where
        return made

    def process_bind_param(self, value: Any, dialect: Any) -> bytes | None:
        return value if value is None or isinstance(value, bytes) else self.pack(value)

    def process_result_value(self, value: Any, dialect: Any) -> Any:
        if value is None:
            return None
        with not_ours(self.where):
            return self.unpack(bytes(value))


@contextmanager
def not_ours(where: str) -> Iterator[None]:
    """Let bytes of a column that are no numbers of gsmap's be told as such."""
    try:
        yield
    except GsmapError as error:
        raise CorruptError(
            f"the catalog holds bytes in {where} that are none of its numbers ({error}): gsmap did not write that; "
            "restore the catalog from a backup, and do not trust a map that was sent to you so",
            code="catalog_invalid",
        ) from error


def an_object(value: Any) -> bool:
    return isinstance(value, dict)


def texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def a_direction(value: Any) -> bool:
    return _numbers(value, 3)


def numbers(value: Any) -> bool:
    """Numbers by name."""
    return isinstance(value, dict) and all(_numbers(item) for item in value.values())


def sigmas(value: Any) -> bool:
    return _numbers(value, 7)


def a_box(value: Any) -> bool:
    return _numbers(value, 2, 3)


def a_pose(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _numbers(value.get("rotation"), 3, 3)
        and _numbers(value.get("translation"), 3)
        and _numbers(value.get("scale"))
    )


def ties(value: Any) -> bool:
    """Where components lie in the world; `gsmap.store.ties` looks further."""
    return isinstance(value, list) and all(
        isinstance(one, dict) and isinstance(one.get("component"), int) for one in value
    )


def poses_by_scene(value: Any) -> bool:
    return isinstance(value, dict) and all(is_digest(scene) and a_pose(pose) for scene, pose in value.items())


def a_thinning(value: Any) -> bool:
    """How a thinned scene is kept beside its arrays."""
    return (
        isinstance(value, dict)
        and isinstance(value.get("at"), str)
        and isinstance(value.get("num_gaussians"), int)
        and (value.get("up") is None or a_direction(value["up"]))
        and isinstance(value.get("row_map", False), bool)
    )


def a_graph(value: Any) -> bool:
    """What a graph is beside its arrays."""
    if not isinstance(value, dict) or not isinstance(value.get("layers"), dict):
        return False
    layers, things = value["layers"].values(), value.get("things", {"count": 0, "unit_m": 1.0})
    return (
        (value.get("up") is None or a_direction(value["up"]))
        and _numbers(value.get("unit_m"))
        and _numbers(value.get("working_m", 1.0))
        and texts(value.get("notes"))
        and isinstance(things, dict)
        and isinstance(things.get("count"), int)
        and _kept_arrays(value.get("arrays", {}))
        and _numbers(things.get("unit_m"))
        and all(isinstance(x, dict) and isinstance(x.get("count"), int) and an_object(x.get("rest")) for x in layers)
    )


def _kept_arrays(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(how, dict) for how in value.values())


def members(value: Any) -> bool:
    """Of a segment of a retrieval index."""
    return isinstance(value, list) and all(
        isinstance(one, list)
        and len(one) == 5
        and all(isinstance(text, str) and is_digest(text) for text in one[:2])
        and all(isinstance(flag, bool) for flag in one[2:4])
        and _numbers(one[4])
        and one[4] > 0
        for one in value
    )


def candidates(value: Any) -> bool:
    """Of a scene that asked a retrieval index."""
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


def corrupt(where: str, value: Any, what: str) -> CorruptError:
    """What to tell of a value that gsmap cannot have written."""
    return CorruptError(
        f"the catalog holds {_short(value)} in {where}, which is not {what}: gsmap did not write that; "
        "restore the catalog from a backup, and do not trust a map that was sent to you so",
        code="catalog_invalid",
    )


def _short(value: Any) -> str:
    """A value as a message quotes it."""
    said = repr(value)
    return said if len(said) <= 60 else f"{said[:57]}..."
