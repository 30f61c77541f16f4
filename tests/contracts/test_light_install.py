"""Without packages that only extras install, gsmap imports, and an error names the extra where one is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap
from gsmap.errors import MissingDependencyError
from gsmap.formats import scans
from gsmap.geometry.camera_models import camera_model
from gsmap.render.fit import make_fitter
from gsmap.render.fitter import LearningRates

ONE = gsmap.Gaussians(
    np.zeros((1, 3), np.float32),
    np.array([[1, 0, 0, 0]], np.float32),
    np.full((1, 3), -4, np.float32),
    np.zeros(1, np.float32),
    np.zeros((1, 1, 3), np.float32),
)


def test_torch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.pt", "w") as file:
        file.writestr("a/data.pkl", b"")
    for name in [name for name in sys.modules if name.startswith("gsmap.render.gsplat")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    for use in (
        lambda: gsmap.read(tmp_path / "a.pt"),
        lambda: gsmap.render.GaussianTensors,
        lambda: ONE.to_gsplat("cpu"),
        lambda: make_fitter(ONE, LearningRates(means=0.1), backend="gsplat"),
    ):
        with raises(MissingDependencyError, code="missing_dependency") as caught:
            use()
        assert "[torch]" in str(caught.value)


def test_open3d(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for name in ("a.obj", "a.stl", "a.glb", "a.pcd"):
        (tmp_path / name).write_bytes(b"")
        with raises(MissingDependencyError, code="missing_dependency") as caught:
            scans.read(tmp_path / name)
        assert "[mesh]" in str(caught.value)


def test_pycolmap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with raises(MissingDependencyError, code="missing_dependency"):
        camera_model("OPENCV", 100, 100, (1.0,) * 8)
