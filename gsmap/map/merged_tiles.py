"""Cache of merged tiles in the user's cache folder, so that a further format or folder merges nothing again.

Only results of optimizing mergers are kept, which take minutes; the others take less time than a file. Files are named
by everything that determines the content, poses included, so that an export gives the same tiles with and without the
cache. They may be deleted at any time; the least recently used ones are evicted first.
"""

from __future__ import annotations

import json
import os
import uuid
import zipfile
from collections.abc import Collection
from contextlib import suppress
from dataclasses import fields
from pathlib import Path

import numpy as np

from gsmap.errors import MALFORMED
from gsmap.store import cache
from gsmap.types import Gaussians, MergeResult

_ARRAYS = ("means", "quats", "log_scales", "logit_opacities", "sh")
_FACTS = tuple(field.name for field in fields(MergeResult) if field.name not in ("gaussians", "origin"))
_SUFFIX = ".npz"


def folder() -> Path:
    """Return the folder of merged tiles."""
    return cache.folder() / "merged"


def load(key: str) -> MergeResult | None:
    """Return the merged tile of a key; None if it is missing or damaged, in which case it is deleted."""
    path = folder() / f"{key}{_SUFFIX}"
    try:
        with np.load(path, allow_pickle=False) as stored:
            facts = json.loads(str(stored["facts"]))
            gaussians = Gaussians(*(stored[name] for name in _ARRAYS))
            origin = stored["origin"]
        if origin.shape != (len(gaussians),) or origin.dtype != np.int32:
            raise ValueError(f"{path}: {origin.shape} origins of {len(gaussians)} Gaussians")
        facts["notes"] = tuple(facts["notes"])
        found = MergeResult(gaussians, origin, **facts)
        os.utime(path)
        return found
    except FileNotFoundError:
        return None
    except (OSError, EOFError, TypeError, zipfile.BadZipFile, *MALFORMED):
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return None


def keep(key: str, result: MergeResult, scenes: Collection[str]) -> None:
    """Store a merged tile of scenes (ids), unless it is quickly merged or was cut short; a full disk leaves it out."""
    if not result.steps or result.truncated:
        return
    root = folder()
    staged = root / f".{uuid.uuid4().hex}"
    arrays = {name: getattr(result.gaussians, name) for name in _ARRAYS}
    facts = json.dumps({name: getattr(result, name) for name in _FACTS})
    with suppress(OSError):
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            with open(staged, "xb") as file:
                about = {"facts": np.array(facts), "scenes": np.array(sorted(scenes))}
                np.savez(file, origin=result.origin.astype(np.int32), **about, **arrays)  # type: ignore[arg-type]
            cache.make_room(root)
            os.replace(staged, root / f"{key}{_SUFFIX}")
        finally:
            staged.unlink(missing_ok=True)


def files_of(scene: str) -> list[Path]:
    """Return the cached files that a scene is part of; damaged and staged ones may be."""
    return [path for path in sorted(folder().glob("*")) if _may_show(path, scene)]


def _may_show(path: Path, scene: str) -> bool:
    try:
        with np.load(path, allow_pickle=False) as stored:
            return scene in stored["scenes"].tolist()
    except FileNotFoundError:
        return False
    except (OSError, EOFError, zipfile.BadZipFile, *MALFORMED):
        return True
