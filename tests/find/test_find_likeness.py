"""What is alike, of size, shape and colour; whatever frame, and however much of it is seen."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.find import (
    SegmentDescriptor,
    SimilarityModel,
    best_per_owner,
    cosine_similarities,
    describe_samples,
    rank_by_similarity,
)
from gsmap.find.similarity import DIFFERENCES, _pair_distances, _percentiles, differences
from gsmap.geometry.rotations import exp_so3


def box(size: tuple[float, float, float], lab: tuple[float, float, float], seed: int = 0) -> SegmentDescriptor:
    """A box's faces, sampled; turned about the vertical and set down anywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (400, 3))
    axis = rng.integers(3, size=400)
    points[np.arange(400), axis] = np.sign(points[np.arange(400), axis]) * 0.5
    points = points * size + [0, 0, size[2] / 2]
    points = points @ exp_so3(np.array([0, 0, rng.uniform(0, 6)])).T + [*rng.uniform(-5, 5, 2), 0]
    return describe_samples(points, np.array(lab) + rng.normal(0, 3, (400, 3)), 0.0)


CHAIR, GREEN = (0.45, 0.45, 0.9), (50.0, -30.0, 25.0)


def test_turned_and_moved_it_is_the_same() -> None:
    bench = (1.6, 0.4, 0.9)
    near = differences(box(bench, GREEN, 1), [box(bench, GREEN, 2)])[0]
    assert near[DIFFERENCES.index("length")] < 0.08
    assert near[DIFFERENCES.index("width")] < 0.08
    for name, off in zip(DIFFERENCES, near, strict=True):
        assert off < 1.5, name


@pytest.mark.parametrize(
    ("other", "lab", "name"),
    [
        ((0.45, 0.45, 1.8), GREEN, "height"),
        ((1.8, 0.45, 0.9), GREEN, "length"),
        (CHAIR, (50.0, 40.0, 25.0), "hue"),
        (CHAIR, (50.0, 40.0, 25.0), "tints"),
        (CHAIR, (80.0, -30.0, 25.0), "lightness"),
    ],
)
def test_each_difference_is_told_and_counts(other: tuple[float, float, float], lab, name: str) -> None:
    query, same, unlike = box(CHAIR, GREEN, 1), box(CHAIR, GREEN, 2), box(other, lab, 3)
    rows = differences(query, [same, unlike])
    column = DIFFERENCES.index(name)
    assert rows[1, column] > 3 * rows[0, column]
    odds = SimilarityModel.load().log_odds(rows)
    assert odds[0] > odds[1]


def test_where_it_hangs_counts() -> None:
    rng = np.random.default_rng(0)
    points, lab = rng.uniform(0, 0.4, (200, 3)), np.full((200, 3), 50.0)
    low, high = describe_samples(points, lab, 0.0), describe_samples(points + np.array([0, 0, 1.5]), lab, 0.0)
    assert high.elevation_m == pytest.approx(1.5, abs=0.02)
    np.testing.assert_allclose(low.log_sizes, high.log_sizes, atol=1e-9)
    np.testing.assert_allclose(low.height_histogram, high.height_histogram, atol=1e-9)
    assert SimilarityModel.load().log_odds(differences(low, [low, high])).tolist() == sorted(
        SimilarityModel.load().log_odds(differences(low, [low, high])), reverse=True
    )


def test_the_model_only_falls() -> None:
    model = SimilarityModel.load()
    for knots, worth in zip(model.knots, model.worth, strict=True):
        assert knots[0] == worth[0] == 0
        assert (np.diff(knots) > 0).all()
        assert (np.diff(worth) <= 1e-9).all()
    assert model.base > 0
    assert model.log_odds(np.zeros((0, len(DIFFERENCES)))).shape == (0,)


def test_the_best_sighting_counts() -> None:
    query = box(CHAIR, GREEN, 1)
    part = box((0.45, 0.45, 0.3), (70.0, 0.0, 0.0), 2)
    scores, which = rank_by_similarity([query], [[part], [part, box(CHAIR, GREEN, 3)], []])
    assert which.tolist() == [0, 1, -1]
    assert scores[1] > scores[0]
    assert scores[2] == 0
    assert rank_by_similarity([], [[part]])[1].tolist() == [0]


def test_distances_are_of_all_pairs_or_of_an_even_share() -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    every = np.linalg.norm(points[:, None] - points, axis=2)[np.triu_indices(30, 1)]
    np.testing.assert_allclose(np.sort(_pair_distances(points)), np.sort(every))
    many = np.random.default_rng(1).normal(size=(500, 3))
    assert len(_pair_distances(many)) == 4000
    assert _pair_distances(many).mean() == pytest.approx(np.linalg.norm(many[:, None] - many, axis=2).mean(), rel=0.03)
    assert _pair_distances(points[:1]).tolist() == [0]


def test_percentiles_are_those_of_numpy() -> None:
    rng = np.random.default_rng(4)
    for count in (1, 2, 3, 40, 41):
        values = rng.normal(size=(count, 3))
        assert np.array_equal(_percentiles(values, 2, 50, 98), np.percentile(values, [2, 50, 98], axis=0))


def test_cosines_are_over_what_is_told() -> None:
    asked, told = np.array([1.0, 0, 9]), np.array([True, True, False])
    np.testing.assert_allclose(
        cosine_similarities(asked, told, np.array([[2.0, 0, 0], [0, 1, 5], [0, 0, 1]])), [1, 0, -1]
    )


def test_best_of_takes_the_first_of_equals() -> None:
    best, row = best_per_owner(np.array([1.0, 3, 3, 2]), np.array([0, 2, 2, 0]), 4)
    assert best.tolist() == [2, -np.inf, 3, -np.inf]
    assert row.tolist() == [3, -1, 1, -1]
