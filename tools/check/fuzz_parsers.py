"""Feed every parser that takes bytes from outside with damaged files, guided by the code they reach: what it returns
must be a result or a GsmapError.

    pip install atheris
    python -m tools.check.fuzz_parsers [--inputs N] [--parsers a,b] [--seed S] [--keep FOLDER]

N inputs are shared among the parsers (`fuzz_targets`), each of which runs in a process of its own: libFuzzer
keeps what reaches new branches of gsmap and damages it further, also beneath gzip, zstd, ZIP, WebP, GLB and protobuf
(`fuzz_mutators`). An input fails where it raises anything but a GsmapError, where that says more than one line
of 1000 characters, warns, takes 5 s of CPU or more memory, mapped or touched, than twice the file and 64 MB, or ends
the process. What fails is written to the folder of --keep, three inputs of a kind; exit 1 if anything did.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import pkgutil
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from tools.harness import argument_parser, say

MAX_BYTES = 64 << 20
LIMIT_S = 5
MAX_MESSAGE = 1000
MAX_INPUT_BYTES = 16_384
_PAGE = resource.getpagesize()
_RESTARTS = 20


class TooSlow(BaseException):
    """An input took more CPU time than it may."""


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--inputs", type=int, default=20_000, help="of all parsers together")
    parser.add_argument("--parsers", default="", help="comma-separated; all without it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", default="/tmp/fuzz_failures")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # a process for one parser
    args = parser.parse_args()
    if args.one:
        return child(args.one, args.inputs, args.seed, Path(args.keep))
    import atheris  # noqa: F401

    from tools.check.fuzz_targets import TARGETS

    names = args.parsers.split(",") if args.parsers else list(TARGETS)
    unknown = set(names) - set(TARGETS)
    if unknown:
        parser.error(f"no parser {', '.join(unknown)}: choose of {', '.join(TARGETS)}")
    print(f"{'parser':20} {'inputs':>8} {'a second':>9} {'edges':>6} {'memory':>7} {'failures':>9}  outcomes")
    total, failed = 0, 0
    for name in names:
        done, failures = fuzz(name, args.inputs // len(names), args.seed, Path(args.keep))
        total, failed = total + done, failed + failures
    print(f"{'all':20} {total:8} {'':9} {'':6} {'':7} {failed:9}")
    return int(failed > 0)


def fuzz(name: str, inputs: int, seed: int, keep: Path) -> tuple[int, int]:
    """Run one parser in processes of its own, again where one was ended by an input; prints its line of the table."""
    outcomes: Counter[str] = Counter()
    done, edges, share, failures, start = 0, 0, 0.0, 0, time.monotonic()
    for restart in range(_RESTARTS):
        if done >= inputs:
            break
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder) / "report.json"
            # What is freed goes back to the system, so that the limit on memory means what is in use.
            tight = {"MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
            command = [
                sys.executable,
                "-m",
                "tools.check.fuzz_parsers",
                "--one",
                name,
                "--inputs",
                str(inputs - done),
                "--keep",
                str(keep),
            ]
            command += ["--seed", str(seed + restart)]
            ended = subprocess.run(
                command, env={**os.environ, **tight, "FUZZ_REPORT": str(report)}, stderr=subprocess.PIPE, text=True
            )
            found = json.loads(report.read_text()) if report.exists() else {"inputs": 0, "outcomes": {}, "share": 0}
        done += found["inputs"]
        outcomes.update(found["outcomes"])
        share = max(share, found["share"])
        edges = max([edges, *map(int, re.findall(r"cov: (\d+)", ended.stderr))])
        failures += found.get("failures", 0)
        if done < inputs:  # it did not come to its end
            failures += 1
            keep.mkdir(exist_ok=True)
            (keep / f"{name}.ended.{restart}.txt").write_text(ended.stderr[-20_000:])
            say(f"{name}: the process ended with {ended.returncode}, see {keep}")
            done += 1
    rate = done / (time.monotonic() - start)
    told = ", ".join(f"{kind} {count}" for kind, count in outcomes.most_common())
    print(f"{name:20} {done:8} {rate:9.0f} {edges:6} {share:7.0%} {failures:9}  {told}", flush=True)
    return done, failures


def child(name: str, inputs: int, seed: int, keep: Path) -> int:
    """Fuzz one parser; does not return."""
    import atheris

    with atheris.instrument_imports(include=["gsmap"]):
        from gsmap import formats
        from tools.check.fuzz_targets import TARGETS

        for module in pkgutil.iter_modules(formats.__path__):  # loaded on first use otherwise, when it is too late
            importlib.import_module(f"gsmap.formats.{module.name}")
    from gsmap.errors import GsmapError
    from tools.check.fuzz_mutators import either

    target = TARGETS[name]
    shared = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(dir=shared) as base:
        root, seeds = Path(base) / "in", Path(base) / "seeds"
        for folder in (root, Path(base) / "made", seeds):
            folder.mkdir()
        target.setup(root)
        for i, data in enumerate(target.seeds(Path(base) / "made")):
            (seeds / str(i)).write_bytes(data)
        path = root / target.file
        trial = Trial(name, target.read, path, keep)
        for file in sorted(seeds.iterdir()):  # loads what is loaded on first use
            path.write_bytes(file.read_bytes())
            with contextlib.suppress(GsmapError):
                target.read(path)

        def mutate(data: bytes, max_size: int, number: int) -> bytes:
            rng = random.Random(number)

            def guided(part: bytes) -> bytes:
                return bytes(atheris.Mutate(part, max(len(part) + 64, 128)))

            out = target.mutate(data, rng, guided) if rng.random() < 0.8 else None
            return (either(data, rng, guided) if out is None else out)[:max_size]

        warnings.simplefilter("error")
        signal.signal(signal.SIGVTALRM, too_slow)
        keep.mkdir(exist_ok=True)
        options = [f"-runs={inputs}", f"-seed={seed}", f"-max_len={MAX_INPUT_BYTES}", "-len_control=0", "-timeout=60"]
        options += ["-rss_limit_mb=0", f"-artifact_prefix={keep}/{name}.ended.", "-print_final_stats=0", "-verbosity=1"]
        options += ["-handle_int=0", "-handle_term=0", "-reload=0", "-mutate_depth=1"]
        atheris.Setup([sys.argv[0], *options, str(seeds)], trial, custom_mutator=mutate)
        trial.limit = inputs
        atheris.Fuzz()
    return 0


class Trial:
    """Gives one input after another to a parser and counts what comes of it."""

    def __init__(self, name: str, read: Any, path: Path, keep: Path) -> None:
        self.name, self.read, self.path, self.keep = name, read, path, keep
        self.outcomes: Counter[str] = Counter()
        self.seen: Counter[str] = Counter()
        self.inputs, self.failures, self.share, self.limit = 0, 0, 0.0, 0
        self.memory = os.open("/proc/self/statm", os.O_RDONLY)
        self.report = os.environ["FUZZ_REPORT"]

    def __call__(self, data: bytes) -> None:
        from gsmap.errors import GsmapError

        self.inputs += 1
        self.path.write_bytes(data)
        mapped, resident = (int(n) * _PAGE for n in os.pread(self.memory, 200, 0).split()[:2])
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        room = 2 * len(data) + MAX_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (mapped + room, resource.RLIM_INFINITY))
        signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT_S)
        problem, outcome = "", "read"
        try:
            self.read(self.path)
        except GsmapError as error:
            outcome = type(error).__name__
            if "\n" in str(error) or len(str(error)) > MAX_MESSAGE:
                problem = f"a message of {len(str(error))} characters or several lines"
            elif "allocate" in str(error):  # the limit, taken for damage
                problem = f"took too much memory: {error}"
        except (Exception, TooSlow) as error:
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            outcome = "failed"
            places = [f for f in traceback.extract_tb(error.__traceback__) if "gsmap" in f.filename] or [None]
            place = places[-1] and f"{Path(places[-1].filename).name}:{places[-1].lineno}"
            problem = f"{type(error).__name__} at {place}: {error}"
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        now = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if now > peak:  # the highest so far, so what this input took is known; lower ones are within the limit as well
            share = (now * 1024 - resident) / room
            self.share = max(self.share, share)
            problem = problem or (f"{share:.0%} of the memory it may take" if share > 1 else "")
        self.outcomes[outcome] += 1
        if problem:
            self.fail(problem, data)
        if self.inputs % 1000 == 0 or problem or self.inputs >= self.limit - 1:
            self.save()

    def fail(self, problem: str, data: bytes) -> None:
        self.failures += 1
        kind = re.sub(r"\W*\d+% of|\W*of \d+|[^\w.:]+", "_", problem.split(": ")[0])[:60]
        self.seen[kind] += 1
        if self.seen[kind] <= 3:
            file = self.keep / f"{self.name}.{kind}.{self.seen[kind]}"
            file.write_bytes(data)
            print(f"{self.name}: {ascii(problem)[:300]}; see {file}", flush=True)

    def save(self) -> None:
        found = {"inputs": self.inputs, "outcomes": self.outcomes, "failures": self.failures, "share": self.share}
        Path(self.report).write_text(json.dumps(found))


def too_slow(*_: object) -> None:
    raise TooSlow(f"more than {LIMIT_S} s")


if __name__ == "__main__":
    sys.exit(main())
