"""Prepare scenes that were described by an older release for registration, and store the result."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

from gsmap.engine import QuarantinedJob, run_jobs
from gsmap.errors import DiskFullError, ReadOnlyError
from gsmap.map.jobs import prepare_scene
from gsmap.map.settings import Settings
from gsmap.register.recipe import prepared_key
from gsmap.store import Store


def prepare_missing(store: Store, graphs: Iterable[tuple[str, str]], settings: Settings) -> None:
    """Prepare the scenes that are not prepared yet; what cannot be stored is computed again by each pair.

    Args:
        graphs: id of each scene and the key of its graph.
    """
    recipe = prepared_key()
    keys = {scene: recipe.of(scene, graph) for scene, graph in graphs}
    kept = store.prepared_scenes.stored_keys(keys.values())
    missing = [key for key in keys.values() if key.digest not in kept]
    if not missing or not store.catalog.writable:
        return
    with suppress(DiskFullError, ReadOnlyError), store.arrays.inbox() as inbox:
        jobs = [(store.location, key.inputs[0], key, inbox) for key in missing]
        for number, found in run_jobs(prepare_scene, jobs, settings.engine):
            if not isinstance(found, QuarantinedJob):
                store.prepared_scenes.save(found, missing[number])
