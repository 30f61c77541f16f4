"""Which backend renders, told without rendering."""

import subprocess
import sys

import numpy as np
import pytest
from golden_render import _scene
from raising import raises

from gsmap.errors import ConfigError
from gsmap.render import GaussianTensors, backend, backends, gsplat, render


@pytest.mark.parametrize(("there", "chosen"), [(True, "gsplat"), (False, "native")])
def test_auto_is_gsplat_where_it_can_be_used(monkeypatch, there, chosen):
    monkeypatch.setattr(backends, "gsplat_available", lambda: there)
    assert backend() == backend("auto") == chosen
    assert (backend("native"), backend("gsplat")) == ("native", "gsplat")
    with raises(ConfigError, code="invalid_choice", match="auto, native or gsplat, got 'cuda'"):
        backend("cuda")


@pytest.mark.parametrize("tensors", [False, True])
def test_what_is_told_is_what_renders(monkeypatch, tensors):
    gaussians, cameras = _scene()
    monkeypatch.setattr(backends, "gsplat_available", lambda: True)
    asked = []
    for name in ("render_numpy", "render_tensors"):
        monkeypatch.setattr(gsplat, name, lambda *_, name=name: asked.append(name))
    given = GaussianTensors.of(gaussians) if tensors else gaussians
    render(given, cameras)
    assert asked == ["render_tensors" if tensors else "render_numpy"]
    native = render(given, cameras, backend="native")
    assert np.isfinite(np.asarray(native.colour)).all()
    assert len(asked) == 1


def test_telling_the_backend_imports_no_torch_where_gsplat_or_a_driver_is_missing():
    code = (
        "import sys, importlib.util as u\n"
        "import gsmap.render\n"
        "from gsmap.render.backends import _has_driver\n"
        "print(gsmap.render.backend())\n"
        "sys.exit('torch' in sys.modules and not (u.find_spec('gsplat') and _has_driver()))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
