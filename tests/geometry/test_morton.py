import numpy as np

from gsmap.geometry.morton import morton_order


def test_a_grid_is_walked_cell_by_cell():
    grid = np.stack(np.meshgrid(*[range(4)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(float)
    walk = grid[morton_order(grid)]
    for size in (2, 4):  # every aligned block is left only when it has been walked whole
        blocks = (walk // size @ [16, 4, 1]).astype(int)
        assert (np.diff(blocks) != 0).sum() == len(np.unique(blocks)) - 1


def test_ties_keep_their_order_and_nothing_is_fine():
    np.testing.assert_array_equal(morton_order(np.zeros((5, 3))), range(5))
    assert len(morton_order(np.zeros((0, 3)))) == 0


def test_morton_order_is_the_bit_interleaving():
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)

    def interleave(p: list[int]) -> int:
        return sum(((v >> bit) & 1) << (3 * bit + 2 - axis) for axis, v in enumerate(p) for bit in range(2))

    expected = np.argsort([interleave(p) for p in grid.tolist()])
    np.testing.assert_array_equal(morton_order(grid.astype(np.float32)), expected)
