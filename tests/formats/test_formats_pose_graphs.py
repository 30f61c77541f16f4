from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap.errors import InputError, NotFoundError
from gsmap.formats.g2o import read_graph, write_graph
from gsmap.formats.tum import read_trajectory, write_trajectory
from gsmap.types import Edge, Sim3


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    turns = Rotation.random(4, random_state=0).as_matrix()
    return [Sim3(turns[k], rng.normal(0, 5, 3)) for k in range(4)]


@pytest.fixture
def edges(poses):
    rng = np.random.default_rng(1)
    out = []
    for a, b in ((0, 1), (1, 2), (3, 0)):
        root = rng.normal(0, 1, (6, 6)) + 4 * np.eye(6)
        information = np.diag([0.0] * 6 + [1e10])
        information[:6, :6] = root @ root.T
        out.append(Edge(f"k{a}", f"k{b}", poses[a].inverse() @ poses[b], information))
    return out


def test_g2o_survives_a_round_trip(tmp_path, poses, edges):
    names = [f"k{k}" for k in range(4)]
    numbers = write_graph(tmp_path / "a.g2o", dict(zip(names, poses, strict=True)), edges, fixed=["k0"])
    assert numbers == {"k0": 0, "k1": 1, "k2": 2, "k3": 3}
    back = read_graph(tmp_path / "a.g2o", confirmed=False)
    assert list(back.poses) == ["0", "1", "2", "3"]
    assert back.fixed == ("0",)
    for want, got in zip(poses, back.poses.values(), strict=True):
        np.testing.assert_allclose(got.matrix(), want.matrix(), atol=1e-12)
    for want, got in zip(edges, back.edges, strict=True):
        assert (f"k{got.target}", f"k{got.source}") == (want.target, want.source)
        np.testing.assert_allclose(got.S_target_source.matrix(), want.S_target_source.matrix(), atol=1e-12)
        np.testing.assert_allclose(got.information, want.information, rtol=1e-12)


def test_gtsam_reads_the_same_graph(tmp_path, poses, edges):
    gtsam = pytest.importorskip("gtsam")
    write_graph(tmp_path / "a.g2o", {f"k{k}": pose for k, pose in enumerate(poses)}, edges)
    graph, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(values.atPose3(k).matrix(), pose.matrix(), atol=1e-9)
    for k, edge in enumerate(edges):
        factor = graph.at(k)
        np.testing.assert_allclose(factor.measured().matrix(), edge.S_target_source.matrix(), atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().information(), edge.information[:6, :6], rtol=1e-6)


def test_whole_number_ids_are_kept(tmp_path, poses):
    assert write_graph(tmp_path / "a.g2o", {"7": poses[0], "3": poses[1]}, []) == {"7": 7, "3": 3}
    assert list(read_graph(tmp_path / "a.g2o").poses) == ["7", "3"]


def test_g2o_refuses_what_it_cannot_say(tmp_path, poses, edges):
    scaled = Sim3(np.eye(3), np.zeros(3), 2.0)
    with raises(InputError, code="unsupported_output", match="scene a has scale 2"):
        write_graph(tmp_path / "a.g2o", {"a": scaled}, [])
    with raises(InputError, code="unsupported_output", match="edge k0:k1 refers to a scene"):
        write_graph(tmp_path / "a.g2o", {"k0": poses[0]}, edges[:1])
    both = {"k0": poses[0], "k1": poses[1]}
    with raises(InputError, code="unsupported_output", match="edge k0:k1 has scale 2"):
        write_graph(tmp_path / "a.g2o", both, [replace(edges[0], S_target_source=scaled)])


@pytest.mark.parametrize(
    ("text", "code", "match"),
    [
        ("VERTEX_SE2 0 1 2 3", "invalid_line", "line 1: VERTEX_SE2"),
        ("VERTEX_SE3:QUAT 0 1 2 3", "invalid_line", "line 1: .* 8 values, has 4"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0", "not_a_rotation", "line 1: the quaternion"),
        ("VERTEX_SE3:QUAT 0 nan 0 0 0 0 0 1", "not_finite", "line 1 holds NaN"),
        ("VERTEX_SE3:QUAT 0 x 0 0 0 0 0 1", "invalid_line", "line 1: .*'x'"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "duplicate", "line 2: vertex 0"),
    ],
)
def test_a_bad_g2o_line_is_named(tmp_path, text, code, match):
    (tmp_path / "bad.g2o").write_text(text)
    with raises(InputError, code=code, match=match):
        read_graph(tmp_path / "bad.g2o")


def test_missing_files(tmp_path):
    for reader in (read_graph, read_trajectory):
        with pytest.raises(NotFoundError):
            reader(tmp_path / "none")


def test_tum_survives_a_round_trip(tmp_path, poses):
    write_trajectory(tmp_path / "a.txt", poses, [1.5, 2.0, 3.25, 10.0])
    back = read_trajectory(tmp_path / "a.txt")
    assert [t for t, _ in back] == [1.5, 2.0, 3.25, 10.0]
    for want, (_, got) in zip(poses, back, strict=True):
        np.testing.assert_allclose(got.matrix(), want.matrix(), atol=1e-12)


@pytest.mark.parametrize("line", ["1 2 3", "0 0 0 0 0 0 0 0", "0 0 0 nan 0 0 0 1", "a b c d e f g h"])
def test_a_bad_tum_line_is_named(tmp_path, line):
    (tmp_path / "bad.txt").write_text(f"# time\n\n{line}\n")
    with raises(InputError, code=("invalid_line", "not_a_rotation"), match="line 3"):
        read_trajectory(tmp_path / "bad.txt")
