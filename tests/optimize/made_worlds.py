"""Made worlds for the optimiser's tests: scenes in a flat cloud, edges between neighbours, some of them wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsmap.evaluate.registration import absolute_trajectory_error
from gsmap.geometry import similarities
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.params import Params
from gsmap.types import Edge, PoseGraph

PLACING = Params(max_full_scenes=0)
"""New scenes are placed one by one in maps of any size."""
ROT_RAD, TRANS_M, STIFF = np.radians(0.5), 0.05, 1e10


@dataclass
class World:
    ids: list[str]
    edges: list[Edge]
    truth: Similarities
    wrong: np.ndarray

    @property
    def wrong_keys(self) -> set[tuple[str, str]]:
        return {(e.target, e.source) for e, bad in zip(self.edges, self.wrong, strict=True) if bad}

    def worst_island_m(self, answer: PoseGraph) -> float:
        """Largest `ate` over islands of at least 10 placed scenes: large if one is folded."""
        islands = {p.component for p in answer.poses.values()}
        return max((self.ate(answer, k) for k in islands if len(self.placed(answer, k)) >= 10), default=0.0)

    def ate(self, answer: PoseGraph, island: int = 0) -> float:
        """ATE in metres of the placed scenes of an island."""
        rows = self.placed(answer, island)
        found = np.array([answer.poses[self.ids[k]].S_map_scene.translation for k in rows])
        return absolute_trajectory_error(found, self.truth.translations[rows])

    def placed(self, answer: PoseGraph, island: int = 0) -> list[int]:
        """Rows of the placed scenes of an island."""
        poses = [answer.poses[s] for s in self.ids]
        return [k for k, p in enumerate(poses) if p.component == island and p.status == "placed"]


def information(rot_rad: float = ROT_RAD, trans_m: float = TRANS_M, log_scale: float | None = None) -> np.ndarray:
    return np.diag([rot_rad**-2] * 3 + [trans_m**-2] * 3 + [STIFF if log_scale is None else log_scale**-2])


def poses_at(positions: np.ndarray, seed: int = 0) -> Similarities:
    n = len(positions)
    return Similarities(Rotation.random(n, random_state=seed).as_matrix(), np.asarray(positions, float), np.zeros(n))


def true_edges(truth: Similarities, pairs: np.ndarray, rng: np.random.Generator, ids: list[str]) -> list[Edge]:
    """Noisy measurements of the pairs (K, 2): target, source."""
    pairs = np.asarray(pairs).reshape(-1, 2)
    noise = np.c_[
        rng.normal(0, ROT_RAD, (len(pairs), 3)), rng.normal(0, TRANS_M, (len(pairs), 3)), np.zeros(len(pairs))
    ]
    measured = truth[pairs[:, 0]].inverse() @ truth[pairs[:, 1]] @ similarities.exp(noise)
    return [Edge(ids[a], ids[b], measured.item(k), information()) for k, (a, b) in enumerate(pairs)]


def near_pairs(positions: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` random ones of the shortest pairs."""
    k = min(len(positions), 25)
    near = cKDTree(positions).query(positions, k=k)[1]
    pairs = np.unique(np.sort(np.stack([np.repeat(near[:, 0], k - 1), near[:, 1:].ravel()], 1), axis=1), axis=0)
    length = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    pairs = pairs[np.argsort(length)[: int(1.5 * count)]]
    return pairs[np.sort(rng.permutation(len(pairs))[:count])]


def city(count: int, wrong_share: float, seed: int = 0, edges_per_scene: int = 5) -> World:
    """Scenes 3 m apart on a floor; ``wrong_share`` of the edges tie random scenes by random poses."""
    rng = np.random.default_rng(seed)
    side = 3.0 * np.sqrt(count)
    positions = np.c_[rng.uniform(0, side, (count, 2)), rng.uniform(0, 3, count)]
    truth = poses_at(positions, seed)
    ids = [f"s{k:05d}" for k in range(count)]
    num_wrong = round(wrong_share * edges_per_scene * count)
    pairs = near_pairs(positions, edges_per_scene * count - num_wrong, rng)
    edges = true_edges(truth, pairs, rng, ids)
    taken = set(map(tuple, pairs.tolist()))
    while len(edges) < edges_per_scene * count:
        a, b = sorted(rng.integers(0, count, 2).tolist())
        if a == b or (a, b) in taken:
            continue
        taken.add((a, b))
        off = poses_at(rng.normal(0, 3, (1, 3)), int(rng.integers(1 << 30)))
        edges.append(Edge(ids[a], ids[b], off.item(0), information()))
    return World(ids, edges, truth, np.arange(len(edges)) >= len(pairs))


def twin_wings(
    count: int, wrong_share: float, seed: int = 0, door_m: float | None = None, density: float = 0.0
) -> World:
    """A hall with two wings that look the same; wrong edges say that scenes of one wing lie in the other.

    The wrong edges agree with each other and with the true ones inside either wing: only the way round through the
    hall contradicts them.

    Args:
        wrong_share: of all edges.
        door_m: width of the opening between hall and wing; None leaves the whole side open.
        density: also tie this share of look-alike pairs, on top of ``wrong_share``.
    """
    rng = np.random.default_rng(seed)
    wing = count // 5
    width = 3.0 * np.sqrt(wing)
    length, depth = 4 * width, 3.0 * (count - 2 * wing) * 3 / (4 * width)
    hall = rng.uniform(0, 1, (count - 2 * wing, 3)) * [length, depth, 3]
    one = rng.uniform(0, 1, (wing, 3)) * [width, width, 3] + [0, depth, 0]
    shift = np.array([length - width, 0, 0])
    truth = poses_at(np.r_[hall, one, one + shift], seed)
    truth.rotations[count - wing :] = truth.rotations[count - 2 * wing : count - wing]
    ids = [f"s{k:05d}" for k in range(count)]
    pairs = near_pairs(truth.translations, 5 * count, rng)
    if door_m is not None:
        y = truth.translations[:, 1]
        x = truth.translations[:, 0] % (length - width)
        crosses = (y[pairs[:, 0]] < depth) != (y[pairs[:, 1]] < depth)
        far = np.abs(x[pairs] - width / 2).max(1) > door_m / 2
        pairs = pairs[~(crosses & far)]
    edges = true_edges(truth, pairs, rng, ids)
    # Scene k of the second wing seems to lie where scene k of the first one is.
    seems = truth.replaced(np.arange(count - wing, count), truth[np.arange(count - 2 * wing, count - wing)])
    first = np.arange(count - 2 * wing, count - wing)
    near = near_pairs(truth.translations[first], 5 * wing, rng)
    mixed = np.r_[near, near[:, ::-1]] + [count - 2 * wing, count - wing]
    keep = max(round(wrong_share * len(edges)), round(density * len(mixed)))
    mixed = mixed[np.sort(rng.permutation(len(mixed))[:keep])]
    wrong = true_edges(seems, mixed, rng, ids)
    return World(ids, edges + wrong, truth, np.arange(len(edges) + len(wrong)) >= len(edges))


def ways_round(world: World) -> int:
    """Number of true edges that must go before nothing ties the two wings of `twin_wings` but look-alikes."""
    import networkx

    wing = len(world.ids) // 5
    first, second = len(world.ids) - 2 * wing, len(world.ids) - wing
    graph = networkx.Graph()
    for edge, wrong in zip(world.edges, world.wrong, strict=True):
        rows = int(edge.target[1:]), int(edge.source[1:])
        a, b = ("one" if first <= k < second else "two" if k >= second else k for k in rows)
        if not wrong and a != b:
            graph.add_edge(a, b, capacity=graph.edges[a, b]["capacity"] + 1 if graph.has_edge(a, b) else 1)
    return networkx.maximum_flow_value(graph, "one", "two") if {"one", "two"} <= graph.nodes else 0
