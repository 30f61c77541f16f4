"""The process that reads one mesh or cloud by open3d, within limits that it sets itself.

It is run as a script, knows nothing of gsmap, and writes one ``.npz`` to the descriptor it is given: vertices,
triangles, colours, and of a textured mesh its pictures. What a file makes of the library ends here.
"""

from __future__ import annotations

import contextlib
import io
import os
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np


def main(out: int, path: str, kind: str, memory_bytes: int) -> None:
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    import open3d

    _limit(memory_bytes)
    if kind == "cloud":
        cloud = open3d.io.read_point_cloud(Path(path))
        arrays: dict[str, Any] = {"vertices": np.asarray(cloud.points), "colours": np.asarray(cloud.colors)}
    else:
        mesh = open3d.io.read_triangle_mesh(Path(path), True)
        arrays = {
            "vertices": np.asarray(mesh.vertices),
            "triangles": np.asarray(mesh.triangles),
            "colours": np.asarray(mesh.vertex_colors),
            "uvs": np.asarray(mesh.triangle_uvs),
            "materials": np.asarray(mesh.triangle_material_ids),
        }
        for number, picture in enumerate(mesh.textures):
            # A material without a picture has an empty one, which numpy cannot see.
            arrays[f"texture{number}"] = np.zeros((0, 0, 3), np.uint8) if picture.is_empty() else np.asarray(picture)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    with os.fdopen(out, "wb") as file:
        file.write(buffer.getbuffer())


def _limit(memory_bytes: int) -> None:
    """From now on: so many bytes beyond what the libraries have mapped, no file made longer, no core dumped."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    with contextlib.suppress(OSError, ValueError):  # not Linux, where nothing limits the memory of a process
        with open("/proc/self/statm") as file:
            mapped = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + memory_bytes, mapped + memory_bytes))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]))
