"""What merging drops of an older capture, over constants of `gsmap.compare`: how these were chosen.

    python -m tools.make.change DEV --set dev
    python -m tools.make.change SEEN --set seen
    python -m tools.fit.drops DEV/* SEEN/2* --set segments._MAX_COLOUR_DISTANCE=.04,.05 --set segments._ADJACENT_M=.2,.5

For each value of each constant (of the module that uses it), the others as they are: the share of the Gaussians of
removed and of painted things that is dropped, and of those of others, at worst and in the mean over the places (see
tools/bench/change_scores.py).
The last column counts of others only those that both captures' photographs show in one colour: what a wall painted next
to it lights otherwise has changed, too. Under true poses.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.compare import segments
from gsmap.merge.changes import resolve_changes
from gsmap.types import PosedScene
from tools.bench import change_scores as scores
from tools.harness import argument_parser
from tools.make.change_truth import Truth

COLUMNS = ("gone", "painted", "false", "false_unlit")


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="+")
    parser.add_argument("--set", action="append", default=[], metavar="MODULE.NAME=V,V", help="values to try")
    args = parser.parse_args()
    places = [Truth(folder) for folder in args.places]
    captures = [[_placed(truth, time) for time in truth.times[:2]] for truth in places]
    tried: list[tuple[str, Any, str, float]] = [("defaults", segments, "_ADJACENT_M", segments._ADJACENT_M)]
    for text in args.set:
        path, values = text.split("=")
        module, name = import_module(f"gsmap.compare.{path.split('.')[0]}"), path.split(".")[1]
        kind = type(getattr(module, name))
        tried += [(f"{path}={v}", module, name, kind(v)) for v in values.split(",")]
    print(f"{'':24}", *(f"{c:>19}" for c in COLUMNS), "(worst, mean)")
    for label, module, name, value in tried:
        usual, rows = getattr(module, name), []
        setattr(module, name, value)
        for truth, scenes in zip(places, captures, strict=True):
            before, after = scenes[0].gaussians.means, resolve_changes(scenes).scenes[0].gaussians.means
            rows.append(scores.score_drops(truth, truth.times[1], truth.times[0], ~scores.kept_rows(before, after)))
        setattr(module, name, usual)
        cells = []
        for column in COLUMNS:
            values = [row[column] for row in rows]
            worst = (min if column in ("gone", "painted") else max)(values)
            cells.append(f"{worst:9.2%} {np.mean(values):9.2%}")
        print(f"{label:24}", *cells, flush=True)
    return 0


def _placed(truth: Truth, time: str) -> PosedScene:
    return PosedScene(truth.gaussians(time), truth.cameras(time), time, truth.captured_at(time))


if __name__ == "__main__":
    sys.exit(main())
