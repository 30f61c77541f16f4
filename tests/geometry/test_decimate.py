from dataclasses import replace

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.geometry.decimate import decimate
from gsmap.geometry.voxels import covariances, merge_groups, optical_depths, projected_areas, voxel_labels
from gsmap.render import render
from gsmap.types import Cameras, Gaussians


def wall(n: int, colour_of=lambda xy: np.full((len(xy), 3), 0.5), seed: int = 0) -> Gaussians:
    """Flat Gaussians on a square metre of the plane z = 0, of equal size."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 1, (n, 2))
    sh = ((colour_of(xy) - 0.5) / 0.28209479177387814)[:, None]
    flat = np.log([n**-0.5, n**-0.5, 1e-4])
    return Gaussians(np.c_[xy, np.zeros(n)], np.tile([1.0, 0, 0, 0], (n, 1)), np.tile(flat, (n, 1)), np.zeros(n), sh)


def moments(g: Gaussians) -> tuple[float, np.ndarray, np.ndarray]:
    mass = optical_depths(g) * projected_areas(g.scales)
    mean = np.average(g.means, axis=0, weights=mass)
    spread = g.means - mean
    return mass.sum(), mean, np.average(covariances(g) + spread[:, :, None] * spread[:, None], axis=0, weights=mass)


@pytest.mark.parametrize("count", [1, 37, 500, 999])
def test_as_many_are_left_as_are_asked_for_and_moments_stay(count):
    g = wall(1000)
    fewer, into = decimate(g, count)
    assert len(fewer) == count
    assert sorted(set(into.tolist())) == list(range(count))
    mean, spread = moments(g)[1:]
    np.testing.assert_allclose(moments(fewer)[1], mean, atol=0.02)
    np.testing.assert_allclose(moments(fewer)[2], spread, atol=0.01)


def uneven(n: int, seed: int = 0) -> Gaussians:
    """Gaussians of many shapes, sizes and colours, on surfaces and off them."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 1, (n, 3)) * [1, 0.7, 0.02] + [40, -30, 3]
    log_scales = rng.normal(np.log(n**-0.5), 0.6, (n, 3)) - [0, 0, 2]
    return Gaussians(means, rng.normal(size=(n, 4)), log_scales, rng.normal(0, 2, n), rng.normal(0, 0.5, (n, 4, 3)))


def test_no_gaussian_is_in_two_pairs_of_a_round():
    """The first tenth to go needs one round: nothing is made of more than two."""
    counts = np.bincount(decimate(uneven(1000), 900)[1])
    assert counts.max() == 2
    assert (counts == 2).sum() == 100


def lights(S: np.ndarray, opacities: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strengths, determinants of the blurred covariances, and areas of those that are not."""

    def area(S):
        minors = (np.trace(S, axis1=1, axis2=2) ** 2 - np.trace(S @ S, axis1=1, axis2=2)) / 2
        return np.pi * np.sqrt(minors / 3)

    blurred = S + blur**2 * np.eye(3)
    return opacities * area(S) / np.sqrt(area(blurred)), np.linalg.det(blurred), area(S)


def plainly_merged(g: Gaussians, count: int) -> np.ndarray:
    """Labels by the same rules in float64, every pair of points compared."""
    from gsmap.geometry import decimate as rules
    from gsmap.geometry.sh import rgb_of_sh0

    means, S, opacities = g.means.astype(np.float64), covariances(g), g.opacities.astype(np.float64)
    colours = np.c_[rgb_of_sh0(g.sh[:, 0]).astype(np.float64), np.full(len(g), rules._COVER)]
    masses = optical_depths(g) * projected_areas(g.scales)
    members = [[i] for i in range(len(g))]
    pairs = np.zeros((0, 2), int)
    while len(means) > count:
        if len(pairs) < 2 * len(means):
            apart = ((means[:, None] - means) ** 2).sum(2)
            np.fill_diagonal(apart, np.inf)
            near = np.argsort(apart, axis=1)[:, : rules._NEIGHBOURS]
            pairs = np.array(sorted({(min(i, j), max(i, j)) for i in range(len(means)) for j in near[i].tolist()}))
        i, j = pairs.T
        largest = np.sort(np.linalg.eigvalsh(S)[:, 2])
        blur = rules._BLUR * np.sqrt(largest[len(means) // 2])
        share = (masses[i] / (masses[i] + masses[j]))[:, None]
        d = means[i] - means[j]
        w = share[:, :, None]
        M = w * S[i] + (1 - w) * S[j] + w * (1 - w) * d[:, :, None] * d[:, None]
        total = masses[i] + masses[j]
        opacity = np.minimum(1 - np.exp(-total / lights(M, total, 0)[2]), 0.9999)
        shadows = projected_areas(np.sqrt(np.linalg.eigvalsh(M)))
        drawn = np.minimum(1 - np.exp(-total / shadows), 0.9999)
        variance = blur**2 * np.eye(3)
        light, det, _ = lights(S, opacities, blur)
        merged_light, merged_det, _ = lights(M, opacity, blur)

        def overlap(A, B, a, b, d, variance=variance):
            C = (A + B) / 2 + variance
            exponent = np.einsum("ni,nij,nj->n", d, np.linalg.inv(C), d) / 8
            return (a * b) ** 0.25 / np.sqrt(np.linalg.det(C)) * np.exp(-exponent)

        x, y, z = light[i], light[j], merged_light
        cx, cy = colours[i], colours[j]
        cz = share * cx + (1 - share) * cy
        costs = x * x * (cx * cx).sum(1) + y * y * (cy * cy).sum(1) + z * z * (cz * cz).sum(1)
        costs += 2 * x * y * overlap(S[i], S[j], det[i], det[j], d) * (cx * cy).sum(1)
        costs -= 2 * x * z * overlap(S[i], M, det[i], merged_det, (1 - share) * d) * (cx * cz).sum(1)
        costs -= 2 * y * z * overlap(S[j], M, det[j], merged_det, share * d) * (cy * cz).sum(1)
        chosen: list[int] = []
        left = np.argsort(costs, kind="stable").tolist()
        for _ in range(rules._PASSES):
            best: dict[int, int] = {}
            for p in left:
                for end in pairs[p].tolist():
                    best.setdefault(end, p)
            new = [p for p in left if best[i[p]] == p and best[j[p]] == p]
            taken = {end for p in new for end in pairs[p].tolist()}
            chosen += new
            left = [p for p in left if not taken & set(pairs[p].tolist())]
        chosen = sorted(chosen, key=lambda p: costs[p])[: len(means) - count]
        for p in chosen:
            a, b = pairs[p]
            means[a] = share[p] * means[a] + (1 - share[p]) * means[b]
            S[a], masses[a], opacities[a], colours[a] = M[p], total[p], drawn[p], cz[p]
            members[a] += members[b]
        kept = np.setdiff1d(np.arange(len(means)), pairs[chosen, 1])
        into = np.arange(len(means))
        into[pairs[chosen, 1]] = pairs[chosen, 0]
        pairs = np.unique(np.sort(np.searchsorted(kept, into[pairs]), axis=1), axis=0)
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        means, S, masses, opacities, colours = (v[kept] for v in (means, S, masses, opacities, colours))
        members = [members[k] for k in kept.tolist()]
    label = np.empty(len(g), int)
    for number, group in enumerate(sorted(members, key=min)):
        label[group] = number
    return label


def test_what_is_merged_is_what_a_plain_computation_merges(instruction_set):
    g = uneven(300)
    label = decimate(g, 75)[1]
    expected = plainly_merged(g, 75)
    assert (label == expected).mean() > 0.95  # costs are float32: what costs nearly the same may change places
    np.testing.assert_array_equal(decimate(g, 280)[1], plainly_merged(g, 280))


def test_what_lies_in_lumps_far_apart_becomes_one_in_the_end():
    """Lumps of more than have neighbours know nothing of each other before each of them is one."""
    lump = uneven(20)
    lumps = [replace(lump, means=lump.means + np.float32([100 * i, 0, 0])) for i in range(6)]
    g = Gaussians.concatenate(lumps)
    for count in (6, 2, 1):
        assert len(decimate(g, count)[0]) == count


def test_more_than_are_merged_together_are_cut_into_blocks_that_keep_their_share():
    g = uneven(70_000)
    fewer, into = decimate(g, 7001)
    assert len(fewer) == 7001
    np.testing.assert_array_equal(np.unique(into), np.arange(7001))
    middle = np.median(g.means, axis=0)
    for part in (g.means < middle).T:
        assert abs(len(np.unique(into[part])) / len(np.unique(into[~part])) - 1) < 0.2
    assert len(decimate(g, 1)[0]) == 1


def test_the_same_is_merged_by_any_machine_and_in_any_number_of_threads(instruction_set):
    from gsmap import _native

    g = uneven(5000, seed=3)
    g.means[:40] = g.means[40]  # more that coincide than have room in a leaf
    found = [decimate(g, 700)[1]]
    before = _native.num_threads()
    try:
        _native.set_num_threads(3)
        found.append(decimate(g, 700)[1])
        _native.use_instruction_set("baseline")
        found.append(decimate(g, 700)[1])
    finally:
        _native.set_num_threads(before)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_what_is_left_has_the_moments_of_what_it_stands_for():
    g = uneven(2000)
    fewer, into = decimate(g, 400)
    mass = optical_depths(g) * projected_areas(g.scales)
    for one in np.random.default_rng(0).choice(400, 40, replace=False).tolist():
        mine = np.flatnonzero(into == one)
        share = mass[mine] / mass[mine].sum()
        mean = share @ g.means[mine].astype(np.float64)
        spread = g.means[mine] - mean
        whole = np.einsum("n,nij->ij", share, covariances(g[mine]) + spread[:, :, None] * spread[:, None])
        np.testing.assert_allclose(fewer.means[one], mean, rtol=1e-6)
        np.testing.assert_allclose(covariances(fewer[one : one + 1])[0], whole, atol=2e-6 * np.trace(whole))
        np.testing.assert_allclose(fewer.sh[one], np.tensordot(share, g.sh[mine], 1), atol=1e-5)


def test_what_is_looked_at_more_keeps_more():
    g = wall(2000, lambda xy: np.stack([np.sin(9 * xy[:, 0]) / 4 + 0.5] * 3, axis=1))
    left = g.means[:, 0] < 0.5
    fewer, _ = decimate(g, 500, np.where(left, 9.0, 1.0))
    assert (fewer.means[:, 0] < 0.5).sum() > 1.25 * (fewer.means[:, 0] >= 0.5).sum()
    # Where nobody looked, and where all look alike, it is as without.
    plain, into = decimate(g, 500)
    assert abs((plain.means[:, 0] < 0.5).sum() - 250) < 50
    for pixels in (np.zeros(2000), np.full(2000, 3.0) * projected_areas(g.scales)):
        np.testing.assert_array_equal(decimate(g, 500, pixels)[1], into)


def test_few_enough_are_left_as_they_are():
    g = wall(50)
    same, into = decimate(g, 50)
    assert same is g
    np.testing.assert_array_equal(into, np.arange(50))
    with raises(ConfigError, code="out_of_range", match="at least 1, got 0"):
        decimate(g, 0)


def mixed(into: np.ndarray, part: np.ndarray) -> float:
    """Share of the groups that hold some of both parts."""
    share = np.bincount(into, part) / np.bincount(into)
    return float(((share > 0) & (share < 1)).mean())


def test_colours_meet_late():
    """Half the wall red, half of it blue: one stands for many of its colour, hardly any for both."""
    g = wall(2000, lambda xy: np.where(xy[:, :1] < 0.5, [[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]]))
    red = g.means[:, 0] < 0.5
    _, into = decimate(g, 100)
    assert mixed(into, red) < 0.05
    plain = replace(g, sh=np.zeros_like(g.sh))
    assert mixed(decimate(plain, 100)[1], red) > 0.08


def test_what_stands_apart_stays_apart():
    """Two parallel walls a hand's breadth from each other, which voxels of this size mix."""
    front = wall(800)
    back = replace(wall(800, seed=1), means=wall(800, seed=1).means + np.float32([0, 0, 0.1]))
    both, side = Gaussians.concatenate([front, back]), np.arange(1600) >= 800
    _, into = decimate(both, 60)
    by_voxel = voxel_labels(both.means, 0.19)
    assert by_voxel.max() + 1 <= 60
    assert mixed(into, side) < 0.2 < 0.9 < mixed(by_voxel, side)


def test_pictures_are_better_than_of_as_many_voxels():
    """A wall with a picture on it, of Gaussians of many sizes, from the front."""

    def colour(xy):
        return 0.5 + 0.4 * np.sin(np.c_[9 * xy[:, 0], 23 * xy[:, 1], 40 * xy.sum(1)])

    g = wall(5000, colour)
    sizes = np.random.default_rng(5).normal(0, 0.7, (5000, 1)).astype(np.float32)
    g = replace(g, log_scales=g.log_scales + sizes)
    by_voxel, _ = merge_groups(g, voxel_labels(g.means, 0.036))
    fewer, _ = decimate(g, len(by_voxel))
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 0.5, -1
    camera = Cameras(pose[None], np.array([[80.0, 80, 40, 40]]), np.array([[80, 80]]))
    whole, ours, theirs = (render(x, camera, depth=False, dominant_id=False).colour[0] for x in (g, fewer, by_voxel))
    assert ((ours - whole) ** 2).mean() < 0.5 * ((theirs - whole) ** 2).mean()


def test_the_kernel_refuses_what_does_not_fit_together():
    from gsmap._native import group_moments, merged_pairs, pair_costs

    three, six, one = np.zeros((4, 3)), np.ones((4, 6)), np.ones(4)
    with pytest.raises(ValueError, match="one length"):
        pair_costs(three, six, one[:3], one, three, np.zeros((1, 2), np.int32), 0.1, 0.1)
    for pair in ([0, 4], [-1, 0]):
        with pytest.raises(ValueError, match="not there"):
            pair_costs(three, six, one, one, three, np.array([pair], np.int32), 0.1, 0.1)
    g = wall(4)
    arrays = g.means, g.quats, g.log_scales, g.logit_opacities
    with pytest.raises(ValueError, match="one length"):
        merged_pairs(*arrays, g.means[:3], None, 2, 12, 6, 0.1, 0.1)
    with pytest.raises(ValueError, match="neighbours"):
        merged_pairs(*arrays, g.means, None, 2, 17, 6, 0.1, 0.1)
    with pytest.raises(ValueError, match="finite"):
        merged_pairs(np.full_like(g.means, np.nan), *arrays[1:], g.means, None, 2, 12, 6, 0.1, 0.1)
    for wrong, said in (
        ([0, 2, 2, 2], "without members"),
        ([0, 0, 0, -1], "negative"),
        ([0, 0, 9, 1], "without members"),
    ):
        with pytest.raises(ValueError, match=said):
            group_moments(*arrays, g.sh[:, 0], np.array(wrong, np.int64))


def test_the_cost_is_the_energy_of_the_difference():
    """Of two blurred round Gaussians in one place nothing is lost; of colours the part that they do not share."""
    from gsmap._native import pair_costs

    def cost(apart: float, colour: float) -> float:
        means = np.array([[0, 0, 0], [apart, 0, 0]])
        round_ = np.tile([1.0, 0, 0, 1, 0, 1], (2, 1))
        area = np.pi
        opacity = 1e-3  # thin: transmittances add
        mass = np.full(2, -np.log1p(-opacity) * area)
        colours = np.array([[1.0, 1, 1], [colour, colour, colour]])
        return float(
            pair_costs(means, round_, mass, np.full(2, opacity), colours, np.array([[0, 1]], np.int32), 0.0, 0.0)[0]
        )

    scale = 1e-6 * np.pi * 3
    assert cost(0, 1) < 1e-3 * scale
    assert cost(0, 0.5) == pytest.approx(0, abs=1e-3 * scale)  # where they lie on each other light adds
    assert cost(0.5, 1) < cost(1, 1) < cost(2, 1)
    # Far apart: both, and the one that is drawn in the middle and shares nothing with either.
    assert cost(60, 1) > 1.5 * scale
    assert cost(2, 0) > 0.1 * scale  # light is carried to where there was none
