"""Helpers for all reports: names and directions by id, checked filters, pairs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from gsmap.errors import ConfigError, CorruptError, NotFoundError
from gsmap.map.snapshot_read import snapshot_read
from gsmap.store import Store
from gsmap.store.graphs import StoredGraph
from gsmap.store.scenes import SceneSummary
from gsmap.types import Scene
from gsmap.types.rows.scenes import SceneRef


@snapshot_read
def names(store: Store) -> dict[str, str]:
    """Return the name of every scene by id, removed scenes included."""
    return SceneMapping(store.scenes.names())


def scenes_by_id(store: Store) -> dict[str, Scene]:
    """Return every scene by id, removed scenes included."""
    return SceneMapping((scene.id, scene) for scene in [*store.scenes.list(removed=True), *store.scenes.list()])


class SceneMapping(dict[str, Any]):
    """A mapping by scene id that raises `CorruptError` for unknown ids."""

    def __missing__(self, scene: str) -> NoReturn:
        raise CorruptError(
            f"the catalog has results of scene {scene[:12]}, which it does not have: run gsmap check",
            code="catalog_invalid",
        )


def up_directions(graphs: Iterable[StoredGraph], scenes: Iterable[Scene | SceneSummary]) -> dict[str, np.ndarray]:
    """Return the up direction (3,) of scenes by id, in their own frames: that of the last graph in the list, or
    the one kept when the scene was thinned. Scenes without a known direction are left out.
    """
    last = {graph.scene: graph.up for graph in graphs}
    of_thinned = {scene.id: scene.thinning.up for scene in scenes if scene.thinning is not None}
    known = [*of_thinned.items(), *last.items()]
    return {scene: np.array(up, np.float64) for scene, up in known if up is not None}


def refs(scenes: Iterable[str], name_of: Mapping[str, str]) -> tuple[SceneRef, ...]:
    return tuple(SceneRef(scene=scene, scene_name=name_of[scene]) for scene in scenes)


def one_of(value: str | None, known: Sequence[str]) -> None:
    if value is not None and value not in known:
        raise ConfigError(f"there is no status {value!r}: choose one of {', '.join(known)}", code="invalid_choice")


def pair_of(store: Store, pair: str) -> tuple[Scene, Scene]:
    """Return the scenes of ``A:B``; a name may contain a colon.

    Raises:
        NotFoundError: no two scenes are called so.
        ConfigError: a scene with itself.
    """
    for at in (i for i, character in enumerate(pair) if character == ":"):
        try:
            return checked_pair(store.scenes.get(pair[:at]), store.scenes.get(pair[at + 1 :]))
        except NotFoundError:
            continue
    raise NotFoundError(
        f"no pair {pair!r}: write A:B with names from gsmap list MAP scenes",
        code="scene_not_found",
    )


def checked_pair(a: Scene, b: Scene) -> tuple[Scene, Scene]:
    """Return two scenes after checking that they differ.

    Raises:
        ConfigError: they are one.
    """
    if a.id == b.id:
        raise ConfigError(f"both scenes of the pair are {a.name}: name two different scenes", code="same_scene")
    return a, b
