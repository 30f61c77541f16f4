"""Measure which small faults (mutants) in a room its tests detect, by cosmic-ray (pip install '.[mutation]').

    python -m tools.check.mutation --room store --sample 200 --seed 0
    python -m tools.check.mutation --room optimize --module component_joins

Mutants are drawn at random from the modules in `TESTS` and planted in a copy of this checkout, one after another; each
runs the tests that `TESTS` names for its module. A mutant is killed where they fail or take far longer than without it.
Prints the share that is killed, by module, and the survivors: a fault that no test detects, or a change that makes no
difference.
"""

from __future__ import annotations

import argparse
import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

TESTS: Mapping[str, Mapping[str, str]] = {
    "store": {
        "array_archive": "test_store_array_archive.py",
        "array_encoding": "test_store_array_encoding.py",
        "backup/repository": "test_store_backup.py test_store_restore.py",
        "backup/saving": "test_store_backup.py",
        "change_rows": "test_store_changes.py",
        "compact": "test_store_compact.py",
        "facts": "test_store_facts.py",
        "leases": "test_store_leases.py",
        "matrices": "test_store_nouns.py test_store_revisions.py",
        "page_digests": "test_store_page_digests.py test_store_accepting.py",
        "photos": "test_store_photos.py",
        "priors": "test_store_nouns.py",
        "row_index_maps": "test_store_compact.py",
        "scene_replacement": "test_store_changes.py",
        "wal": "test_store_wal.py",
    },
    "optimize": {
        "aliasing_evidence": "test_optimize_doubtful.py",
        "component_joins": "test_optimize_steps.py test_optimize_components.py",
        "cycles": "test_optimize_cycles.py",
        "measurements": "test_optimize_bad_input.py test_optimize_steps.py",
        "priors": "test_optimize_priors.py",
        "report": "test_optimize_doubtful.py test_optimize_contradictions.py",
        "unchanged_poses": "test_optimize_unchanged.py",
    },
    "register": {
        "a_contrario": "test_register_matching.py test_register_evidence.py",
        "clique": "test_register_clique.py",
        "consistency": "test_register_matching.py",
        "duplicate": "test_register_duplicate.py",
        "evidence": "test_register_evidence.py",
        "pose": "test_register_matching.py",
        "pose_selection": "test_register_rivals.py",
        "probability": "test_register_probability.py",
        "verdict": "test_register_evidence.py",
    },
}
"""By room and module: its tests, in ``tests/ROOM``."""

_SKIPPED = ("BitOr", "RemoveDecorator")
"""Operators that mostly change annotations (``int | None``), or what dataclasses are by their decorator."""

_PRELOADED = (
    *("alembic.command", "gtsam", "networkx", "numpy", "PIL.Image", "pytest", "scipy.optimize", "scipy.sparse.linalg"),
    *("scipy.spatial", "scipy.stats", "sqlalchemy.dialects.sqlite", "torch", "zarr"),
)
"""Packages to import once, so that each mutant's tests, which run in a fork, begin at once. None of them is gsmap."""

_LEFT_OUT = shutil.ignore_patterns(".git", "node_modules", ".venv", "__pycache__", ".*_cache", "build", "docs", "dist")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", choices=sorted(TESTS), required=True)
    parser.add_argument("--module", action="append", help="of the room, as in TESTS; default: all of them")
    parser.add_argument("--sample", type=int, default=200, help="mutants to plant; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the sample; default: %(default)s")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no mutant after so long")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="gsmap-mutation-") as folder:
        copy = Path(folder) / "gsmap"
        shutil.copytree(ROOT, copy, ignore=_LEFT_OUT, symlinks=True)
        for built in (*copy.glob("gsmap/_native*.so"), *copy.glob("gsmap/view/built/*")):
            built.touch()  # newer than the copied sources
        os.chdir(copy)
        for package in _PRELOADED:
            with suppress(ImportError):
                importlib.import_module(package)
        tests = {name: _tests_of(given.room, name) for name in given.module or TESTS[given.room]}
        mutants = [mutant for name in tests for mutant in _mutants(given.room, name)]
        drawn = random.Random(given.seed).sample(mutants, min(given.sample, len(mutants)))
        _run(given.room, tests, Counter(name for name, *_ in mutants), drawn, 60 * given.minutes)


def _tests_of(room: str, module: str) -> list[str]:
    return [f"tests/{room}/{name}" for name in TESTS[room][module].split()]


def _mutants(room: str, module: str) -> Iterator[tuple[str, Path, Any]]:
    """The mutations that cosmic-ray has of a module."""
    from cosmic_ray.commands.init import _all_work_items
    from cosmic_ray.config import ConfigDict

    path = Path("gsmap") / room / f"{module}.py"
    for item in _all_work_items([path], ConfigDict()):
        (mutation,) = item.mutations
        if not any(skipped in mutation.operator_name for skipped in _SKIPPED):
            yield module, path, mutation


def _run(
    room: str,
    tests: Mapping[str, list[str]],
    sizes: Mapping[str, int],
    drawn: list[tuple[str, Path, Any]],
    most_s: float,
) -> None:
    from cosmic_ray.mutating import use_mutation
    from cosmic_ray.plugins import get_operator

    killed: Counter[str] = Counter()
    planted: Counter[str] = Counter()
    survivors: list[str] = []
    limits: dict[str, float] = {}
    began = time.monotonic()
    for name, path, mutation in drawn:
        if time.monotonic() - began > most_s:
            break
        if name not in limits:
            started = time.monotonic()
            if not _pass(tests[name], None):
                sys.exit(f"{' '.join(tests[name])} fail without a mutant")
            limits[name] = 30 + 5 * (time.monotonic() - started)
        operator = get_operator(mutation.operator_name)(**(mutation.operator_args or {}))
        with use_mutation(path, operator, mutation.occurrence) as (old, new):
            if new is None:
                continue
            planted[name] += 1
            survived = _pass(tests[name], limits[name])
            killed[name] += not survived
        line = mutation.start_pos[0]
        was, now = (text.splitlines()[line - 1].strip() for text in (old, new))
        told = f"{path}:{line} {mutation.definition_name or ''}: {was}  ->  {now}"
        print(f"{'survived' if survived else 'killed  '} {told}", file=sys.stderr, flush=True)
        if survived:
            survivors.append(told)
    print("| module | mutants | planted | killed | score |\n| --- | --- | --- | --- | --- |")
    for name in tests:
        print(_row(f"{room}/{name}", sizes[name], planted[name], killed[name]))
    print(_row("all", sum(sizes.values()), planted.total(), killed.total()))
    print("\nsurvivors:", *sorted(survivors), sep="\n")


def _pass(tests: list[str], limit_s: float | None) -> bool:
    """Return whether the tests pass, in a fork of this process; a run that takes too long does not."""
    import pytest

    child = os.fork()
    if child == 0:
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(nothing, stream)
        sys.dont_write_bytecode = True
        here = [str(Path.cwd() / part) for part in ("", "synthetic")]
        sys.path[:0] = here
        os.environ["PYTHONPATH"] = os.pathsep.join(here)  # of processes that tests start
        os._exit(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests]))
    began = time.monotonic()
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status == 0
        if limit_s is not None and time.monotonic() - began > limit_s:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return False
        time.sleep(0.05)


def _row(name: str, mutants: int, planted: int, killed: int) -> str:
    return f"| {name} | {mutants} | {planted} | {killed} | {f'{killed / planted:.0%}' if planted else '-'} |"


if __name__ == "__main__":
    main()
