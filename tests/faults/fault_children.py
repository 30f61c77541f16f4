"""What the processes of the stateful tests do: each runs one verb on a map, and says what went wrong."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from fault_verbs import capture

from gsmap.cli.app import run
from gsmap.store import Store
from gsmap.types import Cameras, PoseGraph, ScenePose, Sim3

COUNT = 60


def ingest(path: Path, out: Path, about: str) -> None:
    cameras = Cameras(np.eye(4)[None], np.array([[20.0, 20, 16, 12]]), np.array([[32, 24]]), ("a",))
    with Store.open(path) as store:
        store.scenes.add(capture(int(about), COUNT), cameras, name=f"scene{about}")


def place(path: Path, out: Path, about: str) -> None:
    """A revision: what the optimizer would store."""
    with Store.open(path) as store:
        scenes = [scene.id for scene in store.scenes.list()]
        if scenes:
            store.revisions.save(PoseGraph({s: ScenePose(s, Sim3.identity(), 0, "placed") for s in scenes}))


def create(path: Path, out: Path, about: str) -> None:
    Store.create(path).close()


def cli(line: str) -> Callable[[Path, Path, str], None]:
    def work(path: Path, out: Path, about: str) -> None:
        words = {"MAP": str(path), "OUT": str(out), "ABOUT": about}
        run([words.get(word, word) for word in line.split()])

    return work


WORK = {
    "create": create,
    "ingest": ingest,
    "place": place,
    "remove": cli("remove MAP ABOUT"),
    "prune": cli("prune MAP --keep-revisions 2"),
    "edit": cli("edit MAP ABOUT --tag seen"),
    "anchor": cli("prior MAP ABOUT --anchor"),
    "export": cli("export MAP OUT --merge union --tile-size 0"),
}


def do(what: str, path: Path, out: Path, about: str, said: Path) -> None:
    """Run one of `WORK`, with all that it prints in a file."""
    handle = os.open(said, os.O_WRONLY | os.O_CREAT)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    code = 1
    try:
        os.environ["GSMAP_WORKERS"] = "1"
        WORK[what](path, out, about)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def look(path: Path, sure: Collection[str], gone: Collection[str], tagged: Collection[str], said: Path) -> None:
    """Whether a map holds what it must, and no less."""
    problems = []
    with Store.open(path, "r") as store:
        scenes = {scene.name: scene for scene in store.scenes.list()}
        problems += [f"{name} is lost" for name in sure if name not in scenes]
        problems += [f"{name} is back" for name in gone if name in scenes]
        problems += [f"{name} lost its tag" for name in tagged if name in scenes and "seen" not in scenes[name].tags]
        problems += [f"{name} is cut off" for name in scenes if len(store.scenes.gaussians(name)) != COUNT]
        problems += store.check().problems
    said.write_text("\n".join(problems))
    os._exit(bool(problems))
