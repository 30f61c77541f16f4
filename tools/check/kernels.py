"""The native module by itself: numpy and nothing else, so that it runs under qemu-user too (tools/build_wheels.sh).

    python -m tools.check.kernels MODULE.so --write NUMBERS.npz     what this machine gives
    python -m tools.check.kernels MODULE.so --compare NUMBERS.npz  that another one's is alike, to float32's accuracy

Renders a seeded cloud forward and backward with the baseline kernels, and finds a clique.
"""

from __future__ import annotations

import importlib.util
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tools.harness import argument_parser

COUNT, WIDTH, HEIGHT = 3000, 96, 72


def load(path: Path) -> Any:
    """The module of a file, without the package around it."""
    spec = importlib.util.spec_from_file_location("_native", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{path} is no module of this Python")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def numbers(native: Any, name: str) -> dict[str, np.ndarray]:
    """What the kernels give under one instruction set."""
    used = native.use_instruction_set(name)
    assert used == name, f"this machine runs {used}, not {name}"
    rng = np.random.RandomState(7)
    means = (rng.uniform(-1, 1, (COUNT, 3)) * [2, 1.5, 1] + [0, 0, 4]).astype(np.float32)
    quats = rng.normal(size=(COUNT, 4)).astype(np.float32)
    log_scales = rng.uniform(-4, -2.5, (COUNT, 3)).astype(np.float32)
    # Up to where alpha is clamped at 0.99.
    logit_opacities = rng.uniform(-2, 8, COUNT).astype(np.float32)
    sh = (0.3 * rng.normal(size=(COUNT, 4, 3))).astype(np.float32)
    arrays = means, quats, log_scales, logit_opacities, sh
    pose = np.eye(4)[:3].copy()
    images = {
        "colour": np.empty((HEIGHT, WIDTH, 3), np.float32),
        "depth": np.empty((HEIGHT, WIDTH), np.float32),
        "alpha": np.empty((HEIGHT, WIDTH), np.float32),
        "dominant_id": np.empty((HEIGHT, WIDTH), np.int32),
    }
    view = native.View()
    view.forward(
        *arrays,
        pose=pose,
        intrinsics=np.array([80.0, 80, WIDTH / 2, HEIGHT / 2]),
        width=WIDTH,
        height=HEIGHT,
        ranges=None,
        background=np.array([0.1, 0.2, 0.3], np.float32),
        **images,
        max_weight=None,
    )
    gradients = [np.zeros(array.shape, np.float32) for array in arrays]
    g_colour = rng.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    g_depth, g_alpha = rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)
    g_pose = np.zeros((3, 4))
    view.backward(
        *arrays,
        background=np.array([0.1, 0.2, 0.3], np.float32),
        colour=images["colour"],
        depth=images["depth"],
        alpha=images["alpha"],
        g_colour=g_colour,
        g_depth=g_depth,
        g_alpha=g_alpha,
        gradients=gradients,
        g_pose=g_pose,
    )
    names = ("means", "quats", "log_scales", "logit_opacities", "sh", "pose")
    # Relative to the largest of each kind: most Gaussians hardly matter.
    scaled = {f"gradient of {n}": g / np.abs(g).max() for n, g in zip(names, [*gradients, g_pose], strict=True)}
    return images | scaled | {"clique": clique(native, rng)}


def clique(native: Any, rng: np.random.RandomState) -> np.ndarray:
    """The members of the largest clique of a random graph of 120 vertices, 14 of which all know each other."""
    joined = np.triu(rng.uniform(size=(120, 120)) < 0.3, 1)
    friends = np.sort(rng.permutation(120)[:14])
    joined[np.ix_(friends, friends)] = np.triu(np.ones((14, 14), bool), 1)
    rows = np.zeros((120, 128), bool)
    rows[:, :120] = joined | joined.T
    bits = np.packbits(rows, axis=1, bitorder="little").view(np.uint64)
    members, _, _ = native.maximum_clique(bits, 0, 10**7)
    return np.sort(members).astype(np.int32)


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("module", type=Path)
    parser.add_argument("--write", type=Path)
    parser.add_argument("--compare", type=Path)
    args = parser.parse_args()
    native = load(args.module)
    found = numbers(native, "baseline")
    if args.write:
        np.savez(args.write, **found)
    worst = 0.0
    if args.compare:
        stored = np.load(args.compare)
        for name in stored.files:
            if stored[name].dtype.kind == "i":
                alike = found[name].shape == stored[name].shape
                same = float((found[name] == stored[name]).mean()) if alike else 0.0
                print(f"{name}: {100 * same:.2f} % the same")
                worst = max(worst, 1.0 if same < 0.999 else 0.0)
                continue
            apart = np.abs(found[name] - stored[name]) / (1e-3 + np.abs(stored[name]))
            share = float((apart > 1e-4).mean())
            print(f"{name}: median difference {np.median(apart):.1e}, over 1e-4 in {100 * share:.2f} %")
            worst = max(worst, share / 0.005)
        print(f"{platform.machine()}: {'the same numbers' if worst < 1 else 'OTHER NUMBERS'}")
    return 0 if worst < 1 else 1


if __name__ == "__main__":
    sys.exit(main())
