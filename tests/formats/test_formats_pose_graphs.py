from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap.errors import InputError
from gsmap.formats.g2o import write_graph
from gsmap.formats.tum import write_trajectory
from gsmap.types import Edge, Sim3
from tools.pose_graph_files import read_g2o, read_tum

NAMES = {f"k{k}": f"scene {k}" for k in range(4)}


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
    write_graph(tmp_path / "a.g2o", dict(zip(NAMES, poses, strict=True)), edges, NAMES)
    assert (tmp_path / "a.g2o").read_text().startswith("# scene 0\nVERTEX_SE3:QUAT 0 ")
    back = read_g2o(tmp_path / "a.g2o", confirmed=False)
    assert list(back.poses) == ["0", "1", "2", "3"]
    for want, got in zip(poses, back.poses.values(), strict=True):
        np.testing.assert_allclose(got.matrix(), want.matrix(), atol=1e-12)
    for want, got in zip(edges, back.edges, strict=True):
        assert (f"k{got.target}", f"k{got.source}") == (want.target, want.source)
        np.testing.assert_allclose(got.S_target_source.matrix(), want.S_target_source.matrix(), atol=1e-12)
        np.testing.assert_allclose(got.information, want.information, rtol=1e-12)


def test_gtsam_reads_the_same_graph(tmp_path, poses, edges):
    gtsam = pytest.importorskip("gtsam")
    write_graph(tmp_path / "a.g2o", {f"k{k}": pose for k, pose in enumerate(poses)}, edges, NAMES)
    graph, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(values.atPose3(k).matrix(), pose.matrix(), atol=1e-9)
    for k, edge in enumerate(edges):
        factor = graph.at(k)
        np.testing.assert_allclose(factor.measured().matrix(), edge.S_target_source.matrix(), atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().information(), edge.information[:6, :6], rtol=1e-6)


def test_g2o_refuses_what_it_cannot_say(tmp_path, poses, edges):
    scaled = Sim3(np.eye(3), np.zeros(3), 2.0)
    with raises(InputError, code="unsupported_output", match="scene a has scale 2"):
        write_graph(tmp_path / "a.g2o", {"a": scaled}, [], {"a": "hall"})
    with raises(InputError, code="unsupported_output", match="edge k0:k1 refers to a scene"):
        write_graph(tmp_path / "a.g2o", {"k0": poses[0]}, edges[:1], NAMES)
    both = {"k0": poses[0], "k1": poses[1]}
    with raises(InputError, code="unsupported_output", match="edge k0:k1 has scale 2"):
        write_graph(tmp_path / "a.g2o", both, [replace(edges[0], S_target_source=scaled)], NAMES)


def test_tum_survives_a_round_trip(tmp_path, poses):
    write_trajectory(tmp_path / "a.txt", poses, [1.5, 2.0, 3.25, 10.0], list(NAMES))
    back = read_tum(tmp_path / "a.txt")
    assert [t for t, _ in back] == [1.5, 2.0, 3.25, 10.0]
    for want, (_, got) in zip(poses, back, strict=True):
        np.testing.assert_allclose(got.matrix(), want.matrix(), atol=1e-12)
