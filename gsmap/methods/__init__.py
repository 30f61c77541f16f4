"""Families of methods, their contracts, and the recipe keys of results.

Each family has its contract, a ``Protocol`` with the shapes and units of every argument, in a module of its name. This
room names the folders in which built-in methods lie, and imports none of them.
"""

from __future__ import annotations

from functools import lru_cache

from gsmap.methods.family import Family, MethodParams, declare
from gsmap.methods.recipe_key import RecipeKey, text_digest

__all__ = ["Family", "MethodParams", "RecipeKey", "families", "family", "text_digest"]

# A format's name is the suffix of its files.
_FORMATS = (
    ("lod-meta.json", "gsmap.formats.streamed_sog"),
    (".ckpt", "gsmap.formats.checkpoint"),
    (".compressed.ply", "gsmap.formats.compressed_ply"),
    (".glb", "gsmap.formats.glb"),
    (".ksplat", "gsmap.formats.ksplat"),
    (".lcc", "gsmap.formats.lcc"),
    (".ply", "gsmap.formats.ply"),
    (".pt", "gsmap.formats.checkpoint"),
    (".pth", "gsmap.formats.checkpoint"),
    (".sog", "gsmap.formats.sog"),
    ("meta.json", "gsmap.formats.sog"),
    (".splat", "gsmap.formats.splat"),
    (".spz", "gsmap.formats.spz"),
    (".usda", "gsmap.formats.usd"),
    (".usdc", "gsmap.formats.usd"),
    (".usdz", "gsmap.formats.usd"),
    ("tileset.json", "gsmap.formats.tiles3d"),
)


@lru_cache(maxsize=1)
def families() -> dict[str, Family]:
    """Return all families of methods, by name."""
    found = (
        Family("segmenter", "gsmap.describe.segmenters", ("MODELS", "make")),
        Family("embedder", "gsmap.describe.embedders", ("MODELS", "make")),
        Family("extractor", "gsmap.localize.extractors", ("MODELS", "make")),
        Family("proposer", "gsmap.register.proposers", ("SCALES", "PACKAGES", "propose")),
        Family("refiner", "gsmap.register.refiners", ("SCALES", "refine")),
        Family(
            "merger",
            "gsmap.merge.mergers",
            ("STEPS", "RENDERS", "reach_m", "reading_m", "looking_m", "min_cameras", "uses_dates", "merge"),
        ),
        Family("executor", "gsmap.engine.executors", ("start",)),
        Family("format", "gsmap.formats", (), _FORMATS, any_of=("read", "write"), has_params=False),
    )
    return {family.name: family for family in found}


def family(name: str) -> Family:
    """Return the family of methods with this name."""
    return families()[name]


declare(families())
