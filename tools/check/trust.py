"""What "a store to trust" promises, measured: one line a promise, with its figure and its bar.

    python -m tools.check.trust --quick           a part of each (minutes)
    python -m tools.check.trust                   all of it (hours; the soaks alone take 10 minutes each)
    python -m tools.check.trust --only flips orders
    python -m tools.check.trust --postgres postgresql+psycopg://user@host/database

Each promise is a command of its own that ends with 0 where its bar is met; its whole output goes to ``--logs``. Fuzzing
wants the package atheris, the soak on PostgreSQL a server's programs or an empty database. Ends with 1 where any
promise is not kept.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]


def last_line(out: str) -> str:
    return next((line.strip() for line in reversed(out.splitlines()) if line.strip()), "said nothing")


def every_line(out: str) -> str:
    return "; ".join(line.strip() for line in out.splitlines() if line.strip())


def total(out: str) -> str:
    """The sums of a sweep: what is not zero, and what must be."""
    try:
        sums = json.loads(out)["total"]
    except (ValueError, KeyError):
        return last_line(out)
    return ", ".join(f"{name} {count:.0f}" for name, count in sums.items() if name != "seconds")


@dataclass(frozen=True)
class Promise:
    """A line of the table.

    Args:
        name: of `--only`.
        says: what is promised.
        bar: what the figure must be.
        full, quick: arguments of Python.
        figure: of the command's output.
        wants: what must be in the output besides.
    """

    name: str
    says: str
    bar: str
    full: str
    quick: str
    figure: Callable[[str], str] = last_line
    wants: tuple[str, ...] = ()


SWEEP = "-m tools.check.disk_faults --json"
PROMISES = (
    Promise(
        "hostile",
        "maps, tiles and captures from strangers",
        "30 of 30, 0 bytes outside, 0 to the server",
        "-m pytest -q tests/hostile",
        "-m pytest -q tests/hostile",
    ),
    Promise(
        "kills",
        "every change of the disk: killed, failed, power cut",
        "500+ kills, 500+ faults; 0 lost, 0 tracebacks, 0 untrue",
        SWEEP,
        f"{SWEEP} --every 25 --states 4",
        total,
    ),
    Promise(
        "flips",
        "bits flipped in catalog and arrays",
        "100 % of 200 found, three ways",
        "-m tools.check.flips --count 200",
        "-m tools.check.flips --count 20",
        every_line,
    ),
    Promise(
        "soak",
        "8 writers, 8 readers and backups, SQLite",
        "nothing lost, never locked, the backup is a committed state",
        "-m tools.check.soak --backup --minutes 10",
        "-m tools.check.soak --backup --minutes 0.5 --writers 2 --readers 2",
    ),
    Promise(
        "soak-postgres",
        "the same on PostgreSQL",
        "the same",
        "-m tools.check.soak --backup --minutes 10 --only-postgres --postgres {postgres}",
        "-m tools.check.soak --backup --minutes 0.5 --writers 2 --readers 2 --only-postgres --postgres {postgres}",
    ),
    Promise(
        "values",
        "two maps of 50 scenes merged",
        "0 graphs made again",
        "-m tools.bench.values",
        "-m tools.bench.values --scenes 5",
        every_line,
        ("graphs made again: 0", " 0 within one of them"),
    ),
    Promise(
        "orders",
        "the same captures in 20 orders",
        "the same accepted edges, 1 mm",
        "-m tools.check.orders --orders 20",
        "-m tools.check.orders --orders 4 --places 1 --remember",
    ),
    Promise(
        "releases",
        "maps of every release",
        "open, migrate, check, export, go on",
        "-m pytest -q tests/map/test_map_releases.py",
        "-m pytest -q tests/map/test_map_releases.py",
    ),
    Promise(
        "fuzz",
        "damaged input to every parser, guided by coverage",
        "10^6 inputs, 0 failures",
        "-m tools.check.fuzz_parsers --inputs 1000000",
        "-m tools.check.fuzz_parsers --inputs 5000",
    ),
)


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="a part of each")
    parser.add_argument("--only", nargs="+", choices=[promise.name for promise in PROMISES], metavar="NAME")
    parser.add_argument("--postgres", metavar="URL", default="temporary", help="an empty database, or a server's own")
    parser.add_argument("--logs", type=Path, default=Path("trust_logs"), help="what the commands print")
    args = parser.parse_args()
    args.logs.mkdir(parents=True, exist_ok=True)
    kept = []
    for promise in PROMISES:
        if args.only and promise.name not in args.only:
            continue
        command = promise.quick if args.quick else promise.full
        done, figure, took = run(promise, command.format(postgres=args.postgres), args.logs)
        kept.append(done)
        print(f"{'kept' if done else 'NOT '}  {promise.name:14} {promise.says} ({took:.0f} s)", flush=True)
        print(f"      {'':14} {figure}\n      {'':14} bar: {promise.bar}", flush=True)
    print(f"{sum(kept)} of {len(kept)} promises kept{', each in part' if args.quick else ''}")
    return 0 if all(kept) else 1


def run(promise: Promise, command: str, logs: Path) -> tuple[bool, str, float]:
    """Whether a promise is kept, its figure, and the seconds that took."""
    there = os.pathsep.join([str(ROOT), str(ROOT / "synthetic"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": there, "COLUMNS": "200"}
    environment.setdefault("OMP_NUM_THREADS", "1")
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, *shlex.split(command)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    (logs / f"{promise.name}.txt").write_text(f"python {command}\n\n{done.stdout}\n{done.stderr}")
    figure = promise.figure(done.stdout) if done.stdout.strip() else last_line(done.stderr)
    kept = done.returncode == 0 and all(text in done.stdout for text in promise.wants)
    return kept, figure, time.monotonic() - begin


if __name__ == "__main__":
    sys.exit(main())
