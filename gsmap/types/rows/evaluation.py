"""Evaluation of a map against ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.pairs import PairRef


@dataclass(frozen=True, eq=False)
class PoseError:
    """Errors of one estimated ``S_target_source``.

    Args:
        rre_deg: relative rotation error, the angle of ``R^T R_hat``.
        centroid_m: distance between the estimated and true position of the source's centre, in metres by the truth's
            scale; it does not depend on the origins of the frames.
        rte: relative translation error as in GaussReg, ``|t/s - t_hat/s_hat| / |t/s|``; it depends on the distance
            between the origins of both frames.
        rse: relative scale error, ``|s - s_hat| / s``.
    """

    rre_deg: float
    centroid_m: float
    rte: float
    rse: float


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseErrorRow(PoseError, PairRef):
    """The error of one estimated relative pose."""

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "rre_deg": "RRE, deg",
        "centroid_m": "centroid, m",
        "rte": "RTE",
        "rse": "RSE",
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeErrorRow(PoseErrorRow):
    """The error of an accepted edge that was not rejected in review.

    Args:
        true_overlap: fraction of opaque, not huge Gaussians within 8 cm of the other capture's under the true poses,
            the smaller of both directions, in [0, 1].
        used: use by the newest poses: true, false, or ``"tentative"`` (no agreeing cycle).
        right: true if it is within ``max_rre_deg`` and ``max_rte_m`` of the report.
        nees: normalized estimation error squared; null without information matrix.
        nees_dof: degrees of freedom of ``nees``; 6 if edge and truth are rigid, else 7.
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
    """The pairs of captures whose true overlap lies in one band.

    Args:
        overlap_from: lower end of the band, inclusive.
        overlap_to: upper end of the band, exclusive unless it is 1.
        num_pairs: number of pairs of scenes with a truth; most pairs of the lowest band may share nothing and count as
            missed.
        num_accepted: number of accepted edges.
        num_right: number of correct edges.
        recall: correct edges divided by pairs; null without pairs.
        precision: correct edges divided by accepted edges; null without accepted edges.
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
        """The band of overlap as text."""
        return f"{100 * self.overlap_from:.3g} to {100 * self.overlap_to:.3g} %"


@dataclass(frozen=True, eq=False, kw_only=True)
class ComponentErrorRow(Row):
    """The error of one component's newest poses.

    Args:
        component: component index.
        scene_names: names of its living scenes.
        num_cameras: number of cameras of scenes with a truth.
        alignment: ``rigid`` if the scenes are in metres by the truth, else ``similarity``.
        ate_m: root mean square error of the camera centres after alignment; null if it is not meaningful.
        ate_reason: reason why ``ate_m`` is null, or empty.
        metres_per_unit: metric scale by the map; null if unknown.
        metre_sigma: standard deviation of its logarithm; null if unknown.
        metre_known_by: source of the metric scale, see ``gsmap status``.
        true_metres_per_unit: metric scale by the truth; null without truth.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "scene_names": "scenes",
        "num_cameras": "cameras",
        "alignment": "alignment",
        "ate_m": "ATE, m",
        "ate_reason": "why none",
        "metres_per_unit": "m per unit",
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
    """Consistency of covariances by normalized estimation errors squared (NEES).

    Args:
        of: ``edges`` (by their information), or ``poses`` (relative to the scene that holds their frame).
        dof: degrees of freedom: 6 if pose and truth are rigid, else 7.
        num: number of values.
        median: median NEES.
        expected_median: median NEES of consistent covariances.
        within_3_sigma: fraction below the quantile that corresponds to 3 sigma.
        expected_within_3_sigma: that fraction for consistent covariances.
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
    """The errors of renders against a scene's own photos.

    Args:
        scene: id.
        scene_name: name.
        num_images: number of compared photos.
        alone_psnr_db: PSNR of the scene alone, dB.
        alone_ssim: SSIM of the scene alone.
        alone_lpips: LPIPS of the scene alone; null without an LPIPS network.
        union_psnr_db: PSNR of the union with overlapping scenes of its component, dB; null without a pose.
        union_ssim: SSIM of that union; null without a pose.
        union_lpips: LPIPS of that union; null without a pose or an LPIPS network.
        tiles_psnr_db: PSNR of the exported tiles of the scene, dB; null without such tiles.
        tiles_ssim: SSIM of these tiles; null without such tiles.
        tiles_lpips: LPIPS of these tiles; null without such tiles or an LPIPS network.
        tiles_cover: fraction of its opaque Gaussians within these tiles, in [0, 1]; a partial export lowers the other
            values; null without such tiles.
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
    """The evaluation of a map.

    Args:
        num_scenes: number of living scenes.
        num_placed: number of scenes with status ``placed``, see `SceneRow`.
        num_tentative: number of scenes with status ``tentative``.
        edges: accepted edges that were not rejected in review, as registered.
        pairs: pairs of scenes of one component, by the newest poses.
        images: renders against photos; empty without photos.
        edges_in_use: number of ``edges`` that the newest poses use.
        edges_without_truth: number of accepted edges without a truth.
        false_edges: used edges that are wrong.
        max_rre_deg: maximum ``rre_deg`` of a correct edge.
        max_rte_m: maximum ``centroid_m`` of a correct edge.
        bands: recall and precision of ``edges`` by true overlap.
        components: errors of the newest poses by component.
        nees: consistency of the covariances of edges and poses.
        truth_sigma_deg: standard deviation of the true rotation of each scene that ``nees`` allows for.
        truth_sigma_m: standard deviation of the true position of each scene's centre that ``nees`` allows for, metres.
        edges_median_rre_deg: median ``rre_deg`` of ``edges``; null without edges.
        edges_median_centroid_m: median ``centroid_m`` of ``edges``; null without edges.
        edges_median_rte: median ``rte`` of ``edges``; null without edges.
        edges_median_rse: median ``rse`` of ``edges``; null without edges.
        edges_worst_rre_deg: largest ``rre_deg`` of ``edges``; null without edges.
        edges_worst_centroid_m: largest ``centroid_m`` of ``edges``; null without edges.
        pairs_median_rre_deg: median ``rre_deg`` of ``pairs``; null without pairs.
        pairs_median_centroid_m: median ``centroid_m`` of ``pairs``; null without pairs.
        pairs_median_rte: median ``rte`` of ``pairs``; null without pairs.
        pairs_median_rse: median ``rse`` of ``pairs``; null without pairs.
        pairs_worst_rre_deg: largest ``rre_deg`` of ``pairs``; null without pairs.
        pairs_worst_centroid_m: largest ``centroid_m`` of ``pairs``; null without pairs.
        ate_m: root mean square error of the camera centres of all ``components`` with an ATE; null without one;
            isolated scenes never count.
        ate_reason: reason why ``ate_m`` is null, or empty.
        notes: remarks, such as scenes without a truth or poses that are out of date.
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
        """Number of placed scenes, and the ATE or the reason why no ATE could be computed, as text."""
        placed = f"{self.num_placed} of {self.num_scenes} placed"
        if self.num_tentative:
            placed += f", {self.num_tentative} tentative"
        return f"{placed}, no ATE: {self.ate_reason}" if self.ate_m is None else f"{placed}, ATE {self.ate_m:.3g} m"

    @property
    def edges_verdict(self) -> str:
        """Number and names of incorrect edges in use, as text."""
        bars = f"beyond {self.max_rre_deg:g} deg or {self.max_rte_m:g} m"
        if not self.edges_in_use:
            return "no edge in use could be compared with the truth"
        names = ": " + ", ".join(edge.pair for edge in self.false_edges) if self.false_edges else ""
        return f"{len(self.false_edges)} of {self.edges_in_use} false, {bars}{names}"

    @property
    def notes_text(self) -> str:
        """All notes in one line."""
        return "; ".join(self.notes)
