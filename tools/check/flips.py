"""Flip bits in a map's catalog and arrays, one at a time, and count how many gsmap finds.

    python -m tools.check.flips                  200 flips of a small map made for it
    python -m tools.check.flips --count 2000

Each flip is looked for three times: as it lies there, in a copy of the map (``cp -r``), and after another verb tried to
write to the map. Half of the flips hit the catalog (free pages and all), half the arrays. ``list`` must fail on those
of the catalog, ``check`` on all.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsmap.errors import CorruptError, GsmapError
from gsmap.store import Store, sqlite
from gsmap.types import Cameras, Gaussians
from tools.harness import argument_parser

WAYS = ("fresh", "after cp -r", "after a write")


def make_map(path: Path) -> None:
    """A map of two scenes with free pages in its catalog."""
    rng = np.random.default_rng(0)
    pose = np.tile(np.eye(4), (3, 1, 1))
    cameras = Cameras(pose, np.tile([100.0, 100, 32, 24], (3, 1)), np.tile([64, 48], (3, 1)), ("a", "b", "c"))
    with Store.create(path) as store:
        for name in ("monday", "tuesday"):
            means, quats, sh = rng.normal(size=(400, 3)), rng.normal(size=(400, 4)), rng.normal(size=(400, 4, 3))
            gaussians = Gaussians(means, quats, rng.normal(size=(400, 3)) - 4, rng.normal(size=400), sh)
            store.scenes.add(gaussians, cameras, name=name)
        with store.catalog.write() as connection:
            connection.exec_driver_sql("CREATE TABLE passing (content TEXT)")
            connection.exec_driver_sql("INSERT INTO passing VALUES (?)", ("x" * 40_000,))
        with store.catalog.write() as connection:
            connection.exec_driver_sql("DROP TABLE passing")


@contextlib.contextmanager
def flipped(file: Path, rng: random.Random) -> Iterator[None]:
    """One bit of a file is another one, and its time is as it was, as a bad disk leaves it."""
    whole, stamp = file.read_bytes(), file.stat()
    broken = bytearray(whole)
    broken[rng.randrange(len(broken))] ^= 1 << rng.randrange(8)
    file.write_bytes(broken)
    os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    try:
        yield
    finally:
        file.write_bytes(whole)
        os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def lists(path: Path) -> bool:
    """Whether a map can be opened and listed."""
    try:
        with Store.open(path) as store:
            return len(store.scenes.list()) >= 0
    except CorruptError:
        return False


def checks(path: Path) -> bool:
    """Whether ``check`` finds a map whole."""
    try:
        with Store.open(path) as store:
            return store.check().ok
    except CorruptError:
        return False


def write(path: Path) -> None:
    """What another verb does: it writes if it can."""
    with contextlib.suppress(GsmapError), Store.open(path) as store:
        store.scenes.edit("monday", note="seen")


def count_found(path: Path, count: int, seed: int = 0) -> tuple[dict[str, int], int, int]:
    """How many of so many flips ``check`` finds in each of `WAYS`, and how many of those in the catalog ``list`` does.

    Args:
        path: of a map that nobody uses; as before afterwards.
    """
    rng = random.Random(seed)
    names = [sqlite.FILE, f"{sqlite.FILE}.digests"]
    arrays = sorted(str(p.relative_to(path)) for p in (path / "arrays").rglob("*") if p.is_file())
    found = dict.fromkeys(WAYS, 0)
    listed = of_catalog = 0
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".flips_") as folder:
        for i in range(count):
            name = rng.choice(arrays) if i % 2 else names[i % 20 == 0]
            for way in WAYS:
                copy = Path(folder) / "copy.gsmap"
                shutil.copytree(path, copy, copy_function=shutil.copy2)
                seen = copy
                with flipped(copy / name, random.Random(seed * 1_000_003 + i)):
                    if way == "after cp -r":
                        seen = Path(folder) / "copied.gsmap"
                        shutil.copytree(copy, seen, copy_function=shutil.copyfile)
                    elif way == "after a write":
                        write(copy)
                    found[way] += not checks(seen)
                    if way == "fresh" and not i % 2:
                        of_catalog += 1
                        listed += not lists(seen)
                shutil.rmtree(copy)
                shutil.rmtree(Path(folder) / "copied.gsmap", ignore_errors=True)
    return found, listed, of_catalog


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="flips_") as folder:
        path = Path(folder) / "site.gsmap"
        make_map(path)
        assert checks(path), "the map is not whole to begin with"
        found, listed, of_catalog = count_found(path, args.count, args.seed)
        assert checks(path), "a flip was left behind"
    for way in WAYS:
        print(f"found {found[way]} of {args.count}: {way}")
    print(f"list refused {listed} of {of_catalog} flipped catalogs")
    return 0 if all(n == args.count for n in found.values()) and listed == of_catalog else 1


if __name__ == "__main__":
    raise SystemExit(main())
