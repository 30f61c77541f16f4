"""Read and write OpenUSD's ``ParticleField3DGaussianSplat`` (26.03 and later) with usd-core: ``.usda .usdc .usdz``.

Positions, quaternions, linear scales, opacities and SH coefficients by splat, degree by degree, as a trained ``.ply``
has them. A file says which of its axes is up: what gsmap writes has y up, and is turned. Reading is left to a process
of its own, within limits (`gsmap.formats.scans.process`): the library is large, and files may be anybody's.

https://openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import InputError, MissingDependencyError, NotGaussiansError
from gsmap.formats.axes import PLY, change_axes
from gsmap.formats.quantise import check_size, require_writable
from gsmap.formats.scans.limits import Params
from gsmap.formats.scans.process import read_in_process
from gsmap.formats.tiles3d import box_of
from gsmap.geometry.transforms import transform_with_origin
from gsmap.types import Gaussians, Sim3

VERSION = 2
HOLDS_ORIGIN = True

_UP = {"Y": "RUB", "Z": "RFU"}
_MAX_FILE_BYTES = 8 << 30
_MIB = 1 << 20
_FREE_MIB, _RATIO = 1024, 24  # what the process that reads may take: so much, and so many times the file
_TIME_S, _MIB_A_SECOND = 60.0, 2.0
_TINY = np.finfo(np.float32).tiny


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read all splats of a stage, with their transforms applied.

    Raises:
        MissingDependencyError: usd-core is not installed.
        InputError: Not a stage, no splats, inconsistent arrays, a transform that is no similarity, or
            one that other files are to be read for.
    """
    path = Path(path)
    _require_usd(path)
    size = path.stat().st_size
    if not 0 < size <= _MAX_FILE_BYTES:
        raise InputError(
            f"{path} has {size:,} bytes; gsmap reads USD of 1 to {_MAX_FILE_BYTES:,}", code="file_too_large"
        )
    mib = size / _MIB
    limits = Params(max_memory_mb=int(_FREE_MIB + _RATIO * mib), max_seconds=_TIME_S + mib / _MIB_A_SECOND)
    stage = read_in_process(path, "usd", limits)
    if "refused" in stage:
        raise InputError(f"{path}: {stage['refused']}", code="unsupported_feature")
    up = str(stage["up"])
    if up not in _UP:
        raise InputError(f"{path}: its up axis is {up!r}; gsmap reads Y and Z", code="unsupported_axes")
    parts = [_splat(path, stage, i) for i in range(int(stage["count"]))]
    if not parts:
        raise NotGaussiansError(
            f"{path} holds no ParticleField3DGaussianSplat; it may have a mesh, or splats of an older schema"
        )
    return change_axes(Gaussians.concatenate(parts), PLY, _UP[up])


def write(path: str | os.PathLike[str], gaussians: Gaussians, *, half: bool = False) -> None:
    """Write a stage with one splat (y up, metres), whose bounds extend three standard deviations beyond the means.

    Args:
        half: Store all values except positions as half floats: 52 bytes per Gaussian at SH degree 1 instead of 92.

    Raises:
        MissingDependencyError: usd-core is not installed.
        InputError: No Gaussians, or values that are not finite.
    """
    path = Path(path)
    _require_usd(path)
    require_writable(path, gaussians)
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

    g = change_axes(gaussians, _UP["Y"], PLY)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splats")
    prim = splat.GetPrim()
    stage.SetDefaultPrim(prim)
    if g.origin.any():
        splat.AddTranslateOp().Set(Gf.Vec3d(*g.origin.tolist()))
    unit = g.quats / np.maximum(np.linalg.norm(g.quats, axis=1, keepdims=True), 1e-30)
    unit[~unit.any(1), 0] = 1
    number = np.float16 if half else np.float32
    kind = "h" if half else "f"
    arrays = {
        "positions": Vt.Vec3fArray.FromNumpy(_packed(g.means, np.float32)),
        "orientations": getattr(Vt, f"Quat{kind}Array").FromNumpy(_packed(unit[:, [1, 2, 3, 0]], number)),
        "scales": getattr(Vt, f"Vec3{kind}Array").FromNumpy(_packed(g.scales, number)),
        "opacities": (Vt.HalfArray if half else Vt.FloatArray).FromNumpy(_packed(g.opacities, number)),
        "radiance:sphericalHarmonicsCoefficients": getattr(Vt, f"Vec3{kind}Array").FromNumpy(
            _packed(g.sh.reshape(-1, 3), number)
        ),
        "extent": Vt.Vec3fArray.FromNumpy(_packed(box_of(g), np.float32)),
    }
    for name, values in arrays.items():
        narrow = half and name not in ("positions", "extent")
        prim.GetAttribute(f"{name}h" if narrow else name).Set(values)
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(g.sh_degree)
    if path.suffix.lower() != ".usdz":
        stage.GetRootLayer().Export(str(path), args={"format": path.suffix[1:].lower()})
        return
    inner = path.with_suffix(".usdc")
    try:
        stage.GetRootLayer().Export(str(inner))
        with Sdf.ZipFileWriter.CreateNew(str(path)) as archive:
            archive.AddFile(str(inner), "splats.usdc")
    finally:
        inner.unlink(missing_ok=True)


def _packed(values: np.ndarray, number: Any) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=number)


def _splat(path: Path, stage: dict[str, np.ndarray], i: int) -> Gaussians:
    """Read the Gaussians of one prim, in the frame of the stage."""

    def array(name: str) -> np.ndarray | None:
        return stage.get(f"{i}.{name}")

    means = array("positions")
    if means is None or not len(means):
        raise InputError(f"{path}: a ParticleField3DGaussianSplat has no positions", code="missing_attribute")
    n, degree = len(means), int(stage[f"{i}.degree"])
    if not 0 <= degree <= 3:
        raise InputError(f"{path}: SH degree {degree}; gsmap reads 0 to 3", code="unsupported_sh_degree")
    k = (degree + 1) ** 2

    def of_each(name: str, width: int, default: float | tuple[float, ...]) -> np.ndarray:
        """Return an attribute (n, width): cut a too long array, replace a too short array by the default."""
        found = array(name)
        if found is None or len(found) < n * (k if name == "sh" else 1):
            return np.broadcast_to(np.array(default, np.float32), (n, width))
        return found.astype(np.float32).reshape(-1, width)[:n]

    check_size(path, n * 4 * (11 + 3 * k), path.stat().st_size)
    quats = of_each("orientations", 4, (0, 0, 0, 1))[:, [3, 0, 1, 2]].copy()
    quats[~quats.any(1), 0] = 1
    scales = of_each("scales", 3, 1.0)
    opacity = np.clip(of_each("opacities", 1, 1.0)[:, 0].astype(np.float64), 1e-6, 1 - 1e-6)
    sh = of_each("sh", 3 * k, (0.0,) * (3 * k)).reshape(n, k, 3)
    with np.errstate(invalid="ignore", divide="ignore"):  # a negative scale becomes NaN, which validation names
        log_scales = np.log(np.where(scales == 0, _TINY, scales))
    found = Gaussians(means, quats, log_scales, np.log(opacity / (1 - opacity)), sh)
    matrix = stage[f"{i}.matrix"].astype(np.float64).T  # USD's vectors are rows
    return found if np.array_equal(matrix, np.eye(4)) else transform_with_origin(found, _similarity(path, matrix))


def _similarity(path: Path, matrix: np.ndarray) -> Sim3:
    linear = matrix[:3, :3]
    det = float(np.linalg.det(linear)) if np.isfinite(matrix).all() else 0.0
    scale = np.cbrt(det)
    if not det > 0 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > 1e-4:
        raise InputError(
            f"{path}: a splat's transform mirrors it or scales it unevenly, which gsmap does not read",
            code="unsupported_transform",
        )
    return Sim3(linear / scale, matrix[:3, 3], float(scale))


def _require_usd(path: Path) -> None:
    if importlib.util.find_spec("pxr") is None:
        raise MissingDependencyError(
            f"{path}: reading and writing USD needs usd-core, which is not installed", extra="usd"
        )
