"""A street with a gap, in a map: of edges that contradict each other the likelier is used, by what registration saw."""

import numpy as np
import pytest

import gsmap.map
from gsmap.register import recipe_key
from gsmap.types import Gaussians, Registration, Sim3

NEAR = {"colour_correlation": 0.93, "disagreement": 0.001, "free_space_violation": 0.001}
AFAR = {"colour_correlation": 0.85, "disagreement": 0.03, "free_space_violation": 0.002}
ALONG = {"colour_correlation": 0.48, "disagreement": 0.012, "free_space_violation": 0.012}
AT_M = {"a": 0.0, "b": 10.0, "d": 30.0, "e": 40.0}


def _capture(seed: int) -> Gaussians:
    rng, n = np.random.default_rng(seed), 60
    return Gaussians(
        rng.uniform(0, 20, (n, 3)), rng.normal(size=(n, 4)), np.full((n, 3), -3.0), np.zeros(n), np.zeros((n, 1, 3))
    )


@pytest.fixture
def site(tmp_path):
    with gsmap.map.create(tmp_path / "street.gsmap") as m:
        for seed, name in enumerate(AT_M):
            m.ingest(_capture(seed), name=name)
        yield m


def _register(m, a, b, along_m, evidence, overlap):
    first, second = (m.store.scenes.get(name).id for name in (a, b))
    if first > second:
        first, second, along_m = second, first, -along_m
    edge = Registration(
        first,
        second,
        "accepted",
        S_target_source=Sim3(np.eye(3), [along_m, 0, 0]),
        information=np.eye(7) * 1e6,
        overlap=overlap,
        proposer="graph:landmarks",
        evidence=evidence,
    )
    m.store.registrations.save(edge, recipe_key().of(first, second))


def _uses(m):
    graph = m.store.revisions.get()
    names = {scene.id: scene.name for scene in m.scenes()}
    return {"".join(sorted((names[a], names[b]))): outcome for (a, b), outcome in graph.outcomes.items()}


def test_a_front_laid_along_itself_loses_against_a_place_seen_from_afar(site):
    for a, b, evidence, overlap in (("a", "b", NEAR, 0.75), ("b", "d", AFAR, 0.4), ("d", "e", NEAR, 0.75)):
        _register(site, a, b, AT_M[b] - AT_M[a], evidence, overlap)
    _register(site, "a", "e", AT_M["e"] - AT_M["a"] - 33.0, ALONG, 0.9)
    site.optimize()
    found = _uses(site)
    assert {pair: outcome.use for pair, outcome in found.items()} == {
        "ab": "tentative", "bd": "tentative", "de": "tentative", "ae": "unused"
    }  # fmt: skip
    poses = site.store.revisions.get().poses
    first, last = (poses[site.store.scenes.get(name).id].S_map_scene for name in ("a", "e"))
    assert (first.inverse() @ last).translation == pytest.approx([40, 0, 0], abs=0.01)
