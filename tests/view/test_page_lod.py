"""The choice of tiles to draw, against a plain one that looks at everything anew for each step."""

from __future__ import annotations

import json
import subprocess

import numpy as np
from stage_site import bundle


def tree(rng: np.random.Generator, ids: list[int], depth: int, error: float) -> dict:
    node = {"id": len(ids), "count": int(rng.integers(1, 100)), "error": error, "ready": bool(rng.random() < 0.6)}
    ids.append(node["id"])
    if rng.random() < 0.1:
        node["error"] = -1.0
    if depth == 0:
        node["finer"] = None if rng.random() < 0.1 else []
    else:
        below = [float(error * rng.uniform(0.2, 1.0)) for _ in range(rng.integers(0, 4))]
        node["finer"] = [tree(rng, ids, depth - 1, e) for e in below]
    return node


def plain(roots: list[dict], budget: int, least: float) -> dict:
    """The same by the words of its description: refine the worst, skip what does not fit, until nothing is left."""
    cut = [root for root in roots if root["error"] >= 0]
    refined, unknown, left_alone = set(), [], set()
    while True:
        worst = None
        for tile in cut:
            may = tile["error"] > least and tile["id"] not in left_alone and tile["finer"] != []
            if may and (worst is None or tile["error"] > worst["error"]):
                worst = tile
        if worst is None:
            break
        left_alone.add(worst["id"])
        if worst["finer"] is None:
            unknown.append(worst["id"])
            continue
        seen = [finer for finer in worst["finer"] if finer["error"] >= 0]
        after = [tile for tile in cut if tile is not worst] + seen
        total, was = (sum(tile["count"] for tile in tiles) for tiles in (after, cut))
        if total <= max(budget, was):
            cut = after
            refined.add(worst["id"])

    def covers(tile: dict) -> bool:
        seen = [finer for finer in tile["finer"] or [] if finer["error"] >= 0]
        return tile["ready"] or (tile["id"] in refined and all(covers(finer) for finer in seen))

    def drawn(tile: dict) -> list[int]:
        if tile["error"] < 0:
            return []
        seen = [finer for finer in tile["finer"] or [] if finer["error"] >= 0]
        if tile["id"] in refined and (all(covers(finer) for finer in seen) or not tile["ready"]):
            return [one for finer in seen for one in drawn(finer)]
        return [tile["id"]] if tile["ready"] else []

    return {
        "tiles": sorted(tile["id"] for tile in cut),
        "unknown": sorted(unknown),
        "splats": sum(tile["count"] for tile in cut),
        "drawn": sorted(one for root in roots for one in drawn(root)),
    }


def test_the_greedy_cut_is_the_plain_one(tmp_path):
    rng = np.random.default_rng(0)
    cases = []
    for _ in range(300):
        ids: list[int] = []
        roots = [tree(rng, ids, 4, float(rng.uniform(1, 100))) for _ in range(rng.integers(1, 6))]
        cases.append({"roots": roots, "budget": int(rng.integers(0, 4000)), "least": float(rng.uniform(0, 20))})
    script = bundle("lod.ts", tmp_path / "lod.mjs", platform="node")
    run = subprocess.run(["node", script], input=json.dumps(cases), capture_output=True, text=True, check=True)
    for case, got in zip(cases, json.loads(run.stdout), strict=True):
        assert got == plain(**case)


def test_a_drawn_tile_never_stands_with_its_ancestors(tmp_path):
    rng = np.random.default_rng(1)
    ids: list[int] = []
    roots = [tree(rng, ids, 5, 100.0) for _ in range(20)]
    script = bundle("lod.ts", tmp_path / "lod.mjs", platform="node")
    case = {"roots": roots, "budget": 10_000, "least": 1.0}
    run = subprocess.run(["node", script], input=json.dumps([case]), capture_output=True, text=True, check=True)
    drawn = set(json.loads(run.stdout)[0]["drawn"])
    assert drawn

    def check(tile: dict, above: bool) -> None:
        assert not (above and tile["id"] in drawn)
        for finer in tile["finer"] or []:
            check(finer, above or tile["id"] in drawn)

    for root in roots:
        check(root, False)
