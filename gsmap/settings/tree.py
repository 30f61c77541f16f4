"""List the leaves of a frozen settings tree by dotted name, and change some of them.

The nodes are frozen dataclasses and `gsmap.methods.MethodParams`; a leaf is anything else: a number, a text, a switch,
a tuple of them, or None where nothing is chosen.
"""

from __future__ import annotations

import contextlib
import difflib
import re
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from gsmap.errors import ConfigError
from gsmap.methods import MethodParams
from gsmap.settings.docs import field_docs, unit_of

_BARE_DOT = re.compile(r"(?<![\w.])\.(?=\d)")
"""Matches a decimal point without a digit before it, which TOML refuses."""


@dataclass(frozen=True)
class Leaf:
    """One setting: its name, value, type, meaning and unit.

    Args:
        name: dotted, such as ``register.verdict.max_log_nfa``.
        value: current value.
        type: type annotation.
        meaning: from the docstring of the dataclass that holds it.
        unit: from its name; empty where it has none.
    """

    name: str
    value: Any
    type: Any
    meaning: str
    unit: str


def leaves(tree: Any, prefix: str = "") -> Iterator[Leaf]:
    """Yield every setting of a tree in the order of declaration."""
    for name, value, annotation, meaning in _children(tree):
        path = f"{prefix}{name}"
        if _is_node(value):
            yield from leaves(value, f"{path}.")
        else:
            yield Leaf(path, value, annotation, meaning, unit_of(name))


def changed(tree: Any, values: Mapping[str, Any]) -> Any:
    """Return the tree with some settings changed; values may be plain, as in TOML or JSON, or typed.

    Raises:
        ConfigError: an unknown name (the nearest known one is named), a value of another type, or one that the
            settings themselves refuse.
    """
    for name, value in values.items():
        tree = _set(tree, name.split("."), value, name, tree)
    return tree


def differences(tree: Any, base: Any) -> dict[str, Any]:
    """Return the settings of a tree that differ from another tree of the same shape."""
    before = {leaf.name: leaf.value for leaf in leaves(base)}
    return {
        leaf.name: leaf.value for leaf in leaves(tree) if leaf.name not in before or before[leaf.name] != leaf.value
    }


def contains(tree: Any, name: str) -> bool:
    """Return true if a tree has a setting or a group of settings under a dotted name."""
    for part in name.split("."):
        try:
            tree, _ = _child(tree, part)
        except KeyError:
            return False
        except (AttributeError, TypeError):  # below a value
            return False
    return True


def parse(text: str) -> tuple[str, Any]:
    """Parse ``a.b=value`` from ``--set``; the value is TOML (also ``.3``) or plain text.

    Raises:
        ConfigError: no ``=``, or nothing before it.
    """
    import tomllib

    name, equals, value = text.partition("=")
    name, value = name.strip(), value.strip()
    if not equals or not name:
        raise ConfigError(
            f"a setting must be written as name=value, such as register.verdict.max_log_nfa=-6, got {text!r}",
            code="invalid_assignment",
        )
    for text in (value, _BARE_DOT.sub(r"0.", value)):
        with contextlib.suppress(ValueError, RecursionError):
            return name, tomllib.loads(f"value = {text}")["value"]
    return name, None if value.lower() == "none" else value


def _is_node(value: Any) -> bool:
    return isinstance(value, MethodParams) or (is_dataclass(value) and not isinstance(value, type))


def _children(tree: Any) -> Iterator[tuple[str, Any, Any, str]]:
    """Yield (name, value, annotation, meaning) of a node's children."""
    if isinstance(tree, MethodParams):
        for name in tree:
            yield name, tree[name], None, ""
        return
    cls: type = type(tree)
    docs = field_docs(cls)
    for name in _names(cls):
        value = getattr(tree, name)
        yield name, value, _annotation(cls, name, value), docs.get(name, "")


@lru_cache(maxsize=512)
def _names(cls: type) -> tuple[str, ...]:
    """Return the names of a dataclass's fields that can be set."""
    return tuple(field.name for field in fields(cls) if field.init)


def _annotation(cls: type, name: str, value: Any) -> Any:
    """Return the type annotation of a leaf; None for a node, whose class may not be imported where it is declared."""
    return None if _is_node(value) else _hints(cls)[name]


@lru_cache(maxsize=512)
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _child(tree: Any, name: str) -> tuple[Any, Any]:
    """Return the value and annotation of one child; load only the named method of a family.

    Raises:
        KeyError: no such child.
    """
    if isinstance(tree, MethodParams):
        if name not in tree:
            raise KeyError(name)
        return tree[name], None
    cls: type = type(tree)
    if name not in _names(cls):
        raise KeyError(name)
    value = getattr(tree, name)
    return value, _annotation(cls, name, value)


def _set(tree: Any, path: list[str], value: Any, name: str, root: Any) -> Any:
    try:
        below, annotation = _child(tree, path[0])
    except KeyError:
        raise _unknown(name, root) from None
    if len(path) > 1:
        if not _is_node(below):
            raise _unknown(name, root)
        new = _set(below, path[1:], value, name, root)
    elif _is_node(below):
        inside = ", ".join(leaf.name for leaf in list(leaves(below, f"{name}."))[:4])
        raise ConfigError(
            f"{name} is a group of settings: set one of them, such as {inside}", code="setting_not_a_leaf"
        )
    else:
        new = _of_type(value, annotation, name)
    if isinstance(tree, MethodParams):
        return tree.with_params(path[0], new)
    cls: type = type(tree)
    made = {key: vars(tree)[key] for key in _names(cls) if key in vars(tree)}  # `replace` would make the others, too
    try:
        return cls(**made | {path[0]: new})
    except ConfigError as error:
        if error.code != "out_of_range":
            raise
        raise ConfigError(f"{name.removesuffix(path[0])}{error}", code=error.code) from None


def _unknown(name: str, root: Any) -> ConfigError:
    known = [leaf.name for leaf in leaves(root)]
    near = difflib.get_close_matches(name, known, 1, 0.5) or [k for k in known if k.endswith("." + name.split(".")[-1])]
    hint = f": did you mean {near[0]}?" if near else ": gsmap settings MAP lists them all"
    return ConfigError(f"there is no setting {name!r}{hint}", code="unknown_setting")


def _of_type(value: Any, annotation: Any, name: str) -> Any:
    """Convert a value to the setting's type."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in inner:
            return None
        rest = [kind for kind in inner if kind is not type(None)]
        for kind in rest:
            try:
                return _of_type(value, kind, name)
            except ConfigError:
                continue
        raise _wrong(value, annotation, name)
    if value is None and (annotation is str or origin is Literal):
        value = "none"  # TOML has no null, so the word stands for it
    if origin is Literal:
        if value in inner:
            return value
        raise ConfigError(f"{name} must be one of {', '.join(map(str, inner))}, got {value!r}", code="invalid_choice")
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise _wrong(value, annotation, name)
        if len(inner) == 2 and inner[1] is Ellipsis:
            return tuple(_of_type(item, inner[0], name) for item in value)
        if len(value) != len(inner):
            raise _wrong(value, annotation, name)
        return tuple(_of_type(item, kind, name) for item, kind in zip(value, inner, strict=True))
    if annotation is float and isinstance(value, (int, float)) and not isinstance(value, bool) and value == value:
        try:
            return float(value)
        except OverflowError:  # an integer of more than 308 digits
            raise _wrong(value, annotation, name) from None
    if annotation is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if annotation in (str, bool) and isinstance(value, annotation):
        return value
    raise _wrong(value, annotation, name)


def _wrong(value: Any, annotation: Any, name: str) -> ConfigError:
    wanted = getattr(annotation, "__name__", str(annotation)) if not get_args(annotation) else str(annotation)
    return ConfigError(f"{name} takes {wanted}, got {value!r}", code="invalid_setting_value")
