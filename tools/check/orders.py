"""The same captures ingested in many orders: are the accepted edges the same, and the poses within a millimetre?

    python -m tools.check.orders                                    # 20 orders of each of two made places
    python -m tools.check.orders --orders 20 --captures c0.ply c1.ply c2.ply --places 0 [--thin 4]
    python -m tools.check.orders --orders 4 --places 1 --remember   # quick

Each capture is described once. In every order one map takes all captures and is updated once, each pair registered
anew, and one is updated after each capture (``grown``; there a pair is registered once for all maps, in each direction
that is asked for). ``mm`` is the largest way between two maps of a corner of a scene's box, seen from another scene of
its component, ``deg`` the largest turn, both against the first order at once. Ends with 1 where edges differ or more
than ``--bar`` mm lie between poses.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "synthetic"), str(ROOT / "tests" / "map")]

from map_orders import Described, Outcome, pairs_remembered  # noqa: E402

import gsmap.map  # noqa: E402
from gsmap.types import Cameras, Gaussians  # noqa: E402

Captures = dict[str, tuple[Gaussians, Cameras]]


@dataclass(frozen=True)
class Row:
    place: str
    order: str
    how: str
    accepted: int
    refused: int
    same_edges: bool
    mm: float
    deg: float
    seconds: float


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--orders", type=int, default=20)
    parser.add_argument("--captures", type=Path, nargs="+", default=[], help="files that gsmap ingests; or a folder")
    parser.add_argument("--thin", type=int, default=1, help="keep every n-th Gaussian of the captures")
    parser.add_argument("--places", type=int, default=2, help="made places, of five small captures each")
    parser.add_argument("--bar", type=float, default=1.0, help="mm")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--remember", action="store_true", help="register a pair once for all maps, in each direction")
    parser.add_argument("--json", type=Path, help="write all rows here")
    args = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="orders_") as folder:
        if args.captures:
            rows += compare("captures", read(args.captures, args.thin, Path(folder)), args, Path(folder))
        for seed in range(args.places):
            rows += compare(f"place {seed}", made(seed), args, Path(folder))
    if args.json:
        args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    same, near = [row.same_edges for row in rows], [row.mm <= args.bar for row in rows]
    print(
        f"{sum(same)} of {len(rows)} maps have the accepted edges of the first; poses at most "
        f"{max(row.mm for row in rows):.2g} mm and {max(row.deg for row in rows):.2g} deg apart (bar {args.bar:g} mm)"
    )
    return 0 if all(same) and all(near) else 1


def compare(place: str, captures: Captures, args: argparse.Namespace, folder: Path) -> list[Row]:
    """One line an order and way to ingest, printed as it comes."""
    at = folder / place.replace(" ", "_")
    at.mkdir()
    described = Described.of(at / "described.gsmap", captures)
    rng, names = np.random.default_rng(args.seed), list(captures)
    orders = [names]
    while len(orders) < min(args.orders, math.factorial(len(names))):
        order = [names[k] for k in rng.permutation(len(names))]
        orders += [order] if order not in orders else []
    rows: list[Row] = []
    first: Outcome | None = None
    print(f"{place}: {len(names)} captures, {sum(len(g) for g, _ in captures.values())} Gaussians", flush=True)
    with pairs_remembered() as anew:
        for number, order in enumerate(orders):
            for how in ("at once", "grown"):
                begin = time.perf_counter()
                with anew() if how == "at once" and not args.remember else nullcontext():
                    found = described.in_order(order, at / f"{number}{how[0]}.gsmap", one_by_one=how == "grown")
                first = first or found
                mm, deg = found.apart(first)
                took = time.perf_counter() - begin
                row = Row(
                    place,
                    " ".join(order),
                    how,
                    len(found.accepted),
                    found.refused,
                    found.same_edges(first),
                    mm,
                    deg,
                    took,
                )
                rows.append(row)
                print(
                    f"  {row.order:40} {how:8} {row.accepted:3} accepted {row.refused:3} not  "
                    f"{'same' if row.same_edges else 'OTHER'} edges  {mm:9.2g} mm {deg:9.2g} deg  {took:6.1f} s",
                    flush=True,
                )
    described.map.close()
    return rows


def read(paths: list[Path], thin: int, folder: Path) -> Captures:
    """Captures as gsmap ingests them, thinned."""
    with gsmap.map.create(folder / "read.gsmap") as m:
        m.ingest(*paths)
        found = {scene.name: m.read(scene.name) for scene in m.scenes()}
    return {name: (gaussians[::thin], cameras) for name, (gaussians, cameras) in found.items()}


def made(seed: int) -> Captures:
    """Five walks through a place of three rooms, each in a frame of its own."""
    from gsmap_synthetic import make_captures

    routes = [[0], [0, 1], [1], [1, 2], [0]]
    captures = make_captures(seed, 5, steps=0, num_frames=16, num_gaussians=12_000, size_px=(120, 90), routes=routes)
    return {capture.name: (capture.gaussians, capture.cameras) for capture in captures}


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
