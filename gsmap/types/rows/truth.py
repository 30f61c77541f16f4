"""A map against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.pairs import PairRef


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseErrorRow(PairRef):
    """The error of one relative pose.

    Args:
        rre_deg: relative rotation error.
        centroid_m: distance between where the estimated and the true pose put the source's middle, in metres through
            the truth's scale.
        rte: relative translation error by the length of the true one, after GaussReg.
        rse: relative scale error.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "rre_deg": "RRE, deg",
        "centroid_m": "centroid, m",
        "rte": "RTE",
        "rse": "RSE",
    }

    rre_deg: float
    centroid_m: float
    rte: float
    rse: float


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeErrorRow(PoseErrorRow):
    """An accepted edge that no person rejected, against the truth.

    Args:
        true_overlap: the smaller of both directions' share of opaque, not huge Gaussians that lie within 8 cm of the
            other capture's by the true poses, in [0, 1].
        used: whether the newest poses use it: true, false, or ``"tentative"`` (no cycle confirms it).
        right: whether it is within the bars, ``max_rre_deg`` and ``max_rte_m`` of the report.
        nees: its squared error over its covariance; null where it has no information.
        nees_dof: degrees of freedom of that; 6 where edge and truth are rigid, else 7.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "true_overlap": "true overlap",
        "used": "used",
        "right": "right",
        "rre_deg": "RRE, deg",
        "centroid_m": "centroid, m",
        "rte": "RTE",
        "rse": "RSE",
        "nees": "NEES",
        "nees_dof": "dof",
    }

    true_overlap: float
    used: bool | str
    right: bool
    nees: float | None = None
    nees_dof: int | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class BandRow(Row):
    """The pairs of captures whose true overlap lies in a band.

    Args:
        overlap_from: lower end, which belongs to the band.
        overlap_to: upper end, which does not unless it is 1.
        num_pairs: pairs of scenes with a truth; in the lowest band most may share nothing, and count as missed.
        num_accepted: accepted edges among them.
        num_right: those of them that are right.
        recall: right edges by pairs; null where there is no pair.
        precision: right edges by accepted ones; null where there is none.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "band": "true overlap",
        "num_pairs": "pairs",
        "num_accepted": "accepted",
        "num_right": "right",
        "recall": "recall",
        "precision": "precision",
    }

    overlap_from: float
    overlap_to: float
    num_pairs: int
    num_accepted: int
    num_right: int
    recall: float | None
    precision: float | None

    @property
    def band(self) -> str:
        """In words."""
        return f"{100 * self.overlap_from:.3g} to {100 * self.overlap_to:.3g} %"


@dataclass(frozen=True, eq=False, kw_only=True)
class ComponentErrorRow(Row):
    """The newest poses of one component against the truth.

    Args:
        component: its index.
        scene_names: the living scenes that it ties together.
        num_cameras: cameras of those that have a truth.
        alignment: ``rigid`` where the truth says that the scenes are in metres, else ``similarity``.
        ate_m: root mean square error of the camera centres after one alignment; null where it would say nothing.
        ate_reason: why it is null; empty where it is not.
        metres_per_unit: what the map takes for the metre of its frame; null where it does not say.
        metre_sigma: standard deviation of its logarithm; null as above.
        metre_known_by: see ``gsmap status``.
        true_metres_per_unit: by the truth of its scenes; null where none has any.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "scene_names": "scenes",
        "num_cameras": "cameras",
        "alignment": "alignment",
        "ate_m": "ATE, m",
        "ate_reason": "why none",
        "metres_per_unit": "m a unit",
        "true_metres_per_unit": "truly",
    }

    component: int
    scene_names: tuple[str, ...]
    num_cameras: int
    alignment: str
    ate_m: float | None
    ate_reason: str = ""
    metres_per_unit: float | None = None
    metre_sigma: float | None = None
    metre_known_by: str = ""
    true_metres_per_unit: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class NeesRow(Row):
    """How honest covariances are: squared errors over them (NEES).

    Args:
        of: ``edges`` (from their information), or ``poses`` (each relative to the scene that holds its frame).
        dof: degrees of freedom: 6 where both the pose and the truth are rigid, else 7.
        num: how many there are.
        median: of the squared errors over their covariances.
        expected_median: what honest covariances have.
        within_3_sigma: the share no larger than what honest ones exceed as rarely as a normal error does 3 sigma.
        expected_within_3_sigma: what honest covariances have.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "of": "NEES of",
        "num": "count",
        "dof": "dof",
        "median": "median",
        "expected_median": "expected",
        "within_3_sigma": "within 3 sigma",
        "expected_within_3_sigma": "expected ",
    }

    of: str
    dof: int
    num: int
    median: float
    expected_median: float
    within_3_sigma: float
    expected_within_3_sigma: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageErrorRow(Row):
    """How well a scene's own photographs are reproduced.

    Args:
        scene: id.
        scene_name: name.
        num_images: how many photographs were compared.
        alone_psnr_db: by the scene alone.
        alone_ssim: by the scene alone.
        alone_lpips: by the scene alone; null where no LPIPS network was given.
        union_psnr_db: by the union of it and the scenes of its component whose boxes meet its own; null where it has no
            place.
        union_ssim: by that union; null as above.
        union_lpips: by that union; null as above, or where no LPIPS network was given.
        tiles_psnr_db: by the exported tiles that it has a part in; null where none were given or it is in none.
        tiles_ssim: by those tiles; null as above.
        tiles_lpips: by those tiles; null as above, or where no LPIPS network was given.
        tiles_cover: share of its opaque Gaussians that lie within those tiles, in [0, 1]: where an export holds only a
            part of it, photographs show what the tiles cannot; null as above.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "num_images": "images",
        "alone_psnr_db": "PSNR alone, dB",
        "alone_ssim": "SSIM alone",
        "alone_lpips": "LPIPS alone",
        "union_psnr_db": "PSNR union, dB",
        "union_ssim": "SSIM union",
        "union_lpips": "LPIPS union",
        "tiles_psnr_db": "PSNR tiles, dB",
        "tiles_ssim": "SSIM tiles",
        "tiles_lpips": "LPIPS tiles",
        "tiles_cover": "in tiles",
    }

    scene: str
    scene_name: str
    num_images: int
    alone_psnr_db: float
    alone_ssim: float
    alone_lpips: float | None = None
    union_psnr_db: float | None = None
    union_ssim: float | None = None
    union_lpips: float | None = None
    tiles_psnr_db: float | None = None
    tiles_ssim: float | None = None
    tiles_lpips: float | None = None
    tiles_cover: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationReport(Row):
    """A map against ground truth.

    Args:
        num_scenes: living scenes of the map.
        num_placed: those that the newest poses place; see ``status`` of `SceneRow`.
        num_tentative: those beside them that are tied to others by edges which no cycle confirms.
        edges: each accepted edge that no person rejected, as it was registered.
        pairs: each pair of scenes of one component, by the newest poses.
        images: renders against photographs; empty where no photographs were given.
        edges_in_use: how many of ``edges`` the newest poses use.
        edges_without_truth: accepted edges that could not be judged.
        false_edges: edges that the newest poses use and that are wrong.
        max_rre_deg: an edge whose ``rre_deg`` is larger is wrong.
        max_rte_m: an edge whose ``centroid_m`` is larger is wrong.
        bands: recall and precision of ``edges`` by true overlap.
        components: what the newest poses tie together, against the truth.
        nees: how honest the covariances of edges and poses are.
        truth_sigma_deg: standard deviation of each scene's true rotation that ``nees`` allows for,
        truth_sigma_m: and of where its middle truly lies, in metres.
        edges_median_rre_deg: over ``edges``; null where there are none.
        edges_median_centroid_m: as above.
        edges_median_rte: as above.
        edges_median_rse: as above.
        edges_worst_rre_deg: as above.
        edges_worst_centroid_m: as above.
        pairs_median_rre_deg: over ``pairs``; null where there are none.
        pairs_median_centroid_m: as above.
        pairs_median_rte: as above.
        pairs_median_rse: as above.
        pairs_worst_rre_deg: as above.
        pairs_worst_centroid_m: as above.
        ate_m: root mean square error of the camera centres over all ``components`` that have one; null where none has.
            Isolated scenes never count: aligned alone, each would be right.
        ate_reason: why there is none; empty where there is one.
        notes: what a person should know: scenes that could not be judged, poses that are out of date.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "verdict": "verdict",
        "edges_verdict": "edges in use",
        "edges_median_rre_deg": "edges: median RRE, deg",
        "edges_median_centroid_m": "edges: median centroid, m",
        "edges_median_rte": "edges: median RTE",
        "edges_median_rse": "edges: median RSE",
        "edges_worst_rre_deg": "edges: worst RRE, deg",
        "edges_worst_centroid_m": "edges: worst centroid, m",
        "pairs_median_rre_deg": "pairs: median RRE, deg",
        "pairs_median_centroid_m": "pairs: median centroid, m",
        "pairs_median_rte": "pairs: median RTE",
        "pairs_median_rse": "pairs: median RSE",
        "pairs_worst_rre_deg": "pairs: worst RRE, deg",
        "pairs_worst_centroid_m": "pairs: worst centroid, m",
        "ate_m": "ATE, m",
        "notes_text": "notes",
    }

    num_scenes: int
    num_placed: int
    num_tentative: int
    edges: tuple[EdgeErrorRow, ...] = ()
    pairs: tuple[PoseErrorRow, ...] = ()
    images: tuple[ImageErrorRow, ...] = ()
    edges_in_use: int
    edges_without_truth: int
    false_edges: tuple[PairRef, ...] = ()
    max_rre_deg: float
    max_rte_m: float
    bands: tuple[BandRow, ...] = ()
    components: tuple[ComponentErrorRow, ...] = ()
    nees: tuple[NeesRow, ...] = ()
    truth_sigma_deg: float = 0.0
    truth_sigma_m: float = 0.0
    edges_median_rre_deg: float | None = None
    edges_median_centroid_m: float | None = None
    edges_median_rte: float | None = None
    edges_median_rse: float | None = None
    edges_worst_rre_deg: float | None = None
    edges_worst_centroid_m: float | None = None
    pairs_median_rre_deg: float | None = None
    pairs_median_centroid_m: float | None = None
    pairs_median_rte: float | None = None
    pairs_median_rse: float | None = None
    pairs_worst_rre_deg: float | None = None
    pairs_worst_centroid_m: float | None = None
    ate_m: float | None = None
    ate_reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """How many scenes have a place, and the ATE or why there is none, in words."""
        placed = f"{self.num_placed} of {self.num_scenes} placed"
        if self.num_tentative:
            placed += f", {self.num_tentative} tentative"
        return f"{placed}, no ATE: {self.ate_reason}" if self.ate_m is None else f"{placed}, ATE {self.ate_m:.3g} m"

    @property
    def edges_verdict(self) -> str:
        """How many edges in use are wrong, and which, in words."""
        bars = f"beyond {self.max_rre_deg:g} deg or {self.max_rte_m:g} m"
        if not self.edges_in_use:
            return "none that the truth could judge"
        names = ": " + ", ".join(edge.pair for edge in self.false_edges) if self.false_edges else ""
        return f"{len(self.false_edges)} of {self.edges_in_use} false, {bars}{names}"

    @property
    def notes_text(self) -> str:
        """In one line."""
        return "; ".join(self.notes)
