"""A stored result is named by what made it: any setting, any version changes the keys of what it influences, no other.

The settings tree is walked, so a setting that is added is tested without anybody remembering it.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gsmap
from gsmap import change, describe, localize, merge, objects, optimize, register
from gsmap.errors import ConfigError
from gsmap.export import PlannedTile, TileRecipe
from gsmap.map.settings import PRESETS, Settings, settings_of
from gsmap.methods import families
from gsmap.settings import changed, leaves, load, parse, save
from gsmap.types import Sim3

GRAPH, EDGE, POSES, CHANGES, VIEWS, THINGS = "graph", "edge", "poses", "changes", "views", "objects"
MERGERS = families()["merger"].names()
TILE = PlannedTile(0, "map", np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), {"scene": Sim3.identity()}, "all")

ALTERNATIVES: dict[str, Any] = {
    "describe.object.segmenter": "builtin",
    "describe.object.embedder": "builtin",
    "merge.method": "voxel",
    **{f"merge.mergers.{name}.prefer": "best" for name in ("tto", "voxel", "union")},
    "describe.object.render_backend": "gsplat",
    "register.proposer": "kiss_matcher",
    "register.fallback_proposer": "graph",
    "register.fallback": "always",
    "register.coarse_refiner": "gicp",
    "register.refiner": "gicp",
    "register.polisher": "photometric",
    "register.proposers.graph.kinds": ("landmarks",),
    "register.proposers.graph.consistency.test": "ratio",
    "localize.extractor": "onnx",
    "engine.executor": "local",
    "engine.executors.dask.scheduler": "tcp://elsewhere:8786",
}
"""Another value of a setting that takes only certain words."""

JUDGING = tuple(
    field.name for field in fields(localize.Params) if field.name not in ("extractor", "extractors", "views")
)
"""What photographs are judged by; what is kept is what views show."""

NAMES_NOTHING = (
    "retrieve.",
    "scan.",  # nothing of it is kept
    "report.",  # a page, made whenever it is asked for
    "view.",  # levels of detail are named by their own
    "visits.",
    "thin.",
    "export.",
    "evaluate.",
    "engine.",
    "world.",  # is in what was observed once it was read
    "merge.method",
    "describe.object.model_",
    *(f"localize.{part}" for part in JUDGING),
)
"""Settings that choose work (which pairs, which tiles, where it runs, when it is given up), and change no result."""


def _chosen_by(plural: str, switch: str, kind: str) -> dict[str, dict[str, Any]]:
    return {f"{plural}.{name}.": {switch: name} for name in families()[kind].names()}


ONLY_IF = {
    **_chosen_by("describe.object.segmenters", "describe.object.segmenter", "segmenter"),
    **_chosen_by("describe.object.embedders", "describe.object.embedder", "embedder"),
    **_chosen_by("localize.extractors", "localize.extractor", "extractor"),
    **_chosen_by("register.proposers", "register.proposer", "proposer"),
    **_chosen_by("register.refiners", "register.refiner", "refiner"),
}
"""What must be chosen for the settings of a method to count; where nothing asks for the method, they must not."""

IDLE = {
    "describe.object.segmenters": {"describe.objects": False},
    "describe.object.embedders": {"describe.objects": False},
    "localize.extractors": {},
    "register.proposers": {"register.fallback": "never"},
    "register.refiners": {},
}
"""Beside another method, what keeps one from being asked: `colored_icp` stands in where the scale is unknown."""


def _modules() -> list[Any]:
    skip: Callable[[str], bool] = lambda name: name.endswith("__main__") or "_native" in name  # noqa: E731
    names = [m.name for m in pkgutil.walk_packages(gsmap.__path__, "gsmap.") if not skip(m.name)]
    left_out = (".cli", ".migrations")
    return [importlib.import_module(name) for name in names if not any(part in name for part in left_out)]


def keys(settings: Settings) -> dict[str, str]:
    """Digest of every kind of result, by its name, for one fixed set of inputs."""
    graph = describe.recipe_key(settings.describe, {}).of("scene", "auto")
    edge = register.recipe_key(settings.register).of(graph.digest, graph.digest)
    poses = optimize.recipe_key(settings.optimize).of("scene", edge.digest)
    tiles = {f"tile {m}": TileRecipe(merge.recipe_key(m, settings.merge.mergers[m])).key(TILE) for m in MERGERS}
    changes = change.recipe_key(settings.change).of("older", "newer")
    views = localize.recipe_key(settings.localize).of("scene", "")
    things = objects.recipe_key(settings.objects).of(f"scene {graph.digest}")
    named = {GRAPH: graph, EDGE: edge, POSES: poses, CHANGES: changes, VIEWS: views, THINGS: things}
    return {kind: key.digest for kind, key in named.items()} | tiles


def expected(name: str) -> set[str]:
    """The results whose keys a setting must change."""
    if name.startswith(NAMES_NOTHING) or name in ("describe.object.segmenter", "describe.object.embedder"):
        return set()  # without models "auto" is the built-in one already
    room = name.split(".")[0]
    if room == "merge":
        return {f"tile {name.split('.')[2]}"}
    # An edge is made from graphs, and poses from edges: what changes the one changes the other.
    return {
        "describe": {GRAPH, EDGE, POSES, THINGS},
        "objects": {THINGS},
        "register": {EDGE, POSES},
        "optimize": {POSES},
        "change": {CHANGES},
        "localize": {VIEWS},
    }[room]


def another(name: str, value: Any) -> Iterator[Any]:
    """Values that differ from one, for the settings to refuse or take."""
    if name in ALTERNATIVES:
        yield ALTERNATIVES[name]
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value - 1)
    elif isinstance(value, float):
        yield from (value * 0.9 + 1e-3, value * 1.1, value + 1.0, 0.5)
    elif value is None:
        yield from (7, 0.5)
    elif isinstance(value, tuple):
        yield from (tuple(next(another("", v)) for v in value), (*value, *value[-1:]), value[:-1])
    else:
        raise AssertionError(f"{name} is {value!r}: give it an alternative")


def with_another(settings: Settings, name: str, value: Any) -> Settings:
    for candidate in another(name, value):
        try:
            new = changed(settings, {name: candidate})
        except ConfigError:
            continue
        if new != settings:
            return new
    raise AssertionError(f"no other value of {name} is taken; now {value!r}")


def every_setting() -> list[Any]:
    return [pytest.param(leaf.name, id=leaf.name) for leaf in leaves(Settings())]


@pytest.mark.parametrize("name", every_setting())
def test_a_setting_changes_the_keys_of_what_it_influences_and_no_others(name: str) -> None:
    settings = Settings()
    condition: dict[str, Any] = next((c for prefix, c in ONLY_IF.items() if name.startswith(prefix)), {})
    if condition:
        (switch, method), plural = next(iter(condition.items())), ".".join(name.split(".")[:3])
        plural = next(p for p in IDLE if name.startswith(p + "."))
        kind = next(f for f in families() if f"{f}s" == plural.split(".")[-1])
        elsewhere = next((n for n in families()[kind].names() if n != method and n != "none"), None)
        if elsewhere is not None and method != "colored_icp":
            idle = changed(settings, {**IDLE[plural], switch: elsewhere})
            leaf = next(leaf for leaf in leaves(idle) if leaf.name == name)
            assert keys(with_another(idle, name, leaf.value)) == keys(idle), f"{name} counts though nothing asks for it"
        settings = changed(settings, condition)
    leaf = next(leaf for leaf in leaves(settings) if leaf.name == name)
    before, after = keys(settings), keys(with_another(settings, name, leaf.value))
    assert {kind for kind in before if before[kind] != after[kind]} == expected(name)


def test_every_setting_has_a_meaning() -> None:
    silent = [leaf.name for leaf in leaves(Settings()) if not leaf.meaning]
    assert not silent, f"no docstring says what these mean: {silent}"


def test_every_field_of_every_params_is_reachable() -> None:
    """All frozen ``Params`` of the package hang in the tree."""
    reachable = {type(node) for node in _nodes(Settings())}
    lost = [
        f"{module.__name__}.Params"
        for module in _modules()
        if isinstance(getattr(module, "Params", None), type)
        and module.Params.__module__ == module.__name__
        and module.Params not in reachable
    ]
    assert not lost


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_settings(preset: str) -> None:
    assert (settings_of({}, preset) == Settings()) == (preset == "default")


def test_none_is_a_word_where_a_method_is_called_so(tmp_path: Path) -> None:
    """The refiner ``none`` can be chosen from the command line and stays readable in a map's file."""
    for name in ("register.refiner", "register.coarse_refiner"):
        path = tmp_path / f"{name}.toml"
        values = dict([parse(f"{name}=none")])
        wanted = changed(Settings(), {name: "none"})
        assert changed(Settings(), values) == wanted
        save(path, {name: "none"})
        assert changed(Settings(), load(path)) == wanted


def _versions() -> list[Any]:
    """Every module of the package that states a VERSION which names results (that of levels names their files)."""
    names_nothing = (
        "gsmap.engine.",
        "gsmap.export.levels",
        "gsmap.formats.",
        "gsmap.localize.vocabulary",  # segments of an index, which are losable
        "gsmap.retrieve.",
        "gsmap.view.trees",
    )
    found = [m.__name__ for m in _modules() if "\nVERSION = " in Path(m.__file__ or "").read_text()]
    return [pytest.param(name, id=name) for name in found if not name.startswith(names_nothing)]


@pytest.mark.parametrize("module", _versions())
def test_a_version_changes_a_key(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def all_keys() -> list[dict[str, str]]:
        chosen: list[dict[str, Any]] = [{}]
        chosen += [{"register.refiner": name} for name in families()["refiner"].names()]
        chosen += [{"register.proposer": name} for name in families()["proposer"].names()]
        chosen += [{"localize.extractor": name} for name in families()["extractor"].names()]
        chosen += [{"describe.object.segmenter": name} for name in families()["segmenter"].names()]
        chosen += [{"describe.object.embedder": name} for name in families()["embedder"].names()]
        return [keys(changed(Settings(), values)) for values in chosen]

    before = all_keys()
    found = importlib.import_module(module)
    monkeypatch.setattr(found, "VERSION", found.VERSION + 1)
    after = all_keys()
    assert before != after, f"{module} states a VERSION that no key knows"
    room = {"describe": GRAPH, "register": EDGE, "optimize": POSES, "change": CHANGES, "localize": VIEWS}.get(
        module.split(".")[1], "tile"
    )
    for old, new in zip(before, after, strict=True):
        changed_kinds = {kind for kind in old if old[kind] != new[kind]}
        upstream = {EDGE: {GRAPH}, POSES: {GRAPH, EDGE}, "tile": {GRAPH, EDGE, POSES}}.get(room, set())
        assert not changed_kinds & upstream


def test_inputs_and_backend_count() -> None:
    key = merge.recipe_key("voxel", merge.Params().mergers["voxel"])
    assert key.of("a").digest != key.of("b").digest
    assert key.of("a").recipe == key.of("b").recipe
    assert replace(key, backend="gsplat").digest != key.digest


def _nodes(tree: Any) -> Iterator[Any]:
    from dataclasses import fields, is_dataclass

    from gsmap.methods import MethodParams

    yield tree
    below = list(tree.values()) if isinstance(tree, MethodParams) else [getattr(tree, f.name) for f in fields(tree)]
    for node in below:
        if isinstance(node, MethodParams) or (is_dataclass(node) and not isinstance(node, type)):
            yield from _nodes(node)
