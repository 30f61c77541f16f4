"""Register the smallest pair of synthetic captures with the installed gsmap; compare the edge with another machine's.

    python tools/check/pair.py FOLDER                      make captures unless they are there; write FOLDER/edge.json
    python tools/check/pair.py FOLDER --compare EDGE.json  exit with 1 unless it is the same edge, too

Same edge: the same status, a rotation within 0.05 degrees, a position within 5 mm, the same picture within 1 %. This
needs nothing but gsmap, and can be run by itself where there is no checkout.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import sys
from pathlib import Path

import numpy as np

import gsmap
from gsmap_synthetic import make_captures, write_captures

MAX_DEGREES, MAX_METRES, MAX_COLOUR = 0.05, 0.005, 0.01


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--compare", type=Path, metavar="EDGE.json", help="edge.json of another machine")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    if not (folder / "captures").is_dir():
        made = make_captures(0, 2, shut_doors=False, steps=0, num_frames=24, num_gaussians=15_000, size_px=(160, 120))
        write_captures(folder / "captures", made)
    edge = register(folder)
    (folder / "edge.json").write_text(json.dumps(edge, indent=1))
    print(json.dumps(edge))
    return differ(edge, json.loads(arguments.compare.read_text())) if arguments.compare else 0


def register(folder: Path) -> dict[str, object]:
    """Map the captures anew; return the edge of the pair and the mean colours of a picture of the first capture."""
    shutil.rmtree(folder / "pair.gsmap", ignore_errors=True)
    with gsmap.map.create(folder / "pair.gsmap") as m:
        m.ingest(*sorted((folder / "captures").glob("*.ply")))
        m.describe()
        m.register()
        (edge,) = m.edge_rows()
        gaussians, cameras = m.read(next(iter(m)).name)
        picture = gsmap.render.render(gaussians, cameras[0]).colour[0]
        return {
            "machine": platform.machine(),
            "gsmap": gsmap.__version__,
            "status": edge.status,
            "S_target_source": edge.S_target_source.matrix().tolist(),
            "colour": np.asarray(picture).reshape(-1, 3).mean(axis=0).tolist(),
        }


def differ(edge: dict[str, object], other: dict[str, object]) -> int:
    """Print how much two edges differ; return 1 if they are not the same one."""
    difference = np.linalg.inv(np.array(other["S_target_source"])) @ np.array(edge["S_target_source"])
    cosine = (np.trace(difference[:3, :3]) / np.cbrt(np.linalg.det(difference[:3, :3])) - 1) / 2
    degrees = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    metres = float(np.linalg.norm(difference[:3, 3]))
    colour = float(np.abs(np.array(edge["colour"]) - np.array(other["colour"])).max())
    print(f"{edge['machine']} and {other['machine']}: {degrees:.5f} deg, {1000 * metres:.3f} mm, colour {colour:.6f}")
    same = edge["status"] == other["status"]
    return 0 if same and degrees < MAX_DEGREES and metres < MAX_METRES and colour < MAX_COLOUR else 1


if __name__ == "__main__":
    sys.exit(main())
