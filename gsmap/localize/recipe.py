"""Compute the recipe key of a scene's stored features."""

from __future__ import annotations

from collections.abc import Mapping

from gsmap.localize import features
from gsmap.localize.params import Params
from gsmap.methods import RecipeKey, family
from gsmap.types.model import ModelSpec
from gsmap.types.plain import plain


def recipe_key(params: Params, models: Mapping[str, ModelSpec] | None = None) -> RecipeKey:
    """Return the recipe of the features of a scene's views; settings of the verdict on photos are not part of it.

    The caller adds the scene as input with `RecipeKey.of`.
    """
    name = params.extractor
    needed = [models[kind] for kind in family("extractor").get(name).MODELS] if models else []
    return RecipeKey(
        stage="localize",
        method=name,
        version={"features": features.VERSION, **family("extractor").version(name)},
        settings={
            "views": plain(params.views),
            "extractor": plain(params.extractors[name]),
            "models": [spec.digest for spec in needed],
        },
        backend="native",
    )
