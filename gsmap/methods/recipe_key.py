"""Recipe keys, which name each stored result by everything that determines it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from gsmap.types.plain import canonical, plain


@dataclass(frozen=True, eq=False)
class RecipeKey:
    """The recipe and inputs of a result.

    Nothing else decides whether a result is made again: equal keys mean equal results, on any machine.

    Args:
        stage: ``describe``, ``register``, ``optimize`` or ``merge``.
        method: which way of doing it, in the family's word (``graph``, ``tto``).
        version: by name of every piece of code that takes part, its ``VERSION``: a number raised whenever its output
            changes for the same input.
        settings: the settings that can change this result, and no others (those of a refiner that is not used are not
            among them).
        backend: what computes, where that may change bits: ``native`` or ``gsplat``, a package that may be missing.
        inputs: ids and digests of what it is made from; empty while only the recipe itself is meant.
    """

    stage: str
    method: str
    version: Mapping[str, int]
    settings: Mapping[str, Any] = field(default_factory=dict)
    backend: str = ""
    inputs: tuple[str, ...] = ()

    def of(self, *inputs: str) -> RecipeKey:
        """Return the same recipe with these inputs."""
        made = object.__new__(RecipeKey)  # as `replace` does, in a tenth of the time: one is made for every scene
        made.__dict__.update(self._parts, inputs=inputs)
        return made

    def digest_of(self, *inputs: str) -> str:
        """Return the `digest` of the same recipe with these inputs, faster than `of` for many inputs."""
        # `canonical` of texts; where these are digests and words it is written here, in a third of the time: an update
        # asks what would name each pair of the map.
        flat = "".join(inputs)
        if flat.isascii() and flat.isalnum():
            listed = '","'.join(inputs)
            return text_digest(f'["{self.recipe}",["{listed}"]]')
        return text_digest(_encoded([self.recipe, inputs]))

    @cached_property
    def _parts(self) -> dict[str, Any]:
        """Return the parts that all keys of this recipe share; the answer is cached."""
        return {one.name: getattr(self, one.name) for one in fields(self)} | {"recipe": self.recipe}

    def to_json(self) -> dict[str, Any]:
        """Return the recipe as plain values, leaving out its inputs."""
        return {
            "stage": self.stage,
            "method": self.method,
            "version": dict(self.version),
            "settings": plain(self.settings),
            "backend": self.backend,
        }

    @cached_property
    def recipe(self) -> str:
        """Return 32 hex digits of the recipe without its inputs."""
        return text_digest(canonical(self.to_json()))

    @cached_property
    def digest(self) -> str:
        """Return 32 hex digits of the recipe and its inputs: the name of the stored result."""
        return self.digest_of(*self.inputs)


_encoded = json.JSONEncoder(separators=(",", ":")).encode


def text_digest(text: str) -> str:
    """Return 32 hex digits (SHA-256) of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]
