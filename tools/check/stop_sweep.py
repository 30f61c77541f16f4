"""Stop `gsmap update` by random signals at random moments, and look at what is left.

    python -m tools.check.stop_sweep --runs 200 [--seed 0] [--captures FOLDER] [--within 10]

Each run goes on with the map that the one before left. After each: no process of the run is alive two seconds later, it
said one line (nothing after SIGKILL) and no traceback, and its exit code tells the signal. At the end the same command
comes through and the map is whole. Exits with 1 where anything differs.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
COMMAND = [sys.executable, "-c", "from gsmap.cli import main; main()"]
ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "synthetic"), os.environ.get("PYTHONPATH", "")]),
    "GSMAP_WORKERS": "2",
}


def alive(session: int) -> list[int]:
    """The processes of a session."""
    found = []
    for path in Path("/proc").iterdir():
        if path.name.isdecimal():
            try:
                fields = (path / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == session and fields[0] not in "ZX":
                found.append(int(path.name))
    return found


def stopped(arguments: list[str], signum: signal.Signals, delay_s: float, group: bool) -> tuple[bool, float, list[str]]:
    """Whether the run had ended by itself, how long after the signal its last process did, and what was wrong."""
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([*COMMAND, *arguments], env=ENVIRONMENT, start_new_session=True, **pipe)
    try:
        _, err = process.communicate(timeout=delay_s)
        return True, 0.0, [] if process.returncode == 0 else [err.strip()[-300:]]
    except subprocess.TimeoutExpired:
        pass
    (os.killpg if group else os.kill)(process.pid, signum)
    began = time.monotonic()
    while alive(process.pid) and time.monotonic() - began < 10:
        time.sleep(0.01)
    took = time.monotonic() - began
    left = alive(process.pid)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    _, err = process.communicate()
    said = [line for line in err.splitlines() if line.startswith("gsmap: ")]
    wrong = [f"{len(left)} alive"] if took > 2 else []
    if "Traceback" in err:
        wrong.append(err)
    if signum == signal.SIGKILL:
        return False, took, wrong
    if len(said) != 1 or not said[0].startswith("gsmap: interrupted"):
        wrong.append(f"said {said}")
    if process.returncode != 128 + signum:
        wrong.append(f"exit code {process.returncode}")
    return False, took, wrong


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--captures", type=Path, help="a folder of captures; three small ones are made else")
    parser.add_argument("--within", type=float, default=10.0, help="seconds after the start to stop a run within")
    args = parser.parse_args()
    for signum in SIGNALS:  # nohup, and a shell that starts this in the background, have the runs ignore some
        if signal.getsignal(signum) == signal.SIG_IGN:
            signal.signal(signum, signal.SIG_DFL)
    rng, worst, num_wrong, complete = random.Random(args.seed), 0.0, 0, 0
    with tempfile.TemporaryDirectory(prefix="stop_sweep_") as folder:
        captures = args.captures or Path(folder) / "captures"
        if args.captures is None:
            sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "cli")]
            from cli_rooms import write_captures

            write_captures(captures)
        site = Path(folder) / "site.gsmap"
        update = ["update", str(site), str(captures)]
        for run in range(args.runs):
            signum, delay_s, group = rng.choice(SIGNALS), rng.uniform(0.2, args.within), rng.random() < 0.5
            if complete > 0 and rng.random() < 0.5:  # begin again: an update with nothing to do is soon over
                site.rename(site.with_name(f"done{run}.gsmap"))
                complete = 0
            ended, took, wrong = stopped(update, signum, delay_s, group)
            complete += ended
            worst, num_wrong = max(worst, took), num_wrong + bool(wrong)
            whom = "all" if group else "parent"
            what = "came through" if ended else f"{signum.name} to {whom} after {delay_s:.2f} s: gone in {took:.2f} s"
            print(f"{run:4} {what}", *wrong, flush=True)
        for arguments in (update, ["check", str(site)]):
            done = subprocess.run([*COMMAND, *arguments], env=ENVIRONMENT, capture_output=True, text=True)
            if done.returncode:
                num_wrong += 1
                print(f"gsmap {arguments[0]} afterwards: {done.stdout}{done.stderr}")
    print(f"{args.runs - num_wrong} of {args.runs} runs as they should; the slowest was gone in {worst:.2f} s")
    return 1 if num_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
