"""Report the georeference of a map as rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gsmap.map.reports.common import names
from gsmap.map.snapshot_read import snapshot_read
from gsmap.reason_codes import reason_code
from gsmap.store import Store
from gsmap.types.plain import fields_of
from gsmap.types.rows.world import ContradictionRow, GeoreferenceRow, ResidualRow, ResidualSummaryRow, WorldReport
from gsmap.types.world import Contradiction, Georeference, Residual, Survey, WorldPose


@snapshot_read
def world_report(store: Store, *, stale: bool, notes: Sequence[str] = ()) -> WorldReport:
    """Report the newest georeference and its observations.

    Args:
        stale: true if its inputs have changed since.
    """
    survey, ties, placed = store.world.survey(), store.revisions.world(), store.revisions.poses()
    name_of = names(store)
    sizes = Counter(pose.component for pose in placed.values())
    shown = {image.point for image in survey.images}
    frame = survey.frame
    system = None
    if frame is not None:
        from gsmap.geodesy.crs import crs

        system = crs(frame.crs)
    return WorldReport(
        crs=None if frame is None else frame.crs,
        crs_name="" if system is None else system.name,
        axes=() if system is None else system.axes,
        own_heights=False if system is None else system.has_own_heights,
        heights="" if system is None else system.heights,
        height_unit_m=None if system is None else system.height_unit_m,
        origin=None if frame is None else (frame.latitude_deg, frame.longitude_deg, frame.height_m),
        components=tuple(_tie_row(tie, sizes[tie.component], name_of) for tie in ties),
        unseen=tuple(point.name for point in survey.points if point.name not in shown),
        revision=store.revisions.newest_number(),
        stale=stale,
        notes=(*notes, *_sea_level_note(survey)),
    )


def _sea_level_note(survey: Survey) -> list[str]:
    """Return a note if the map's height comes from EXIF heights above sea level alone."""
    sigmas = [fix.sea_level_sigma_m for fix in survey.fixes]
    if not sigmas or min(sigmas) == 0 or any(not point.check for point in survey.points):
        return []
    return [
        "heights come from EXIF alone, which counts them above sea level (the geoid): as heights above the ellipsoid "
        f"they may be off by tens of metres, all alike (taken as {max(sigmas):g} m); a control point, or photos with "
        "heights above the ellipsoid, settle it"
    ]


def _tie_row(tie: Georeference, num_scenes: int, name_of: Mapping[str, str]) -> GeoreferenceRow:
    controls = [row.error_m for row in tie.residuals if row.use == "used" and row.kind != "image"]
    checks = [row.error_m for row in tie.residuals if row.use == "check" and row.kind == "point"]
    return GeoreferenceRow(
        **fields_of(tie, WorldPose),
        num_scenes=num_scenes,
        scale_sigma=tie.scale_sigma if np.isfinite(tie.scale_sigma) else None,
        rms_m=_rms(controls),
        rms_check_m=_rms(checks),
        num_outliers=sum(row.use == "outlier" for row in tie.residuals),
        by_kind=tuple(_by_kind(tie.residuals)),
        residuals=tuple(residual_row(row, name_of) for row in tie.residuals),
        contradictions=tuple(_contradiction_row(one, name_of) for one in tie.contradictions),
    )


def _by_kind(residuals: Sequence[Residual]) -> Iterator[ResidualSummaryRow]:
    """Yield a summary of the residuals of control points, check points, positions and bars that a component has."""
    for kind in ("point", "check", "fix", "bar"):
        source, uses = ("point", ("check",)) if kind == "check" else (kind, ("used", "outlier"))
        mine = [row for row in residuals if row.kind == source and row.use in uses]
        errors = np.array([row.error_m for row in mine if row.error_m and row.use != "outlier"], np.float64)
        num_outliers = sum(row.use == "outlier" for row in mine)
        if len(errors) or num_outliers:
            yield ResidualSummaryRow(
                kind=kind,
                count=len(errors),
                num_outliers=num_outliers,
                rms_m=tuple(np.sqrt((errors**2).mean(0)).tolist()) if len(errors) else (),
                max_m=tuple(np.abs(errors).max(0).tolist()) if len(errors) else (),
            )


def _contradiction_row(one: Contradiction, name_of: Mapping[str, str]) -> ContradictionRow:
    return ContradictionRow(**vars(one), scene_names=tuple(name_of.get(scene, "") for scene in one.scenes))


def residual_row(row: Residual, name_of: Mapping[str, str]) -> ResidualRow:
    """Return a residual as a row."""
    return ResidualRow(
        **vars(row),
        scene_name=name_of.get(row.scene, ""),
        size_m=float(np.linalg.norm(row.error_m)) if row.error_m else None,
        reason_code=reason_code(row.reason),
    )


def _rms(errors: Sequence[tuple[float, ...]]) -> float | None:
    told = [float(np.sum(np.square(error))) for error in errors if error]
    return float(np.sqrt(np.mean(told))) if told else None
