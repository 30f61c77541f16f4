"""Real sites with control points: splats trained on photographs, registered, and georeferenced, or refused.

    python -m tools.bench.sites --photos FOLDER --gcp gcp_list.txt --work FOLDER [--crs EPSG:N] [--parts 2]

PHOTOS is a folder of photographs, such as those of OpenDroneMap/odm_data_copr or tmizu23/cesium_oppaiyama. They are
scaled to 800 px and reconstructed by COLMAP (pycolmap). The photos of each model, the largest first, are dealt to
captures in turn, and each capture is trained from the triangulated points and put into a frame and unit of its own. The
truth of a pair from one model is known. Prints every registered pair beside the truth, and, for several standard
deviations of the control points, whether the map is tied and how far off control points held out as checks are.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

import gsmap.map
from gsmap import formats
from gsmap.evaluate.registration import pose_error
from gsmap.geometry.rotations import exp_so3, matrices_to_quats
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic.capture import Frames
from gsmap_synthetic.train import Params, train
from tools.harness import argument_parser, print_table, say

_SIDE_PX, _TRAINED_PX = 800, 400
_POINTS = 40_000  # further starting points, of interpolated depth
_FEWEST = 8  # photos of a model


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--gcp", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="keeps reconstructions and captures")
    parser.add_argument("--crs", help="if the file of control points names none")
    parser.add_argument("--parts", type=int, default=2, help="captures of a model of at least 30 photos")
    parser.add_argument("--sigmas", type=float, nargs="+", default=[0.01, 0.1, 0.3, 1.0], help="of control points, m")
    options = parser.parse_args()
    models = reconstructed(options.photos, options.work)
    truth: dict[str, tuple[int, Sim3]] = {}
    for k, model in enumerate(models):
        names = sorted(image.name for image in model.images.values())
        parts = options.parts if len(names) >= 30 else 1
        for part in range(parts):
            name = f"m{k}_{part}"
            S = own_frame(len(truth))
            truth[name] = k, S
            if not (options.work / "captures" / name).exists():
                make_capture(options.work, model, k, names[part::parts], name, S)
    path = options.work / "site.gsmap"
    shutil.rmtree(path, ignore_errors=True)
    with gsmap.map.open_or_create(str(path)) as m:
        m.update(options.work / "captures")
        pairs = registered(m, truth)
    print_table(("pair", "status", "rotation, deg", "off, % of the capture", "scale, %"), pairs)
    size = Image.open(sorted(options.photos.iterdir())[0]).size
    rows = [tied(path, options.gcp, options.crs, sigma, size) for sigma in options.sigmas]
    print_table(("sigma, m", "tied", "RMS, m", "RMS of checks, m", "used", "outliers", "problem or note"), rows)


def reconstructed(photos: Path, work: Path) -> list[pycolmap.Reconstruction]:
    """COLMAP's models of the photos, the largest first, with undistorted photos beside them."""
    images = work / "images"
    if not images.exists():
        images.mkdir(parents=True)
        for file in sorted(photos.iterdir()):
            if file.suffix.lower() in (".jpg", ".jpeg", ".png"):
                image = Image.open(file)
                exif = image.info.get("exif", b"")
                image = image.convert("RGB")
                image.thumbnail((_SIDE_PX, _SIDE_PX), Image.Resampling.LANCZOS)
                image.save(images / file.name, quality=92, exif=exif)
        database = work / "database.db"
        pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE)
        pycolmap.match_exhaustive(database)
        (work / "sparse").mkdir()
        pycolmap.incremental_mapping(database, images, work / "sparse")
    found = [pycolmap.Reconstruction(str(one)) for one in sorted((work / "sparse").iterdir())]
    found = [model for model in found if model.num_reg_images() >= _FEWEST]
    return sorted(found, key=lambda model: -model.num_reg_images())


def own_frame(seed: int) -> Sim3:
    """A random similarity."""
    rng = np.random.default_rng(seed)
    return Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 3, float(np.exp(rng.normal() * 0.3)))


def make_capture(work: Path, model: pycolmap.Reconstruction, k: int, names: list[str], name: str, S: Sim3) -> None:
    """Train a capture and write it in the frame that ``S`` leads to, with a COLMAP model of its photos."""
    flat = work / f"undistorted{k}"
    if not flat.exists():
        model.write(str(work))
        pycolmap.undistort_images(str(flat), str(work), str(work / "images"))
    plain = pycolmap.Reconstruction(str(flat / "sparse"))
    gaussians = trained(plain, flat / "images", names)
    folder = work / "captures" / name
    (folder / "sparse" / "0").mkdir(parents=True)
    formats.write(folder / f"{name}.ply", transform_gaussians(gaussians, S))
    with open(folder / "sparse" / "0" / "cameras.txt", "w") as file:
        for camera in model.cameras.values():
            numbers = " ".join(repr(float(value)) for value in camera.params)
            file.write(f"{camera.camera_id} {camera.model.name} {camera.width} {camera.height} {numbers}\n")
    with open(folder / "sparse" / "0" / "images.txt", "w") as file:
        for image in model.images.values():
            if image.name in names:
                T = pose_of(image)
                rotation = S.rotation @ T[:3, :3]
                quat = matrices_to_quats(rotation.T[None])[0]
                moved = -rotation.T @ S.apply(T[None, :3, 3])[0]
                numbers = " ".join(repr(float(value)) for value in (*quat, *moved))
                file.write(f"{image.image_id} {numbers} {image.camera_id} {image.name}\n\n")
    (folder / "sparse" / "0" / "points3D.txt").touch()


def pose_of(image: pycolmap.Image) -> np.ndarray:
    """(4, 4) camera to world."""
    T = np.eye(4)
    T[:3] = image.cam_from_world().matrix()
    return np.linalg.inv(T)


def trained(model: pycolmap.Reconstruction, photos: Path, names: list[str]) -> Gaussians:
    """Train Gaussians from triangulated points and from points at depths interpolated between these."""
    rng = np.random.default_rng(0)
    poses, intrinsics, pictures, points, colours = [], [], [], [], []
    for image in sorted((one for one in model.images.values() if one.name in names), key=lambda one: one.name):
        camera = model.cameras[image.camera_id]
        picture = Image.open(photos / image.name).convert("RGB")
        scale = _TRAINED_PX / max(picture.size)
        size = np.array([round(side * scale) for side in picture.size])
        pixels = np.asarray(picture.resize((int(size[0]), int(size[1])), Image.Resampling.LANCZOS))
        ratio = size / [camera.width, camera.height]
        focal, centre = camera.calibration_matrix()[[0, 1], [0, 1]] * ratio, camera.calibration_matrix()[:2, 2] * ratio
        T = pose_of(image)
        seen = [model.points3D[p.point3D_id] for p in image.points2D if p.has_point3D()]
        world = np.array([one.xyz for one in seen])
        local = (world - T[:3, 3]) @ T[:3, :3]
        world, local = world[local[:, 2] > 0], local[local[:, 2] > 0]
        at = local[:, :2] / local[:, 2:] * focal + centre
        drawn = rng.random((_POINTS // len(names), 2)) * size
        inverse = LinearNDInterpolator(at, 1 / local[:, 2])(drawn)
        drawn, inverse = drawn[inverse > 0], inverse[inverse > 0]
        rays = np.c_[(drawn - centre) / focal, np.ones(len(drawn))] / inverse[:, None]
        both = np.concatenate([at, drawn]).astype(int).clip(0, size - 1)
        points += [world, rays @ T[:3, :3].T + T[:3, 3]]
        colours.append(pixels[both[:, 1], both[:, 0]] / 255)
        poses.append(T)
        intrinsics.append([*focal, *centre])
        pictures.append(pixels)
    means = np.concatenate(points)
    reach = 0.375 * cKDTree(means).query(means, k=9)[0][:, -1]
    reach = np.clip(reach, 1e-9, 4 * np.median(reach))
    start = Gaussians(
        means,
        np.tile([1.0, 0, 0, 0], (len(means), 1)),
        np.log(reach)[:, None].repeat(3, 1),
        np.ones(len(means)),
        sh0_of_rgb(np.concatenate(colours))[:, None],
    )
    height, width = (min(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    cameras = Cameras(np.array(poses), np.array(intrinsics), np.tile([width, height], (len(poses), 1)))
    images = np.stack([picture[:height, :width] for picture in pictures])
    say(f"training on {len(poses)} photos")
    return train(start, Frames(images, cameras), Params(steps=900, splits=4))


def registered(m: gsmap.map.Map, truth: dict[str, tuple[int, Sim3]]) -> list[tuple[object, ...]]:
    """Every registered pair; beside the truth if both captures are of one model."""
    scenes, rows = {scene.id: scene for scene in m.scenes()}, []
    for stored in m.store.registrations.current():
        edge = stored.registration
        target, source = scenes[edge.target], scenes[edge.source]
        (k, S_target), (j, S_source) = truth[target.name], truth[source.name]
        row: tuple[object, ...] = (f"{target.name}:{source.name}", edge.status)
        if edge.S_target_source is None or k != j:
            rows.append((*row, "", "", ""))
            continue
        true = S_target @ S_source.inverse()
        error = pose_error(edge.S_target_source, true, source.bounds.mean(0))
        share = 100 * error.centroid_m / float(np.ptp(target.bounds, axis=0).max())
        scale = 100 * (edge.S_target_source.scale / true.scale - 1)
        rows.append((*row, f"{error.rre_deg:.3f}", f"{share:.3f}", f"{scale:.2f}"))
    return rows


def tied(path: Path, gcp: Path, crs: str | None, sigma: float, size: tuple[int, int]) -> tuple[object, ...]:
    """Georeference by control points; every fourth is a check point where they are named."""
    names = sorted({row[6] for row in (line.split() for line in gcp.read_text().splitlines()[1:]) if len(row) > 6})
    command = ["georeference", str(path), "--gcp", str(gcp), "--sigma", str(sigma), "--check", ",".join(names[3::4])]
    command += ["--photo-size", str(size[0]), str(size[1]), "--json", *(["--crs", crs] if crs else [])]
    done = subprocess.run([sys.executable, "-m", "gsmap", *command], capture_output=True, text=True, check=False)
    (found, *_) = json.loads(done.stdout)["components"]
    uses = Counter(row["use"] for row in found["residuals"] if row["kind"] == "point")
    said = "; ".join([*([found["problem"]] if found["problem"] else []), *found.get("notes", [])])
    tie = "no" if found["S_world_map"] is None else "yes"
    return (sigma, tie, found["rms_m"], found["rms_check_m"], uses["used"], uses["outlier"], said)


if __name__ == "__main__":
    main()
