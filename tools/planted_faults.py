"""Plant faults in a copy of this checkout, one at a time, and see that the tests of their own room turn red.

    tools/planted_faults.py                  all of tools/faults/*.toml
    tools/planted_faults.py --rooms merge    one room's
    tools/planted_faults.py --only bends     those with this in their names
    tools/planted_faults.py --quick          one fault in each of five rooms: what CI does

A fault is a small change that ought not to pass unnoticed::

    [[fault]]
    name = "owner cells are not applied"
    file = "gsmap/merge/mergers/tto.py"
    old = "inside = owner(points)"
    new = "inside = points[:, 0] == points[:, 0]"
    tests = "tests/merge -k owner"

``old`` must occur exactly once in the file, so that a list grown old is noticed. ``quick = true`` says that a fault is
the one of its room to plant under ``--quick``; the first of a room is taken otherwise. Faults in C++ are built in the
copy.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
QUICK_ROOMS = ("geometry", "store", "optimize", "merge", "describe")
LEFT_OUT = shutil.ignore_patterns(
    ".git", "node_modules", ".venv", "__pycache__", "*.gsmap", ".*_cache", ".hypothesis", "dist"
)


@dataclass(frozen=True)
class Fault:
    """One entry of a list, and the room whose list it is in."""

    room: str
    name: str
    file: str
    old: str
    new: str
    tests: str
    quick: bool = False

    @property
    def native(self) -> bool:
        return self.file.endswith((".cpp", ".h"))

    def planted(self, root: Path) -> str:
        """The file's text with the fault in it.

        Raises:
            ValueError: the text it changes is not there exactly once, or nothing is changed.
        """
        path = root / self.file
        text = path.read_text() if path.is_file() else ""
        count = text.count(self.old)
        if count != 1 or self.old == self.new:
            raise ValueError(f"{self.room}: {self.name!r} wants its text once in {self.file}, found it {count} times")
        return text.replace(self.old, self.new)


def read_faults(folder: Path = ROOT / "tools" / "faults") -> list[Fault]:
    """All faults, room by room."""
    return [
        Fault(path.stem, **entry)
        for path in sorted(folder.glob("*.toml"))
        for entry in tomllib.loads(path.read_text())["fault"]
    ]


def chosen(faults: list[Fault], rooms: list[str], quick: bool, only: str = "") -> list[Fault]:
    """What to plant: of some rooms and names, or one of each room that the quick run looks at."""
    if rooms:
        faults = [f for f in faults if f.room in rooms]
    faults = [f for f in faults if only in f.name]
    if not quick:
        return faults
    have = list(dict.fromkeys(f.room for f in faults))
    order = [r for r in QUICK_ROOMS if r in have] + [r for r in have if r not in QUICK_ROOMS]
    firsts = [[f for f in faults if f.room == room] for room in order[:5]]
    return [next((f for f in room if f.quick), room[0]) for room in firsts]


def verdict(fault: Fault, copy: Path) -> str:
    """``red``, or what happened instead, with the fault in the copy; the copy is as before afterwards."""
    path = copy / fault.file
    before, stat = path.read_bytes(), path.stat()
    modules = {p: p.read_bytes() for p in (copy / "gsmap").glob("_native*.so")} if fault.native else {}
    path.write_text(fault.planted(copy))
    try:
        return _ran(fault, copy)
    finally:
        path.write_bytes(before)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        for module, content in modules.items():
            module.write_bytes(content)


def _ran(fault: Fault, copy: Path) -> str:
    there = os.pathsep.join([str(copy), str(copy / "synthetic")])
    environment = os.environ | {"PYTHONPATH": there, "PYTHONDONTWRITEBYTECODE": "1", "PYTHON": sys.executable}
    environment.setdefault("GSMAP_SHARED_DATA", str(ROOT.parent / "shared" / "data"))
    if fault.native:
        built = subprocess.run(
            [copy / "tools" / "build_native.sh"], cwd=copy, env=environment, capture_output=True, text=True
        )
        if built.returncode:
            return f"does not build: {built.stderr.strip().splitlines()[-1:] or built.stdout[-200:]}"
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *shlex.split(fault.tests)]
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    failed = re.search(r"^(FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode == 1 and failed:
        return "red"
    if done.returncode == 0:
        return "GREEN: it passes unnoticed"
    return f"no tests ran (pytest ended with {done.returncode}): {(done.stdout + done.stderr).strip()[-300:]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", default=[], metavar="ROOM")
    parser.add_argument("--only", default="", metavar="TEXT", help="faults that have this in their names")
    parser.add_argument("--quick", action="store_true", help="one fault in each of five rooms")
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout to plant them in a copy of")
    args = parser.parse_args()
    faults = chosen(read_faults(args.root / "tools" / "faults"), args.rooms, args.quick, args.only)
    if not faults:
        print("there are no such faults in tools/faults", file=sys.stderr)
        return 1
    red, began = 0, time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="planted_") as folder:
        copy = Path(folder) / "gsmap"
        shutil.copytree(args.root, copy, ignore=LEFT_OUT, symlinks=True)
        packages = Path("gsmap", "view", "page", "node_modules")  # many files, which no fault is planted in
        if (args.root / packages).is_dir():
            (copy / packages).symlink_to((args.root / packages).resolve())
        for fault in faults:
            start = time.perf_counter()
            said = verdict(fault, copy)
            red += said == "red"
            print(f"{fault.room:10} {fault.name:60} {time.perf_counter() - start:5.1f} s  {said}", flush=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(
        f"{red} of {len(faults)} planted faults are red "
        f"({time.perf_counter() - began:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of CPU)"
    )
    return 0 if red == len(faults) else 1


if __name__ == "__main__":
    sys.exit(main())
