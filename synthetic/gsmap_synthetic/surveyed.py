"""A made site with surveyed marks: many small captures of open ground, edges that drift, control points in photos.

Nothing is trained: a capture is a patch of ground as flat Gaussians and a ring of cameras above it, which is what
georeferencing needs of one. Truth is exact in the world frame, and goes through PROJ into any CRS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.formats.gcp_list import GcpLine
from gsmap.geometry.projection import project
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import exp
from gsmap.types import Cameras, Edge, Gaussians, Sim3
from gsmap.types.world import WorldFrame

MUNICH = WorldFrame("EPSG:25832", 48.137, 11.575, 520.0)
_SIZE, _FOCAL = (1600, 1200), 1200.0


@dataclass(frozen=True)
class SiteParams:
    """What a site is like.

    Args:
        rows, columns: captures stand in a block of so many.
        spacing_m: between neighbours.
        cross_every: rows are walked one after the other, and tied to the row before at every so many columns.
        unit_m: metres in a unit of all captures.
        edge_rotation_rad, edge_translation_m: standard deviations of what registers neighbours.
        pixel_px: of where marks are picked. survey_m: of the survey of marks.
        num_control, num_check: marks. num_views: photos that show each; 1 leaves their depth to the surface.
    """

    rows: int = 10
    columns: int = 10
    spacing_m: float = 8.0
    cross_every: int = 3
    unit_m: float = 0.5
    edge_rotation_rad: float = 2e-4
    edge_translation_m: float = 1e-3
    pixel_px: float = 0.5
    survey_m: float = 0.01
    num_control: int = 5
    num_check: int = 20
    num_views: int = 3


@dataclass(frozen=True, eq=False)
class Mark:
    """A surveyed mark.

    Args:
        name: ``G`` and a number, or ``C`` of a check point.
        true_m: (3,) in the world frame. surveyed: (3,) in the CRS, with the error of the survey.
        scene: the capture whose photos show it.
        pixels: by photo, column and row, with the error of the picking.
    """

    name: str
    true_m: np.ndarray
    surveyed: np.ndarray
    scene: str
    pixels: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Site:
    """A made site.

    Args:
        frame: the world frame of the truth.
        names: of the captures. truth: ``S_world_scene`` of each. cameras: of each, scene frame.
        edges: between neighbours, by names.
        marks: control points, then check points.
    """

    frame: WorldFrame
    names: tuple[str, ...]
    truth: tuple[Sim3, ...]
    cameras: tuple[Cameras, ...]
    edges: tuple[Edge, ...]
    marks: tuple[Mark, ...]

    def gcp_lines(self) -> list[GcpLine]:
        """As a ``gcp_list.txt`` has them."""
        return [
            GcpLine(0, mark.name, tuple(mark.surveyed.tolist()), pixel, photo)
            for mark in self.marks
            for photo, pixel in mark.pixels.items()
        ]

    def checks(self) -> list[str]:
        """Names of the check points."""
        return [mark.name for mark in self.marks if mark.name.startswith("C")]

    def with_blunder(self, name: str, off: Sequence[float]) -> Site:
        """The same site with one mark surveyed wrongly, by so much in the CRS."""
        marks = tuple(
            replace(mark, surveyed=mark.surveyed + np.asarray(off)) if mark.name == name else mark
            for mark in self.marks
        )
        return replace(self, marks=marks)


def surveyed_site(seed: int = 0, params: SiteParams | None = None, frame: WorldFrame = MUNICH) -> Site:
    """A site; the same for the same seed."""
    p, rng = params or SiteParams(), np.random.default_rng(seed)
    count = p.rows * p.columns
    names = tuple(f"site-{k:03d}" for k in range(count))
    truth = tuple(_truth(k, p, rng) for k in range(count))
    cameras = tuple(_cameras(name, S, p) for name, S in zip(names, truth, strict=True))
    edges = []
    sigmas = np.array([p.edge_rotation_rad] * 3 + [p.edge_translation_m / p.unit_m] * 3 + [1e-3])
    for a, b in _neighbours(p):
        step = rng.normal(size=(1, 7)) * sigmas
        step[0, 6] = 0
        relative = truth[a].inverse() @ truth[b]
        measured = Sim3(relative.rotation, relative.translation) @ exp(step).item(0)
        edges.append(Edge(names[a], names[b], measured, np.diag(sigmas**-2.0)))
    return Site(frame, names, truth, cameras, tuple(edges), tuple(_marks(names, truth, cameras, p, rng, frame)))


def ground(unit_m: float, seed: int = 0, half_m: float = 5.0) -> Gaussians:
    """A patch of flat ground around the origin of a capture whose z is up, in its unit."""
    across = np.arange(-half_m, half_m + 0.1, 0.25) / unit_m
    x, y = (grid.ravel() for grid in np.meshgrid(across, across))
    rng = np.random.default_rng(seed)
    n = len(x)
    scales = np.log(np.array([0.2, 0.2, 0.002]) / unit_m)
    return Gaussians(
        np.stack([x, y, np.zeros(n)], axis=1),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.tile(scales, (n, 1)),
        np.full(n, 6.0),
        rng.normal(scale=0.5, size=(n, 1, 3)),
    )


def _truth(k: int, p: SiteParams, rng: np.random.Generator) -> Sim3:
    """Upright captures turned at random about the vertical, on gently rolling ground."""
    row, column = divmod(k, p.columns)
    if row % 2:
        column = p.columns - 1 - column
    east, north = (column - p.columns / 2) * p.spacing_m, (row - p.rows / 2) * p.spacing_m
    up = 0.6 * np.sin(east / 15) + 0.8 * np.cos(north / 12)
    turn = exp_so3(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))
    return Sim3(turn, np.array([east, north, up]), p.unit_m)


def _neighbours(p: SiteParams) -> list[tuple[int, int]]:
    """Beside each other in a row, and here and there in a column."""
    count = p.rows * p.columns
    place = {}
    for k in range(count):
        row, column = divmod(k, p.columns)
        place[row, p.columns - 1 - column if row % 2 else column] = k
    pairs = []
    for (row, column), k in place.items():
        beside = [(row, column + 1)] + ([(row + 1, column)] if column % p.cross_every == 0 else [])
        pairs += [(k, place[other]) for other in beside if other in place]
    return sorted(tuple(sorted(pair)) for pair in pairs)  # type: ignore[misc]


def _cameras(name: str, S: Sim3, p: SiteParams) -> Cameras:
    """A ring of eight, 4 m out and 3 m up, that look at the ground beneath the middle."""
    poses = []
    for k in range(8):
        angle = 2 * np.pi * k / 8
        centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), 3.0]) / p.unit_m
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), centre
        poses.append(pose)
    intrinsics = np.tile([_FOCAL, _FOCAL, _SIZE[0] / 2, _SIZE[1] / 2], (8, 1))
    return Cameras(np.array(poses), intrinsics, np.tile(_SIZE, (8, 1)), tuple(f"{name}_{k}.jpg" for k in range(8)))


def _marks(
    names: Sequence[str],
    truth: Sequence[Sim3],
    cameras: Sequence[Cameras],
    p: SiteParams,
    rng: np.random.Generator,
    frame: WorldFrame,
) -> list[Mark]:
    from gsmap.geodesy.frame import from_frame

    controls = _spread(p)[: p.num_control]
    checks = rng.choice([k for k in range(len(names)) if k not in controls], p.num_check, replace=False).tolist()
    out = []
    for name, k in [(f"G{i}", k) for i, k in enumerate(controls)] + [(f"C{i}", k) for i, k in enumerate(checks)]:
        local = np.r_[rng.uniform(-1, 1, 2), 0.0] / p.unit_m
        true_m = truth[k].apply(local)
        surveyed = from_frame(frame, (true_m + rng.normal(size=3) * p.survey_m)[None])[0]
        pixels = {}
        for c in rng.choice(len(cameras[k]), p.num_views, replace=False).tolist():
            at, _ = project(local[None], cameras[k].T_camera_frame[c], cameras[k].intrinsics_px[c])
            picked = at[0] + rng.normal(size=2) * p.pixel_px
            pixels[cameras[k].names[c]] = (float(picked[0]), float(picked[1]))
        out.append(Mark(name, true_m, surveyed, names[k], pixels))
    return out


def _spread(p: SiteParams) -> list[int]:
    """The corners, the middle, then the middles of the sides: as a surveyor sets them out."""

    def at(row: int, column: int) -> int:
        return row * p.columns + (p.columns - 1 - column if row % 2 else column)

    r, c = p.rows - 1, p.columns - 1
    wanted = [at(0, 0), at(r, c), at(0, c), at(r, 0), at(r // 2, c // 2)]
    wanted += [at(0, c // 2), at(r, c // 2), at(r // 2, 0), at(r // 2, c)]
    return list(dict.fromkeys(wanted))
