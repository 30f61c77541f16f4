"""Families of methods: built-in methods, plug-ins, and their parameters."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import logging
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, get_type_hints

from gsmap.errors import ConfigError

_log = logging.getLogger("gsmap.methods")

_DECLARED: dict[str, Family] = {}


@dataclass(frozen=True)
class Family:
    """A family of interchangeable methods.

    A method is a module, or any object, with

    - ``Params``: a frozen dataclass of its settings, all with defaults, each explained under ``Args:``;
    - ``VERSION``: an int, raised whenever its output changes for the same input;
    - what the family's contract asks for (`gsmap.methods.<family>`).

    Built-in methods are the modules of one folder: a new file there is a new method. Another package adds one by an
    entry point in the group ``gsmap.<family>s``, such as::

        [project.entry-points."gsmap.mergers"]
        nearest = "my_package.nearest_merger"

    Args:
        name: name in the singular.
        folder: dotted name of the package with the built-in methods; modules with a leading underscore, or called
            ``base``, are not methods.
        contract: required names beside ``Params`` and ``VERSION``.
        table: built-in methods by name (dotted module names), if the folder holds other modules too.
        any_of: names of which a method needs at least one.
        has_params: false if the methods have no ``Params``.
    """

    name: str
    folder: str
    contract: tuple[str, ...]
    table: tuple[tuple[str, str], ...] = ()
    any_of: tuple[str, ...] = ()
    has_params: bool = True

    @property
    def group(self) -> str:
        """Name of the entry point group."""
        return f"gsmap.{self.name}s"

    def names(self) -> tuple[str, ...]:
        """Return the names of all methods, in alphabetical order."""
        return tuple(sorted({**self._added(), **self._built_in()}))

    def usable(self) -> tuple[str, ...]:
        """Return the names of the methods that load and keep the contract; warn once about each broken method."""
        return _usable(self, tuple(sys.path))

    def get(self, name: str) -> Any:
        """Load and return a method by name.

        Raises:
            ConfigError: no such method, or one that does not keep the contract.
        """
        return _loaded(self, name)

    def params_type(self, name: str) -> type:
        """Return the ``Params`` class of a method."""
        found: type = self.get(name).Params
        return found

    def version(self, name: str) -> dict[str, int]:
        """Return ``{"<family>.<name>": VERSION}`` for `RecipeKey.version`."""
        return {f"{self.name}.{name.lstrip('.')}": int(self.get(name).VERSION)}

    def _built_in(self) -> dict[str, str]:
        if self.table:
            return dict(self.table)
        spec = importlib.util.find_spec(self.folder)
        places = tuple((spec.submodule_search_locations if spec else None) or ())
        return {name: f"{self.folder}.{name}" for name in _modules_in(places)}

    def _added(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in _entry_points(tuple(sys.path)).select(group=self.group)}

    def _load(self, name: str) -> Any:
        built_in = self._built_in()
        if name in built_in:
            method = importlib.import_module(built_in[name])
        elif name in (added := self._added()):
            try:
                method = added[name].load()
            except (Exception, SystemExit) as error:  # another package's code may fail in any way
                raise ConfigError(
                    f"{self.name} {name!r} of the package {_package(added[name])} cannot be loaded "
                    f"({type(error).__name__}: {error}): repair or uninstall that package",
                    code="method_not_loadable",
                ) from error
        else:
            known = self.names()
            near = difflib.get_close_matches(name, known, 1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise ConfigError(
                f"there is no {self.name} {name!r}{hint}: choose one of {', '.join(known)}", code="unknown_method"
            )
        wanted = (*(("Params",) if self.has_params else ()), "VERSION", *self.contract)
        missing = [part for part in wanted if not hasattr(method, part)]
        if self.any_of and not any(hasattr(method, part) for part in self.any_of):
            missing.append(" or ".join(self.any_of))
        if missing:
            raise ConfigError(
                f"{self.name} {name!r} lacks {', '.join(missing)}: see the contract in gsmap.methods.{self.name}",
                code="invalid_method",
            )
        if self.has_params and not _is_frozen(method.Params):
            raise ConfigError(f"{self.name} {name!r}: its Params must be a frozen dataclass", code="invalid_method")
        if self.has_params and name not in built_in:
            try:
                get_type_hints(method.Params)
                method.Params()
            except Exception as error:
                raise ConfigError(
                    f"{self.name} {name!r}: its Params cannot be made without arguments or read "
                    f"({type(error).__name__}: {error})",
                    code="invalid_method",
                ) from error
        return method


@dataclass(frozen=True)
class MethodParams(Mapping[str, Any]):
    """The parameters of all methods of a family by name: a node of the settings tree.

    Methods that nobody changed have their defaults, and are not even imported before they are asked for.

    Args:
        family: its name.
        changed: (method, params) of those that differ from their defaults, sorted.
    """

    family: str
    changed: tuple[tuple[str, Any], ...] = ()

    def __getitem__(self, name: str) -> Any:
        for method, params in self.changed:
            if method == name:
                return params
        return _family(self.family).params_type(name)()

    def __iter__(self) -> Iterator[str]:
        return iter(_family(self.family).usable())

    def __len__(self) -> int:
        return len(_family(self.family).usable())

    def __contains__(self, name: object) -> bool:
        """Return true if a method has this name; the method is not imported and may fail to load."""
        return name in _family(self.family).names()

    def __hash__(self) -> int:
        return hash((self.family, self.changed))

    def with_params(self, name: str, params: Any) -> MethodParams:
        """Return a copy in which one method has other parameters.

        Raises:
            ConfigError: no such method, or the parameters of another.
        """
        wanted = _family(self.family).params_type(name)
        if not isinstance(params, wanted):
            raise ConfigError(
                f"{self.family} {name!r} takes {wanted.__module__}.Params, got {type(params).__module__}."
                f"{type(params).__name__}",
                code="invalid_method",
            )
        kept = dict(self.changed) | {name: params}
        return MethodParams(self.family, tuple(sorted((n, p) for n, p in kept.items() if p != self._default(n))))

    def _default(self, name: str) -> Any:
        return _family(self.family).params_type(name)()


def _is_frozen(params: Any) -> bool:
    """Return true for a frozen dataclass."""
    shape = getattr(params, "__dataclass_params__", None)
    return shape is not None and bool(shape.frozen)


@lru_cache(maxsize=64)
def _modules_in(places: tuple[str, ...]) -> tuple[str, ...]:
    """List the methods in the folders of a package; the answer is cached."""
    found = [module.name for module in pkgutil.iter_modules(list(places))]
    return tuple(name for name in found if not name.startswith("_") and name != "base")


@lru_cache(maxsize=64)
def _entry_points(path: tuple[str, ...]) -> Any:
    """Return the entry points of all packages, of which a file each is read; the answer is cached per search path."""
    return entry_points()


@lru_cache(maxsize=64)
def _usable(family: Family, path: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the methods that load, cached per search path; report each broken method once."""
    found = []
    for name in family.names():
        try:
            family.get(name)
        except ConfigError as error:
            _log.warning("%s; gsmap continues without this method", error)
        else:
            found.append(name)
    return tuple(found)


@lru_cache(maxsize=256)
def _loaded(family: Family, name: str) -> Any:
    return family._load(name)


def declare(found: Mapping[str, Family]) -> None:
    """Register the families; `gsmap.methods` calls this function, which avoids an import cycle."""
    _DECLARED.update(found)


def _family(name: str) -> Family:
    return _DECLARED[name]


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
