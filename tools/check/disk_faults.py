#!/usr/bin/env python
"""Meet every change of the disk that verbs make: kill the process there, fail it, or cut the power.

    python -m tools.check.disk_faults                                 everything (about an hour of CPU)
    python -m tools.check.disk_faults --verbs ingest export --every 5 a part of it
    python -m tools.check.disk_faults --kill                          only kills; --fault, --power likewise

After each the map must open and be whole, nothing that was committed may be gone, what the verb said must be true, and
the same verb again must end as if nothing had happened. Prints a table; exit code 1 where anything was wrong.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from tools.harness import argument_parser, say

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "faults"))

from fault_client import Client
from fault_shim import FAULTS, KILLS, MODES, why_not
from fault_sweep import Point, Tally, points, run
from fault_verbs import VERBS


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--verbs", nargs="+", metavar="VERB", default=list(VERBS), choices=list(VERBS))
    parser.add_argument("--every", type=int, default=1, metavar="K", help="only every K-th change")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="the first of them")
    parser.add_argument("--modes", nargs="+", choices=list(MODES), help="only these ways to fail")
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--fault", action="store_true")
    parser.add_argument("--power", action="store_true")
    parser.add_argument("--states", type=int, default=32, help="states after a power cut, for each verb")
    parser.add_argument("--jobs", type=int, default=2, help="how many run at once")
    parser.add_argument("--json", action="store_true", help="print one JSON object: the table, and every complaint")
    args = parser.parse_args()
    if (reason := why_not()) is not None:
        say(f"cannot run here: {reason}")
        return 2
    every = not (args.kill or args.fault or args.power or args.modes)
    modes = args.modes or [*(KILLS if args.kill or every else ()), *(FAULTS if args.fault or every else ())]
    tally, began = Tally(), time.monotonic()
    with ExitStack() as stack:
        clients = [stack.enter_context(Client()) for _ in range(args.jobs)]
        for verb in args.verbs:
            if not VERBS[verb].possible:
                say(f"{verb}: needs the package {VERBS[verb].needs}")
                continue
            todo = points(verb, clients[0].ask("ops", verb=verb), modes, args.every, args.first)
            if args.power or every:
                todo.insert(0, Point(verb, "power", args.states))
            run(todo, clients, tally.add)
            row = tally.rows.get(verb, {})
            wrong = {k: int(v) for k, v in row.items() if v and k != "seconds"}
            say(f"{time.monotonic() - began:7.0f} s  {verb}: {wrong}")
    if args.json:
        print(json.dumps({"total": tally.total, "verbs": tally.rows, "complaints": tally.complaints}, indent=1))
    else:
        print(tally.table())
        if not tally.ok:
            print("\n" + tally.report())
    return 0 if tally.ok else 1


if __name__ == "__main__":
    sys.exit(main())
