import numpy as np
from test_ingest import box

from gsmap.ingest import synthesise_cameras, validate
from gsmap.ingest.validate import sees
from gsmap.types import Gaussians


def table(n: int = 6000) -> Gaussians:
    """An object: a top of 2 x 1 and four legs of 0.8."""
    rng = np.random.default_rng(3)
    top = rng.uniform([-1, -0.5, 0.78], [1, 0.5, 0.82], size=(n // 2, 3))
    legs = rng.uniform([-0.03, -0.03, 0], [0.03, 0.03, 0.8], size=(n // 2, 3))
    legs[:, :2] += rng.choice([-1, 1], size=(n // 2, 2)) * [0.95, 0.45]
    p = np.concatenate([top, legs])
    return Gaussians(p, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -4.0), np.full(n, 2.0), np.zeros((n, 1, 3)))


def seen_share(cameras, points) -> float:
    """Share of points inside some image, nothing hidden."""
    view = cameras.T_camera_frame
    local = np.einsum("cij,nj->cni", view[:, :3, :3], points) + view[:, None, :3, 3]
    u = local[..., :2] / local[..., 2:] * cameras.intrinsics_px[:, None, :2] + cameras.intrinsics_px[:, None, 2:]
    return (((u >= 0) & (u < cameras.sizes_px[:, None])).all(2) & (local[..., 2] > 0)).any(0).mean()


def test_inside_a_room():
    room = box(8000)
    cameras = synthesise_cameras(room)
    assert cameras.synthesised
    assert 12 <= len(cameras) <= 96
    half = np.array([2, 3, 1.5])
    assert (np.abs(cameras.centers) < half).all()
    assert (half - np.abs(cameras.centers) > 0.1).all()  # not in a wall
    assert seen_share(cameras, room.means) > 0.98
    assert sees(cameras, room.means).all()
    assert validate(room, cameras) == ()


def test_two_rooms_get_cameras_in_both():
    left, right = box(6000), box(6000, seed=1)
    moved = right.means + np.array([4.2, 0, 0], np.float32)
    right = Gaussians(moved, right.quats, right.log_scales, right.logit_opacities, right.sh)
    cameras = synthesise_cameras(Gaussians.concatenate([left, right]))
    assert (cameras.centers[:, 0] < 2).any()
    assert (cameras.centers[:, 0] > 2.2).any()


def test_a_room_without_a_ceiling_and_with_floaters():
    room = box(8000)
    room = room[room.means[:, 2] < 1.45]
    rng = np.random.default_rng(1)
    far = Gaussians(
        rng.normal(size=(40, 3)) * 50, rng.normal(size=(40, 4)), np.ones((40, 3)), np.ones(40), np.zeros((40, 1, 3))
    )
    cameras = synthesise_cameras(Gaussians.concatenate([room, far]))
    assert (np.abs(cameras.centers) < [2, 3, 1.5]).all(1).mean() > 0.9


def test_around_an_object():
    cameras = synthesise_cameras(table())
    assert seen_share(cameras, table().means) > 0.99
    legs = table().means[3000:]
    assert all(np.linalg.norm(legs - center, axis=1).min() > 0.05 for center in cameras.centers)


def test_hard_cases():
    one = table()[:1]
    assert len(synthesise_cameras(one)) > 0
    glass = Gaussians(one.means, one.quats, one.log_scales, np.full(1, -9.0), one.sh)
    assert len(synthesise_cameras(glass)) > 0


def test_same_input_same_cameras():
    np.testing.assert_array_equal(synthesise_cameras(box()).T_frame_camera, synthesise_cameras(box()).T_frame_camera)


def test_real_rooms(shared_data):
    """Near where a person had really stood."""
    from scipy.spatial import cKDTree

    from gsmap import formats

    for name in ("c0", "c2"):
        g = formats.read(shared_data / "house" / f"{name}.ply")
        real = formats.read_cameras(shared_data / "house" / f"{name}.cameras.json")
        made = synthesise_cameras(g)
        distance, _ = cKDTree(real.centers).query(made.centers)
        assert np.median(distance) < 1.5
        assert sees(made, g.means).all()
