"""Streams of Gaussians: what comes out of them is what all at once would give, and no more of it is in memory."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from stream_sources import Pieces, same, scattered

from gsmap.geometry.morton import morton_order
from gsmap.stream import blocks, bounds, load_all, sorted_along_morton_curve
from gsmap.types import Gaussians
from gsmap.types.source import gathered


@pytest.mark.parametrize("rows", [1, 7, 1000, 5000])
def test_what_is_read_in_pieces_is_the_whole(rows):
    g = scattered(1000)
    source = Pieces(g, rows)
    assert same(load_all(source), g)
    np.testing.assert_array_equal(bounds(source), [g.means.min(0), g.means.max(0)])
    wanted = np.array([0, 3, 4, 500, 999])
    np.testing.assert_array_equal(gathered(source, "sh", wanted), g.sh[wanted])
    for size in (64, 999, 1000, 1001):
        found = list(blocks(source, size))
        assert [len(block) for block in found] == [size] * (1000 // size) + [1000 % size] * (1000 % size > 0)
        assert same(Gaussians.concatenate(found), g)


def sorted_on_disk(g: Gaussians, tmp_path, rows: int, pieces: int = 97) -> Gaussians:
    row_bytes = 4 * (11 + 3 * g.sh.shape[1])
    source = Pieces(g, pieces)
    with sorted_along_morton_curve(
        source, bounds(source), tmp_path / "scratch", bucket_bytes=rows * row_bytes
    ) as ordered:
        assert (tmp_path / "scratch").exists()
        assert ordered.num_gaussians == len(g)
        assert ordered.sh_degree == g.sh_degree
        out = Gaussians.concatenate(list(ordered.chunks()))
        assert same(ordered.load(), out)
        np.testing.assert_array_equal(np.concatenate(list(ordered.columns("quats"))), out.quats)
    assert not (tmp_path / "scratch").exists()
    assert "load" not in source.reads
    return out


def far_stray(g: Gaussians) -> Gaussians:
    means = g.means.copy()
    means[17] = [1e4, -3e4, 2e4]  # all others now share the first bits of their codes
    return replace(g, means=means)


def in_one_place(g: Gaussians) -> Gaussians:
    means = g.means.copy()
    means[100:900] = means[5]
    return replace(g, means=means)


@pytest.mark.parametrize("change", [lambda g: g, far_stray, in_one_place])
@pytest.mark.parametrize("rows", [10, 150, 999])
def test_sorting_on_disk_is_sorting_in_memory(change, rows, tmp_path):
    g = change(scattered(1000))
    assert same(sorted_on_disk(g, tmp_path, rows), g[morton_order(g.means)])


def test_what_fits_is_sorted_in_memory(tmp_path):
    g = scattered(1000)
    with sorted_along_morton_curve(g, bounds(g), tmp_path / "scratch") as ordered:
        assert not (tmp_path / "scratch").exists()
        assert same(ordered.load(), g[morton_order(g.means)])


def test_scratch_goes_with_an_error(tmp_path):
    g = scattered(1000)
    with (
        pytest.raises(KeyboardInterrupt),
        sorted_along_morton_curve(Pieces(g, 100), bounds(g), tmp_path / "scratch", bucket_bytes=4000),
    ):
        raise KeyboardInterrupt
    assert not (tmp_path / "scratch").exists()


def test_sorting_on_disk_holds_a_bucket_in_memory(tmp_path):
    g = scattered(200_000, sh_degree=3)
    source = Pieces(g, 5000)
    tracemalloc.start()
    with sorted_along_morton_curve(source, bounds(source), tmp_path / "scratch", bucket_bytes=2 << 20) as ordered:
        for _ in ordered.chunks():
            pass
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < g.nbytes / 3
