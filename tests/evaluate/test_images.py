import numpy as np
import pytest
from raising import raises

from gsmap.errors import InputError, MissingDependencyError, NotFoundError
from gsmap.evaluate.images import Lpips, psnr, ssim


def test_psnr_of_a_known_error():
    a = np.full((12, 16, 3), 0.5)
    assert psnr(a + 0.1, a) == pytest.approx(20.0)
    assert psnr(a, a) == float("inf")
    # Values beyond the range are what a screen shows of them.
    assert psnr(a + 5, np.ones_like(a)) == float("inf")


def test_ssim_against_its_definition():
    rng = np.random.default_rng(0)
    a, b = rng.random((13, 14, 3)), rng.random((13, 14, 3))
    taps = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2
    values = []
    for i in range(3):
        for j in range(4):
            for c in range(3):
                x, y = a[i : i + 11, j : j + 11, c], b[i : i + 11, j : j + 11, c]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                values.append((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert ssim(a, b) == pytest.approx(np.mean(values), abs=1e-9)
    assert ssim(a, a) == pytest.approx(1.0)


def test_lpips_runs_a_network_of_the_right_signature(tmp_path):
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    ports = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 3, "h", "w"]) for n in ("in0", "in1")]
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, None)
    nodes = [
        helper.make_node("Sub", ["in0", "in1"], ["d"]),
        helper.make_node("Abs", ["d"], ["e"]),
        helper.make_node("ReduceMean", ["e"], ["out"]),
    ]
    graph = helper.make_graph(nodes, "mean_difference", ports, [out])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, tmp_path / "net.onnx")
    a = np.full((8, 8, 3), 0.5)
    # Images span [-1, 1] on the network's side.
    assert Lpips(tmp_path / "net.onnx")(a, a + 0.1) == pytest.approx(0.2, abs=1e-6)


def test_what_cannot_be_compared_is_refused(tmp_path):
    with raises(InputError, code="shape_mismatch", match=r"\(H, W, 3\)"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with raises(InputError, code="picture_too_small"):
        ssim(np.zeros((4, 40, 3)), np.zeros((4, 40, 3)))
    with raises(MissingDependencyError, code="missing_dependency"):
        Lpips(None)
    with pytest.raises(NotFoundError):
        Lpips(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with raises(InputError, code="not_a_model"):
        Lpips(tmp_path / "bad.onnx")
