"""How long gsmap takes to start: bare Python, ``import gsmap`` and ``gsmap --help``, median wall milliseconds.

python -m tools.bench.start [--runs 11]
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

from tools.harness import argument_parser

COMMANDS = {
    "python -c pass": ["-c", "pass"],
    "import gsmap": ["-c", "import gsmap"],
    "gsmap --help": ["-P", "-m", "gsmap", "--help"],
}


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--runs", type=int, default=11)
    runs = parser.parse_args().runs
    print(f"{'command':<16} {'median ms':>10} {'min ms':>8}")
    for name, arguments in COMMANDS.items():
        wall_ms = []
        for _ in range(runs):
            start = time.perf_counter()
            subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
            wall_ms.append(1e3 * (time.perf_counter() - start))
        print(f"{name:<16} {statistics.median(wall_ms):>10.0f} {min(wall_ms):>8.0f}")


if __name__ == "__main__":
    main()
