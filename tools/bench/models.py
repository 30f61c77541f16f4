"""What a model's own process costs: a run in this process and one in that of `gsmap.networks`, by turns.

    python -m tools.bench.models MODEL.onnx [--runs N]

Prints the median of wall and the mean of CPU milliseconds of each, both processes' together.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable

import numpy as np
import onnxruntime

from gsmap.networks import ModelProcess
from gsmap.types.model import ModelLimits
from tools.harness import argument_parser


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("model")
    parser.add_argument("--runs", type=int, default=200)
    args = parser.parse_args()
    start = time.perf_counter()
    own = ModelProcess(args.model, ModelLimits())
    started_s = time.perf_counter() - start
    here = onnxruntime.InferenceSession(args.model, providers=["CPUExecutionProvider"])
    feed = {t.name: np.zeros([side or 1 for side in t.shape], np.float32) for t in own.inputs}
    wall: dict[str, list[float]] = {"in this process": [], "in its own": []}
    cpu = dict.fromkeys(wall, 0.0)
    calls: list[tuple[str, Callable[[], object]]] = [
        ("in this process", lambda: here.run(None, feed)),
        ("in its own", lambda: own.run(None, feed)),
    ]
    for block in range(max(1, args.runs // 20)):
        for name, call in calls if block % 2 else calls[::-1]:
            call()
            before = spent_s(own)
            for _ in range(20):
                begin = time.perf_counter()
                call()
                wall[name].append(time.perf_counter() - begin)
            cpu[name] += spent_s(own) - before
    sizes = ", ".join(f"{name} {list(value.shape)}" for name, value in feed.items())
    print(f"{args.model}: {sizes}; {len(wall['in its own'])} runs each, {started_s:.2f} s to start")
    for name, times in wall.items():
        print(f"{name:16} {1e3 * statistics.median(times):8.2f} ms wall, {1e3 * cpu[name] / len(times):8.2f} ms CPU")


def spent_s(model: ModelProcess) -> float:
    """CPU seconds of this process and the model's."""
    with open(f"/proc/{model.pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return time.process_time() + (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
