"""Sketches of what methods give for small inputs: enough to notice a change, small enough to keep."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.methods import families

TESTS = Path(__file__).resolve().parents[1]
STORED = Path(__file__).with_name("golden.json")
PROJECTIONS = 8
TOLERANCE = 5e-5
"""Relative to the array's norm. Not bit for bit: instruction sets and library versions round differently, and what is
fitted step by step (``merger.tto``) differs by 1e-5 then."""

Case = Callable[[], dict[str, np.ndarray]]


def cases() -> dict[str, Case]:
    """All cases of ``tests/*/golden_*.py`` by the names that `RecipeKey.version` gives methods and stages."""
    found: dict[str, Case] = {}
    for path in sorted(TESTS.glob("*/golden_*.py")):
        for name, case in _load(path).CASES.items():
            assert name not in found, f"{path} has a second case {name!r}"
            found[name] = case
    return found


def _load(path: Path) -> Any:
    sys.path.insert(0, str(path.parent))  # Cases use the worlds that the tests beside them are made of.
    try:
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
    return module


def version_of(name: str) -> int:
    """The ``VERSION`` of a method (``merger.tto``) or of a stage or a part of one (``register``, ``landmarks``).

    A part without a number of its own (``merge.exposure``) has its stage's. What lies below the stages (``geometry``)
    has none, 0: who changes its output raises the numbers of the methods that use it.
    """
    room, _, method = name.partition(".")
    if method and room in families():
        return families()[room].version(method)[name]
    for versions in _stages():
        if name in versions:
            return versions[name]
    if method:
        return version_of(room)
    return int(getattr(importlib.import_module(f"gsmap.{name}"), "VERSION", 0))


def _stages() -> Iterator[Mapping[str, int]]:
    for stage in ("describe", "register", "optimize", "merge"):
        module = importlib.import_module(f"gsmap.{stage}")
        if not hasattr(module, "recipe_key"):
            continue
        yield (module.recipe_key() if stage == "merge" else module.recipe_key(module.Params())).version


def sketch(array: np.ndarray) -> dict[str, Any]:
    """Shape, kind, norm, and projections on fixed random signs, in float64."""
    array = np.asarray(array)
    if array.dtype.kind in "US":
        array = np.frombuffer("\n".join(array.ravel().tolist()).encode(), np.uint8)
    values = array.astype(np.float64).ravel()
    # What is not finite would swallow the rest: its places and signs are counted instead.
    odd = ~np.isfinite(values)
    values = np.concatenate([np.where(odd, 0.0, values), np.nan_to_num(values[odd], nan=3.0, posinf=5.0, neginf=7.0)])
    place = np.flatnonzero(odd).astype(np.float64)
    values = np.concatenate([values, place])
    return {
        "shape": list(array.shape),
        "kind": array.dtype.kind,
        "norm": float(np.linalg.norm(values)),
        "projections": [float(values @ _signs(len(values), k)) for k in range(PROJECTIONS)],
    }


def _signs(count: int, k: int) -> np.ndarray:
    """(count,) of -1 and 1: SplitMix64 over a counter, so that no library's generator can change them."""
    with np.errstate(over="ignore"):
        z = (np.arange(1, count + 1, dtype=np.uint64) + np.uint64(k << 40)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return 1.0 - 2.0 * (z >> np.uint64(63)).astype(np.float64)


def made() -> dict[str, dict[str, Any]]:
    """What is stored of every case, as it comes out now; of a case whose packages are missing, what ``missing`` is.

    Made by a process of its own, by the kernels and matrix products that every processor of a family has: others round
    differently, and where a segmenter joins what ties, a rounding decides.
    """
    env = {**os.environ, "GSMAP_INSTRUCTION_SET": "baseline", "OPENBLAS_CORETYPE": "Haswell"}
    done = subprocess.run([sys.executable, __file__], env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
    found: dict[str, dict[str, Any]] = json.loads(done.stdout)
    return found


def _made_here(name: str, case: Case) -> dict[str, Any]:
    try:
        return {"version": version_of(name), "arrays": {key: sketch(array) for key, array in sorted(case().items())}}
    except MissingDependencyError as error:
        return {"missing": str(error)}


def differences(stored: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """In which arrays two results differ, empty where in none."""
    return [
        key
        for key in sorted({*stored["arrays"], *now["arrays"]})
        if not _same(stored["arrays"].get(key), now["arrays"].get(key))
    ]


def _same(a: Mapping[str, Any] | None, b: Mapping[str, Any] | None) -> bool:
    if a is None or b is None or (a["shape"], a["kind"]) != (b["shape"], b["kind"]):
        return False
    reach = TOLERANCE * max(a["norm"], b["norm"], 1e-12)
    return all(abs(p - q) <= reach for p, q in zip(a["projections"], b["projections"], strict=True))


def write() -> list[str]:
    """Store every case as it comes out now; the names whose entry changed."""
    before = json.loads(STORED.read_text()) if STORED.exists() else {}
    after = {}
    for name, now in made().items():
        if "missing" not in now:
            after[name] = now if not _equal(before.get(name), now) else before[name]
        elif name in before:  # what cannot be made here stays as it was made elsewhere
            after[name] = before[name]
    STORED.write_text(json.dumps(after, indent=1) + "\n")
    return [name for name in sorted({*before, *after}) if before.get(name) != after.get(name)]


def _equal(a: Mapping[str, Any] | None, b: Mapping[str, Any] | None) -> bool:
    return a is not None and b is not None and a["version"] == b["version"] and not differences(a, b)


if __name__ == "__main__":
    print(json.dumps({name: _made_here(name, case) for name, case in sorted(cases().items())}))
