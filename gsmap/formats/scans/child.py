"""A process that reads one mesh, cloud, LAS or USD file with a library, within limits that it sets for itself.

It is run as a script and writes one ``.npz`` to the descriptor it is given. What a file makes
of the library ends here: crashes, aborts for want of memory, and loops.
"""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

_CHUNK = 1 << 20  # points


def main(out: int, path: str, kind: str, memory_bytes: int, max_points: int) -> None:
    from gsmap import platform

    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    if kind == "las":
        import laspy  # noqa: F401
        import lazrs  # noqa: F401
    elif kind == "usd":
        from pxr import Usd, UsdGeom, UsdVol  # noqa: F401
    else:
        import open3d  # noqa: F401
    platform.limit_process(memory_bytes)
    read = {"cloud": _cloud, "mesh": _mesh, "las": _las, "usd": _usd}[kind]
    buffer = io.BytesIO()
    np.savez(buffer, **read(Path(path), max_points))
    with os.fdopen(out, "wb") as file:
        file.write(buffer.getbuffer())


def _cloud(path: Path, max_points: int) -> dict[str, Any]:
    import open3d

    cloud = open3d.io.read_point_cloud(path)
    return {"vertices": np.asarray(cloud.points), "colours": np.asarray(cloud.colors)}


def _mesh(path: Path, max_points: int) -> dict[str, Any]:
    import open3d

    mesh = open3d.io.read_triangle_mesh(path, True)
    arrays: dict[str, Any] = {
        "vertices": np.asarray(mesh.vertices),
        "triangles": np.asarray(mesh.triangles),
        "colours": np.asarray(mesh.vertex_colors),
        "uvs": np.asarray(mesh.triangle_uvs),
        "materials": np.asarray(mesh.triangle_material_ids),
    }
    for number, picture in enumerate(mesh.textures):
        # A material without a picture has an empty one, which numpy cannot see.
        arrays[f"texture{number}"] = np.zeros((0, 0, 3), np.uint8) if picture.is_empty() else np.asarray(picture)
    return arrays


def _las(path: Path, max_points: int) -> dict[str, Any]:
    """Read evenly spaced points as integers, with their scales and offsets, and with colours if the file has any."""
    import laspy

    with laspy.open(path) as reader:
        header = reader.header
        total = int(header.point_count)
        step = max(1, -(-total // max_points))
        names = set(header.point_format.dimension_names)
        columns: dict[str, list[Any]] = {"counts": []}
        if {"red", "green", "blue"} <= names:
            columns["colours"] = []
        seen = 0
        for chunk in reader.chunk_iterator(_CHUNK):
            rows = slice(-seen % step, None, step)
            columns["counts"].append(np.stack([np.asarray(chunk[axis])[rows] for axis in "XYZ"], axis=1))
            if "colours" in columns:
                columns["colours"].append(
                    np.stack([np.asarray(chunk[name])[rows] for name in ("red", "green", "blue")], axis=1)
                )
            seen += len(chunk)
        arrays = {name: np.concatenate(parts) for name, parts in columns.items() if parts}
        scales, offsets = np.array(header.scales, float), np.array(header.offsets, float)
        return arrays | {"total": np.array([total, seen]), "scales": scales, "offsets": offsets}


def _usd(path: Path, max_points: int) -> dict[str, Any]:
    """Read the arrays and the matrix of each splat, by number, and the stage's up axis; or the reason for refusal."""
    from pxr import Sdf, Usd, UsdGeom, UsdVol

    layer = Sdf.Layer.FindOrOpen(str(path))
    packed = path.suffix.lower() == ".usdz"
    if layer is None:
        return {"refused": np.array("USD cannot read it: it is damaged, or not a USD file")}
    named = [name for name in layer.GetCompositionAssetDependencies() if name]
    if any(not packed or name.startswith("/") or ".." in name or ":" in name for name in named):
        return {"refused": np.array(f"it wants {named[0][:100]!r} read as well, which gsmap does not do: flatten it")}
    stage = Usd.Stage.Open(layer)
    if any(used.realPath and Path(used.realPath) != path for used in stage.GetUsedLayers()):
        return {"refused": np.array("it wants other files read as well, which gsmap does not do: flatten it")}
    names = {"positions": "positions", "orientations": "orientations", "scales": "scales", "opacities": "opacities"}
    names["radiance:sphericalHarmonicsCoefficients"] = "sh"
    arrays: dict[str, Any] = {"up": np.array(str(UsdGeom.GetStageUpAxis(stage)))}
    when = Usd.TimeCode.EarliestTime()
    count = 0
    for prim in stage.Traverse():
        if not prim.IsA(UsdVol.ParticleField3DGaussianSplat):
            continue
        for theirs, ours in names.items():
            for name in (theirs, f"{theirs}h"):  # float before half, as the schema says
                values = prim.GetAttribute(name).Get(when)
                if values is not None and len(values):
                    arrays[f"{count}.{ours}"] = np.asarray(values)
                    break
        arrays[f"{count}.degree"] = np.array(prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(when) or 0)
        arrays[f"{count}.matrix"] = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(when))
        count += 1
    return arrays | {"count": np.array(count)}


if __name__ == "__main__":
    sys.path.append(str(Path(__file__).parents[3]))  # where gsmap lies
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))
