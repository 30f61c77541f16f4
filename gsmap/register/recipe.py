"""Compute the recipe key that names a stored registration."""

from __future__ import annotations

from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from gsmap.methods import MethodParams, RecipeKey, family
from gsmap.register import probability
from gsmap.register.params import Params
from gsmap.register.refinement import refiner_for
from gsmap.types.plain import plain

VERSION = 23
PREPARE_VERSION = 2

_RENDER_BACKEND = "native"  # all renders of this room use it


def prepared_key() -> RecipeKey:
    """Return the recipe of prepared scenes (`gsmap.register.prepare`), without its inputs: the scene and the key of its
    graph."""
    return RecipeKey("register", "prepared", {"prepare": PREPARE_VERSION}, backend=_RENDER_BACKEND)


def recipe_key(params: Params | None = None) -> RecipeKey:
    """Return the recipe of a pair: the settings and the versions of the methods that these settings run, and no further
    ones.

    The caller adds the inputs with `RecipeKey.of`: the keys of the target's and of the source's scene graph.
    """
    params = params or Params()
    proposers = {params.proposer} | ({params.fallback_proposer} if params.fallback != "never" else set())
    refiners = {params.polisher}
    for name in (params.coarse_refiner, params.refiner):
        refiners |= {refiner_for(name, with_scale) for with_scale in (False, True)}
    families = {"proposers": proposers, "refiners": refiners}
    settings: dict[str, Any] = {
        f.name: _settings_of(getattr(params, f.name), families[f.name])
        if f.name in families
        else plain(getattr(params, f.name))
        for f in fields(params)
    }
    if params.fallback == "never":
        del settings["fallback_proposer"]
    versions = {"register": VERSION, "prepare": PREPARE_VERSION, "probability": probability.VERSION}
    refiners |= {"colored_icp"}  # estimating covariances uses it, too
    for kind, names in (("proposer", proposers), ("refiner", refiners)):
        for name in sorted(names):
            versions |= family(kind).version(name)
    packages = sorted({package for name in proposers for package in family("proposer").get(name).PACKAGES})
    backend = " ".join([_RENDER_BACKEND, *(f"{package}={installed_version(package)}" for package in packages)])
    return RecipeKey(stage="register", method="pair", version=versions, settings=settings, backend=backend)


def installed_version(package: str) -> str:
    """Return the version of a package, or ``missing``."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def _settings_of(settings: MethodParams, names: set[str]) -> dict[str, Any]:
    return {name: plain(settings[name]) for name in sorted(names)}
