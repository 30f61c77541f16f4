"""Many processes on one map for a while, with backups all the time; then nothing may be lost.

    python -m tools.check.soak --minutes 10 --backup                        8 writers and 8 readers on SQLite
    python -m tools.check.soak --minutes 10 --backup --postgres temporary   then on PostgreSQL: its own server, or a URL

Writers ingest, edit, measure, confirm, reject, optimise, remove and prune; each notes what it committed, and when.
Readers list, show, read and check. At the end all that was noted must be in the map, nobody may have been told
"locked", and the map must be whole. Of the snapshots every so many-th is restored. It must be whole, too, and hold a
state that the map was in: what was committed before it was read and nothing that was begun later, so that no action is
missing that was over before another one began that is there. One line for each database; exit code 1 where one fails.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack, suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tools.harness import argument_parser, say

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "store")]

import gsmap.map
from gsmap.errors import BusyError, GsmapError, NotFoundError
from gsmap.types import Cameras, Gaussians, Prior, Sim3

LIVING = 5  # scenes that a writer has at a time: the work is to be small
KEEP = 60  # snapshots at a time


class Log:
    """What one process did: a line of JSON for each action, with its times before and after."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def run(self, do: str, action: Any, **what: Any) -> Any:
        """Run an action and note it; errors are noted and do not end the process."""
        began = time.time()
        try:
            answer = action()
            note = what
        except Exception as error:
            answer = None
            busy = isinstance(error, BusyError) or "locked" in str(error).lower()
            note = {"error": f"{type(error).__name__}: {error}", "busy": busy}
        if "scene" in note and note["scene"] is None:
            note = {**note, "scene": answer[0].scene}
        if "revision" in note:
            note = {**note, "revision": answer.number}
        if "snapshot" in note:
            note = {**note, "snapshot": answer.snapshot.snapshot}
        with open(self._path, "a") as file:
            file.write(json.dumps({"do": do, "began": began, "ended": time.time(), **note}) + "\n")
        return answer


def capture(rng: np.random.Generator) -> tuple[Gaussians, Cameras]:
    n = 40
    gaussians = Gaussians(
        rng.uniform((-1, -1, 3), (1, 1, 8), (n, 3)),
        rng.normal(size=(n, 4)),
        np.full((n, 3), -4.0),
        np.zeros(n),
        np.zeros((n, 1, 3)),
    )
    return gaussians, Cameras(np.eye(4)[None], np.array([[100.0, 100, 32, 24]]), np.array([[64, 48]]), ("a",))


def write(path: str, log: Path, worker: int, until: float) -> None:
    """One writer, of scenes of its own."""
    rng, choose, noted = np.random.default_rng(worker), random.Random(worker), Log(log)
    mine: list[str] = []
    step = 0
    while time.time() < until:
        with gsmap.map.open(path) as m:  # sometimes for one action, sometimes for several
            for _ in range(choose.randint(1, 6)):
                step += 1
                act(m, mine, f"w{worker}-{step}", worker * 1e6 + step, rng, choose, noted)
                time.sleep(choose.uniform(0.05, 0.4))


def act(
    m: gsmap.map.Map,
    mine: list[str],
    mark: str,
    number: float,
    rng: np.random.Generator,
    choose: random.Random,
    noted: Log,
) -> None:
    """One action of a writer; ``mark`` and ``number`` are its own, and are found again in the catalog."""
    roll = choose.random()
    if len(mine) < 2 or (roll < 0.3 and len(mine) < LIVING):
        gaussians, cameras = capture(rng)
        added = noted.run("ingest", partial(m.ingest, gaussians, cameras=cameras, name=mark), scene=None)
        mine += [added[0].scene] if added else []
    elif roll < 0.45:
        noted.run("note", partial(m.edit, choose.choice(mine), note=mark), mark=mark)
    elif roll < 0.6:
        pair = ":".join(choose.sample(mine, 2))
        pose = Sim3(np.eye(3), np.array([number, 0.0, 0.0]))
        noted.run("edge", partial(m.add_edge, pair, pose, np.full(7, 0.1), mark), mark=mark)
        review = m.confirm if choose.random() < 0.7 else m.reject
        noted.run("review", partial(review, pair, mark), mark=mark)
    elif roll < 0.72:
        prior = Prior(choose.choice(mine), Sim3(np.eye(3), np.array([number, 0.0, 0.0])), np.full(7, 1.0))
        noted.run("prior", partial(m.set_prior, prior), mark=str(number))
    elif roll < 0.8:
        noted.run("optimize", m.optimize, revision=None)
    elif roll < 0.93:
        scene = mine.pop(0)
        noted.run("remove", partial(m.remove, scene), scene=scene)
    else:
        noted.run("prune", partial(m.prune, 2))


def read(path: str, log: Path, worker: int, until: float) -> None:
    """One reader. A scene that goes while it is read may not be found, and nothing else."""
    choose, noted = random.Random(100 + worker), Log(log)
    while time.time() < until:
        with gsmap.map.open(path) as m:
            rows = noted.run("list", m.scene_rows) or []
            for row in choose.sample(rows, min(2, len(rows))):
                noted.run("show", partial(look, m.show_scene, row.id))
                noted.run("read", partial(look, m.read, row.id))
            noted.run("status", m.status)
            if choose.random() < 0.1:
                report = noted.run("check", m.check)
                if report is not None and report.problems:
                    noted.run("check", partial(fail, str(report.problems)))
        time.sleep(choose.uniform(0.1, 0.5))


def look(action: Any, scene: str) -> None:
    with suppress(NotFoundError):
        action(scene)


def fail(text: str) -> None:
    raise GsmapError(text)


def back_up(path: str, log: Path, dest: Path, until: float) -> None:
    """Snapshots, one after the other, with a last one at the end."""
    noted, last = Log(log), False
    while not last:
        last = time.time() > until
        with gsmap.map.open(path) as m:
            noted.run("backup", partial(m.backup, dest, keep=KEEP), snapshot=None)
        time.sleep(1.0)


def held(path: Path) -> dict[str, set[str]]:
    """What a map holds of what writers note, by kind of action."""
    from sqlalchemy import text

    queries = {
        "ingest": "SELECT id FROM scenes",
        "remove": "SELECT id FROM scenes WHERE removed_at IS NOT NULL",
        "note": "SELECT value FROM scene_facts WHERE kind = 'note'",
        "edge": "SELECT notes FROM registrations WHERE proposer = 'manual'",
        "review": "SELECT note FROM reviews",
        "optimize": "SELECT number FROM revisions",
        "prior": 'SELECT "S_map_scene" FROM priors',
    }
    with gsmap.map.open(path) as m, m.store.catalog.read() as connection:
        out = {do: {str(row[0]) for row in connection.execute(text(query))} for do, query in queries.items()}
    out["edge"] = {mark for notes in out["edge"] for mark in json.loads(notes)}
    out["prior"] = {str(json.loads(pose)["translation"][0]) for pose in out["prior"]}
    return out


def evidence(action: dict[str, Any]) -> str:
    return str(action.get("mark") or action.get("scene") or action.get("revision"))


def wrong_with(path: Path, actions: list[dict[str, Any]], read_at: tuple[float, float]) -> list[str]:
    """Why a map is none that was there between two moments; see the head of this file."""
    there, out = held(path), []
    known = {do: {evidence(a) for a in actions if a["do"] == do} for do in there}
    marked = [a for a in actions if a["do"] in there]
    included = [a for a in marked if evidence(a) in there[a["do"]]]
    excluded = [a for a in marked if evidence(a) not in there[a["do"]]]
    out += [f"lacks {a['do']} {evidence(a)}, committed before" for a in excluded if a["ended"] < read_at[0]]
    out += [f"has {a['do']} {evidence(a)}, begun later" for a in included if a["began"] > read_at[1]]
    newest = max((a["began"] for a in included), default=0.0)
    out += [f"lacks {a['do']} {evidence(a)}, older than what it has" for a in excluded if a["ended"] < newest]
    for do, found in there.items():
        out += [f"has {do} {one}, which nobody committed" for one in sorted(found - known[do])]
    with gsmap.map.open(path) as m:
        report = m.check()
    return out + list(report.problems)


def soak(kind: str, folder: Path, url: str | None, args: argparse.Namespace) -> bool:
    """One database; prints its line."""
    path, logs, dest = folder / f"{kind}.gsmap", folder / f"{kind}-logs", folder / f"{kind}-backup"
    gsmap.map.create(path, catalog_url=url).close()
    logs.mkdir()
    until = time.time() + 60 * args.minutes
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["gsmap.map", "gsmap.store", "zarr", "gsmap.map.stages.ingest"])
    jobs = [(write, logs / f"write-{i}", i) for i in range(args.writers)]
    jobs += [(read, logs / f"read-{i}", i) for i in range(args.readers)]
    started = [context.Process(target=job, args=(str(path), log, i, until)) for job, log, i in jobs]
    if args.backup:
        started.append(context.Process(target=back_up, args=(str(path), logs / "backup", dest, until)))
    for process in started:
        process.start()
    for process in started:
        process.join(60 * args.minutes + 600)
    died = [process.exitcode for process in started if process.exitcode != 0]
    lines = [json.loads(line) for log in logs.iterdir() for line in log.read_text().splitlines()]
    errors = [line for line in lines if "error" in line]
    busy = [line for line in errors if line["busy"]]
    actions = [line for line in lines if "error" not in line and line["do"] not in ("backup",)]
    now = (time.time(), time.time())
    lost = wrong_with(path, actions, now)
    backups = {line["snapshot"]: line for line in lines if "snapshot" in line}
    names = [row for row in gsmap.map.snapshots(dest) if args.backup] if args.backup else []
    chosen = names[:: max(1, len(names) // args.restore)]
    unequal = []
    for row in chosen:
        taken = datetime.fromisoformat(row.created_at).timestamp()
        gsmap.map.restore(dest, folder / "restored", at=row.snapshot)
        unequal += [
            f"{row.snapshot} {one}"
            for one in wrong_with(folder / "restored", actions, (taken, backups[row.snapshot]["ended"]))
        ]
        shutil.rmtree(folder / "restored")
    for line in [*lost[:5], *unequal[:5], *(f"{e['do']}: {e['error']}" for e in errors[:10])]:
        say(f"  {line}")
    did = Counter(line["do"] for line in actions)
    written = sum(did[do] for do in ("ingest", "note", "edge", "review", "prior", "optimize", "remove", "prune"))
    reads = sum(did[do] for do in ("list", "show", "read", "status", "check"))
    broken = len({one.split()[0] for one in unequal})
    print(
        f"{kind}: {args.writers} writers and {args.readers} readers for {args.minutes:g} min: {written} commits "
        f"({', '.join(f'{did[do]} {do}' for do in sorted(did) if do in held(path) or do == 'prune')}), {reads} reads; "
        f"{len(lost)} lost or wrong, {len(busy)} locked, {len(errors) - len(busy)} other errors, {len(died)} died; "
        f"{len(backups)} snapshots, {len(chosen)} restored, {len(chosen) - broken} of them a state that was committed, "
        "and whole",
        flush=True,
    )
    return not (lost or unequal or errors or died) and bool(chosen) == bool(args.backup)


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--writers", type=int, default=8)
    parser.add_argument("--readers", type=int, default=8)
    parser.add_argument("--backup", action="store_true", help="back the map up all the time, into a folder")
    parser.add_argument("--restore", type=int, default=15, help="how many snapshots to restore at the end, about")
    parser.add_argument("--postgres", metavar="URL", help="on PostgreSQL, too: an empty database, or 'temporary'")
    parser.add_argument("--only-postgres", action="store_true", help="not on SQLite")
    parser.add_argument("--folder", type=Path, help="keep maps, logs and backups here")
    args = parser.parse_args()
    with ExitStack() as stack:
        folder = args.folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="soak-")))
        folder.mkdir(exist_ok=True)
        good = args.only_postgres or soak("sqlite", folder, None, args)
        if args.postgres:
            url = args.postgres
            if url == "temporary":
                from store_postgres import make_database, running_server

                url = make_database(stack.enter_context(running_server()), "soak")
            good = soak("postgresql", folder, url, args) and good
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
