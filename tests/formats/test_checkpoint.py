import io
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch
from formats_cases import random_gaussians
from raising import raises

from gsmap import formats
from gsmap.errors import InputError
from gsmap.types import Gaussians


def tensors(g: Gaussians) -> dict[str, torch.Tensor]:
    found = {"means": g.means, "quats": g.quats, "scales": g.log_scales, "opacities": g.logit_opacities}
    found |= {"sh0": g.sh[:, :1], "shN": g.sh[:, 1:]}
    return {name: torch.tensor(values) for name, values in found.items()}


def gsplat(g: Gaussians) -> object:
    """As examples/simple_trainer.py saves it."""
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in tensors(g).items()})
    return {"step": 29999, "splats": splats.state_dict()}


def nerfstudio(g: Gaussians) -> object:
    """As nerfstudio's trainer saves a splatfacto."""
    own = tensors(g)
    params = {f"_model.gauss_params.{name}": own[name] for name in ("means", "quats", "scales")}
    params["_model.gauss_params.opacities"] = own["opacities"][:, None]
    params["_model.gauss_params.features_dc"] = own["sh0"][:, 0]
    params["_model.gauss_params.features_rest"] = own["shN"]
    params["_model.camera_optimizer.pose_adjustment"] = torch.zeros(4, 6)
    optimizers = {"means": {"state": {0: {"exp_avg": own["means"]}}, "param_groups": [{"lr": 1.6e-6}]}}
    return {"step": 29999, "pipeline": params, "optimizers": optimizers, "schedulers": {}, "scalers": {}}


def inria(g: Gaussians) -> object:
    """As train.py of gaussian-splatting saves capture() and the iteration."""
    own = {name: torch.nn.Parameter(value) for name, value in tensors(g).items()}
    order = ("means", "sh0", "shN", "scales", "quats")
    rest = (torch.zeros(len(g)), torch.zeros(len(g), 1), torch.zeros(len(g), 1), {"state": {}}, 2.0)
    return (g.sh_degree, *(own[name] for name in order), torch.nn.Parameter(own["opacities"][:, None]), *rest), 30000


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize(("make", "suffix"), [(gsplat, ".pt"), (nerfstudio, ".ckpt"), (inria, ".pth")])
def test_trainers(tmp_path, make, suffix, degree):
    g = random_gaussians(50, degree)
    torch.save(make(g), tmp_path / f"a{suffix}")
    back = formats.read(tmp_path / f"a{suffix}")
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_array_equal(getattr(back, name), getattr(g, name))
    assert bool(formats.info(tmp_path / f"a{suffix}").notes) == (suffix == ".ckpt")


def test_half_floats(tmp_path):
    g = random_gaussians(20, 1)
    torch.save({"splats": {name: value.half() for name, value in tensors(g).items()}}, tmp_path / "a.pt")
    np.testing.assert_allclose(formats.read(tmp_path / "a.pt").means, g.means, atol=4e-3)


class Evil:
    def __reduce__(self):
        return os.mkdir, ("owned",)


@pytest.mark.parametrize("legacy", [False, True])
def test_no_code_of_a_file_is_run(tmp_path, monkeypatch, legacy):
    monkeypatch.chdir(tmp_path)
    torch.save({**gsplat(random_gaussians(3, 0)), "x": Evil()}, "a.pt", _use_new_zipfile_serialization=not legacy)
    with raises(InputError, code="wrong_file_type" if legacy else "unsupported_pickle"):
        formats.read("a.pt")
    (tmp_path / "b.pt").write_bytes(pickle.dumps(Evil()))
    with raises(InputError, code="wrong_file_type"):
        formats.read("b.pt")
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda s: s.pop("means"), "not_gaussians"),
        (lambda s: s.clear(), "not_gaussians"),
        (lambda s: s.update(scales=torch.zeros(7, 3)), "count_mismatch"),
        (lambda s: s.update(quats=torch.zeros(20, 3)), "count_mismatch"),
        (lambda s: s.update(means=torch.zeros(20, 3, dtype=torch.int32)), "wrong_tensor_type"),
        (lambda s: s.update(means=torch.zeros(20, 3).to_sparse()), "wrong_tensor_type"),
        (lambda s: s.update(shN=torch.zeros(20, 4, 3)), "unsupported_sh_degree"),
        (lambda s: s.update({name: value[:0] for name, value in s.items()}), "no_gaussians"),
        (lambda s: s.update(other={"means": torch.zeros(20, 3)}), "unsupported_feature"),
        (
            lambda s: s.update({n: v[:1].expand(10**7, *v.shape[1:]) for n, v in s.items()}),
            "decompression_bomb",
        ),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, change, code):
    splats = tensors(random_gaussians(20, 1))
    change(splats)
    torch.save({"splats": splats}, tmp_path / "a.pt")
    with raises(InputError, code=code):
        formats.read(tmp_path / "a.pt")


def test_a_compressed_archive_is_refused_before_it_expands(tmp_path):
    torch.save(gsplat(random_gaussians(3, 0)), tmp_path / "a.pt")
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as old,
        zipfile.ZipFile(tmp_path / "b.pt", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for entry in old.infolist():
            new.writestr(entry.filename, old.read(entry))
    with raises(InputError, code="file_damaged"):
        formats.read(tmp_path / "b.pt")
    with zipfile.ZipFile(tmp_path / "c.pt", "w") as archive:
        archive.writestr("a/data.pkl", bytes(40 << 20))
    with raises(InputError, code="file_too_large"):
        formats.read(tmp_path / "c.pt")


def test_truncated_and_other_files(tmp_path):
    out = io.BytesIO()
    torch.save(gsplat(random_gaussians(30, 1)), out)
    data = out.getvalue()
    for size in [*range(0, 400, 57), *range(400, len(data), 997)]:
        (tmp_path / "a.pt").write_bytes(data[:size])
        with pytest.raises(InputError):
            formats.read(tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with raises(InputError, code="wrong_file_type"):
        formats.read(tmp_path / "a.pt")
