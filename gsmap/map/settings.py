"""The settings of a map: one frozen tree of the parameters of all stages, presets, and ``MAP/settings.toml``."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmap.errors import ConfigError
from gsmap.settings import FILE_NAME, changed, contains, load, save
from gsmap.settings.file import PRESET

if TYPE_CHECKING:
    from gsmap import (
        change,
        describe,
        engine,
        export,
        localize,
        merge,
        objects,
        optimize,
        register,
        report,
        retrieve,
        thin,
        view,
        world,
    )
    from gsmap.evaluate import map_errors
    from gsmap.localize import scan
    from gsmap.map.changes import visits

_log = logging.getLogger("gsmap.settings")

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # Graph-GSReg (2026) as published, as far as its stages go: objects alone, of masks that are lifted without a depth
    # test and joined over views by feature and box, context over three hops, the relative distance test, ICP on the
    # means, and plain L1 optimisation of the union on 1 cm voxels. A CLIP-like encoder is taken where the map has one;
    # SAM, where the map has it, by `describe.object.segmenter` = "sam". The verdict, the measured scale and the pose
    # graph, which the paper has none of, stay gsmap's. `tools/bench/paper.py` shows each stage.
    "paper": {
        "describe.landmarks": False,
        "describe.object.segmenter": "per_view",
        "describe.object.depth_tolerance": float("inf"),
        "register.fallback": "never",
        "register.proposers.graph.kinds": ["objects"],
        "register.proposers.graph.context.hops": 3,
        "register.proposers.graph.consistency.test": "ratio",
        "register.proposers.graph.consistency.height_slope": float("inf"),
        "register.coarse_refiner": "none",
        "register.refiner": "icp",
        "register.refiners.icp.means": True,
        "merge.method": "tto",
        "merge.mergers.tto.voxel_m": 0.01,
        "merge.mergers.tto.owner_cells": False,
        "merge.mergers.tto.ssim_weight": 0.0,
        "merge.mergers.tto.huber_delta": 0.0,
        "merge.mergers.tto.momentum": 0.9,
        "merge.mergers.tto.min_weight": 0.0,
        "merge.mergers.tto.kept_fraction": 1.0,
        "merge.mergers.tto.prefer": "both",
    },
}
"""Settings of each preset by name; all other settings have their defaults."""


class _Section:
    """A field of `Settings`; its module is imported, and its default is created, on first use."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object, owner: type) -> Any:
        if instance is None:
            return self
        if self._name not in vars(instance):
            vars(instance)[self._name] = importlib.import_module(self._module).Params()
        return vars(instance)[self._name]

    def __set__(self, instance: object, value: Any) -> None:
        if value is not self:
            vars(instance)[self._name] = value


def _params_of(module: str) -> Any:
    """Return a field for the ``Params`` of a module."""
    return _Section(module)


@dataclass(frozen=True)
class Settings:
    """The settings of a map, one section per stage. The module of a section is imported on first use.

    Args:
        describe: description of captures as scene graphs.
        retrieve: choice of the pairs to register.
        register: registration of pairs and its verdict.
        optimize: optimization of the poses.
        world: use of observations of the world.
        thin: thinning of superseded captures.
        merge: merging of captures.
        export: planning and storage of tiles.
        visits: choice of the visits to compare.
        change: detection of changes.
        objects: association of segments over captures.
        localize: localization of photos.
        scan: localization of scans.
        evaluate: thresholds of the evaluation.
        report: limits of a report.
        view: limits of the page.
        engine: execution of jobs.
    """

    describe: describe.Params = field(default=_params_of("gsmap.describe"))
    retrieve: retrieve.Params = field(default=_params_of("gsmap.retrieve"))
    register: register.Params = field(default=_params_of("gsmap.register"))
    optimize: optimize.Params = field(default=_params_of("gsmap.optimize"))
    world: world.Params = field(default=_params_of("gsmap.world"))
    thin: thin.Params = field(default=_params_of("gsmap.thin"))
    merge: merge.Params = field(default=_params_of("gsmap.merge"))
    export: export.Params = field(default=_params_of("gsmap.export"))
    visits: visits.Params = field(default=_params_of("gsmap.map.changes.visits"))
    change: change.Params = field(default=_params_of("gsmap.change"))
    objects: objects.Params = field(default=_params_of("gsmap.objects"))
    localize: localize.Params = field(default=_params_of("gsmap.localize"))
    scan: scan.Params = field(default=_params_of("gsmap.localize.scan"))
    evaluate: map_errors.Params = field(default=_params_of("gsmap.evaluate.map_errors"))
    report: report.Params = field(default=_params_of("gsmap.report"))
    view: view.Params = field(default=_params_of("gsmap.view"))
    engine: engine.Params = field(default=_params_of("gsmap.engine"))

    def index_recipes(self) -> set[str]:
        """Return the recipes of all indexes of a map."""
        from gsmap.localize import index_recipe as recipe_of_views
        from gsmap.retrieve import index_recipe

        return {index_recipe(self.retrieve), recipe_of_views()}


def settings_of(values: Mapping[str, Any], preset: str | None = None) -> Settings:
    """Return the defaults, changed by a preset and then by ``values``, which have dotted names.

    Raises:
        ConfigError: no such preset or setting, or a value that does not fit.
    """
    if preset is not None and preset not in PRESETS:
        raise ConfigError(f"there is no preset {preset!r}: choose one of {', '.join(PRESETS)}", code="unknown_preset")
    tree: Settings = changed(Settings(), {**PRESETS[preset or "default"], **values})
    return tree


def read_settings(folder: Path) -> tuple[str, dict[str, Any]]:
    """Read the preset of a map and its own settings by dotted name, including unknown names.

    Raises:
        ConfigError: ``settings.toml`` cannot be read.
    """
    values = load(folder / FILE_NAME)
    for name in [name for name in values if _is_of_the_run(name)]:
        _log.warning("%s: %s is ignored: an executor is chosen with each run (--executor)", folder / FILE_NAME, name)
        del values[name]
    return str(values.pop(PRESET, "default")), values


_WARNED: set[tuple[Path, str]] = set()
"""File and name of each unknown setting that was reported already."""


def _known(folder: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the known settings of a file; warn once about each unknown setting, so that maps of an older gsmap
    open.
    """
    defaults, path = Settings(), folder / FILE_NAME
    unknown = [name for name in values if not contains(defaults, name)]
    for name in unknown:
        if (path, name) not in _WARNED:
            _WARNED.add((path, name))
            _log.warning(
                "%s: setting %s is ignored: this version of gsmap has a constant in its place, or another name for it "
                "(gsmap settings MAP --json lists all settings); remove it with gsmap settings MAP --unset %s",
                path,
                name,
                name,
            )
    return {name: value for name, value in values.items() if name not in unknown}


def _is_of_the_run(name: str) -> bool:
    """Return true for a setting that may start jobs on other machines, which a map from a stranger must not choose."""
    return name.startswith("engine.") and not name.startswith("engine.executors.local.")


def map_settings(folder: Path, run_preset: str | None, run_values: Mapping[str, Any]) -> Settings:
    """Return the settings in force: defaults, changed by the map's preset, its settings, and the settings of a run.

    Args:
        run_preset: replaces the preset and the settings of the map.
        run_values: by dotted name.

    Raises:
        ConfigError: a preset, name or value that cannot be; ``settings.toml`` is named where it is to blame.
    """
    if run_preset is not None:
        return settings_of(run_values, run_preset)
    preset, values = read_settings(folder)
    return _combined(folder, preset, _known(folder, values), run_values)


def _combined(folder: Path, preset: str, values: Mapping[str, Any], more: Mapping[str, Any]) -> Settings:
    """Return the map's settings with further values on top."""
    try:
        return settings_of({**values, **more}, preset)
    except ConfigError:
        try:
            settings_of(values, preset)
        except ConfigError as error:
            raise ConfigError(f"{folder / FILE_NAME}: {error}", code=error.code) from error
        raise


def write_settings(
    folder: Path, values: Mapping[str, Any], *, preset: str | None = None, drop: tuple[str, ...] = ()
) -> None:
    """Change a map's ``settings.toml``; nothing is written unless all settings are valid.

    Args:
        values: settings by dotted name.
        preset: new preset of the map.
        drop: names to reset to the preset or default.

    Raises:
        ConfigError: no such preset or setting, or a value that does not fit.
    """
    old_preset, old = read_settings(folder)
    kept = _known(folder, {name: value for name, value in old.items() if name not in drop})
    if preset is not None:
        settings_of({}, preset)
    unknown = [name for name in drop if name not in old]
    if unknown:
        raise ConfigError(
            f"{unknown[0]} is not set in {folder / FILE_NAME}, so it has its default already",
            code="setting_not_changed",
        )
    _combined(folder, preset or old_preset, kept, values)
    if of_run := [name for name in values if _is_of_the_run(name)]:
        raise ConfigError(
            f"{of_run[0]} is not stored with a map: give it with each run (--executor, --scheduler), or by "
            "GSMAP_EXECUTOR and GSMAP_SCHEDULER",
            code="setting_of_run",
        )
    save(folder / FILE_NAME, {**({PRESET: preset} if preset else {}), **values}, drop)
