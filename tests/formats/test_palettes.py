import numpy as np

from gsmap.formats.palettes import codebook, palette


def test_a_codebook_is_as_good_as_sorting_and_cutting_evenly_or_better():
    values = np.random.default_rng(0).normal(size=20000) ** 3
    book, which = codebook(values)
    assert book.shape == (256,)
    assert (np.diff(book) >= 0).all()
    ours = ((book[which] - values) ** 2).mean()
    quantiles = np.quantile(values, (np.arange(256) + 0.5) / 256)
    even = np.linspace(values.min(), values.max(), 256)
    for other in (quantiles, even):
        nearest = other[np.abs(values[:, None] - other).argmin(1)]
        assert ours < 0.5 * ((nearest - values) ** 2).mean()


def test_each_value_has_the_nearest_of_the_book():
    values = np.random.default_rng(1).uniform(-3, 5, (500, 3)).astype(np.float32)
    book, which = codebook(values, 16)
    nearest = np.abs(values[..., None] - book).min(-1)
    np.testing.assert_allclose(np.abs(book[which] - values), nearest, atol=1e-6)


def test_one_value_alone():
    book, which = codebook(np.full((4, 3), -2.5, np.float32))
    np.testing.assert_array_equal(book[which], -2.5)


def test_a_palette_is_near_the_k_means_of_scipy():
    from scipy.cluster.vq import kmeans2

    rng = np.random.default_rng(0)
    vectors = (rng.normal(size=(6000, 9)) * np.linspace(2, 0.1, 9)).astype(np.float32)
    entries, which = palette(vectors, 1024, 8, np.ones(6000, np.float32))
    assert len(entries) <= 1024
    ours = ((entries[which] - vectors) ** 2).sum(1).mean()
    theirs, labels = kmeans2(vectors, 1024, iter=8, minit="points", seed=0)
    assert ours < 1.25 * ((theirs[labels] - vectors) ** 2).sum(1).mean()


def test_weights_pull_the_palette():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(4000, 9)).astype(np.float32)
    weights = np.where(np.arange(4000) < 400, 100, 1).astype(np.float32)
    errors = []
    for given in (weights, np.ones_like(weights)):
        entries, which = palette(vectors, 512, 6, given)
        errors.append(((entries[which] - vectors) ** 2)[:400].mean())
    assert errors[0] < 0.5 * errors[1]


def test_few_vectors_stand_for_themselves():
    vectors = np.arange(12, dtype=np.float32).reshape(4, 3)
    entries, which = palette(vectors, 8, 2, np.ones(4, np.float32))
    np.testing.assert_array_equal(entries[which], vectors)
