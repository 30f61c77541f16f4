"""What gsmap writes, read by PlayCanvas' splat-transform: ``npm install --prefix ~/.cache/gsmap/validators
@playcanvas/splat-transform@3.7.0`` (its first versions read no streamed SOG)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from formats_cases import angles_rad, covariances, random_gaussians
from test_ksplat import ksplat, near
from test_lcc import lcc, some

from gsmap import formats
from gsmap.types import Gaussians

PACKAGE = Path(os.environ.get("NPM_VALIDATORS", Path.home() / ".cache" / "gsmap" / "validators"))
PACKAGE /= "node_modules/@playcanvas/splat-transform"

pytestmark = pytest.mark.slow


def splat_transform(source: Path, target: Path, *options: str) -> None:
    if not PACKAGE.is_dir() or shutil.which("node") is None:
        pytest.skip("needs node and splat-transform: see the top of this file")
    subprocess.run(
        ["node", PACKAGE / "bin" / "cli.mjs", "-q", "-w", "-g", "cpu", *options, source, target],
        check=True,
        timeout=300,
    )


def same(ours: Gaussians, theirs: Gaussians) -> None:
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(theirs.log_scales, ours.log_scales, atol=1e-5)
    assert angles_rad(ours, theirs).max() < 1e-4
    np.testing.assert_allclose(theirs.opacities, ours.opacities, atol=1e-3)  # it lets 0 and 255 be 1e-6 from the end
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-5)


@pytest.mark.parametrize("name", ["a.sog", "a/meta.json"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_sog(tmp_path, name, degree):
    formats.write(tmp_path / name, random_gaussians(3000, degree))
    splat_transform(tmp_path / name, tmp_path / "b.ply")
    same(formats.read(tmp_path / name), formats.read(tmp_path / "b.ply"))


def test_its_sog_folder_is_read(tmp_path):
    formats.write(tmp_path / "a.ply", random_gaussians(500, 1))
    (tmp_path / "b").mkdir()
    splat_transform(tmp_path / "a.ply", tmp_path / "b" / "meta.json")
    assert json.loads((tmp_path / "b" / "meta.json").read_text())["count"] == 500
    splat_transform(tmp_path / "b" / "meta.json", tmp_path / "b.ply")
    same(formats.read(tmp_path / "b" / "meta.json"), formats.read(tmp_path / "b.ply"))


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 2])
def test_ksplat(tmp_path, level, degree):
    (tmp_path / "a.ksplat").write_bytes(ksplat([near(300, degree), near(90, degree, 1)], level))
    splat_transform(tmp_path / "a.ksplat", tmp_path / "b.ply")
    ours, theirs = formats.read(tmp_path / "a.ksplat"), formats.read(tmp_path / "b.ply")
    same(ours, theirs)


@pytest.mark.parametrize("with_sh", [False, True])
def test_lcc(tmp_path, with_sh):
    """It turns positions, quaternions and SH by 90 degrees: covariances and colours are compared, in its order."""
    path = lcc(
        tmp_path / "s", [[some(200, 3 * with_sh, seed), some(20, 3 * with_sh)] for seed in range(2)], with_sh=with_sh
    )
    for file in path.parent.iterdir():
        file.rename(file.with_name(file.name.lower()))
    splat_transform(path, tmp_path / "b.ply", "-L", "0")
    ours, theirs = formats.read(path), formats.read(tmp_path / "b.ply")
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5)
    np.testing.assert_allclose(covariances(theirs), covariances(ours), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(theirs.sh, ours.sh, atol=1e-4)


def test_streamed_sog(tmp_path):
    g = random_gaussians(4000, 1)
    formats.write(tmp_path / "s" / "lod-meta.json", g, max_per_leaf=500)
    splat_transform(tmp_path / "s" / "lod-meta.json", tmp_path / "b.ply", "-L", "0")
    ours, theirs = formats.read(tmp_path / "s" / "lod-meta.json"), formats.read(tmp_path / "b.ply")
    ours, theirs = (one[np.lexsort(one.means.T)] for one in (ours, theirs))
    same(ours, theirs)
    counts = json.loads((tmp_path / "s" / "lod-meta.json").read_text())["counts"]
    for level, count in enumerate(counts):
        splat_transform(tmp_path / "s" / "lod-meta.json", tmp_path / f"{level}.ply", "-L", str(level))
        assert len(formats.read(tmp_path / f"{level}.ply")) == count


def test_its_streamed_sog_is_read(tmp_path):
    formats.write(tmp_path / "a.ply", random_gaussians(3000, 1))
    (tmp_path / "s").mkdir()
    splat_transform(tmp_path / "a.ply", tmp_path / "s" / "lod-meta.json", "-C", "1")
    back = formats.read(tmp_path / "s" / "lod-meta.json")
    assert len(back) == 3000
    np.testing.assert_allclose(
        back.means[np.lexsort(back.means.T)].mean(0), random_gaussians(3000, 1).means.mean(0), atol=1e-3
    )
