"""Convert georeferences (poses of components in the world) to JSON, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmap.store.column_types import malformed_as_corrupt
from gsmap.store.matrices import from_array, from_pose, to_array, to_pose
from gsmap.types.plain import plain
from gsmap.types.world import Contradiction, Georeference, Residual, WorldFrame

_PAIRS = ("error_m", "sigma_m", "error_px")


def world_tie_to_json(tie: Georeference) -> dict[str, Any]:
    """Convert a georeference exactly to JSON."""
    return {
        "component": int(tie.component),
        "S_world_map": from_pose(tie.S_world_map),
        "covariance": from_array(tie.covariance),
        "metres_per_unit": tie.metres_per_unit,
        "scale_sigma": tie.scale_sigma,
        "frame": plain(tie.frame),
        "residuals": [plain(row) for row in tie.residuals],
        "problem": tie.problem,
        "notes": list(tie.notes),
        "problem_code": tie.problem_code,
        "contradictions": [plain(one) for one in tie.contradictions],
        "point_scatter": tie.point_scatter,
        "variance_factor": tie.variance_factor,
    }


def world_ties_of_json(values: list[dict[str, Any]]) -> tuple[Georeference, ...]:
    """Convert JSON to georeferences.

    Raises:
        CorruptError: not written by gsmap.
    """
    with malformed_as_corrupt("a georeference, in revisions.world,"):
        return tuple(_tie(value) for value in values)


def _tie(value: dict[str, Any]) -> Georeference:
    covariance, metres = to_array(value["covariance"]), value["metres_per_unit"]
    if covariance is not None and (covariance.shape != (7, 7) or not np.isfinite(covariance).all()):
        raise ValueError("no covariance")
    if metres is not None and not (np.isfinite(metres) and metres > 0):
        raise ValueError("no metre")
    rows = []
    for row in value["residuals"]:
        values: dict[str, Any] = {k: tuple(map(float, v)) if k in _PAIRS else v for k, v in row.items()}
        if not all(isinstance(values[k], str) for k in ("kind", "name", "scene", "use", "reason")):
            raise ValueError("names that are not strings")
        if not isinstance(values["dof"], int) or not isinstance(values["statistic"], float | int | None):
            raise ValueError("no statistic")
        rows.append(Residual(**values))
    return Georeference(
        int(value["component"]),
        to_pose(value["S_world_map"]),
        covariance,
        metres,
        str(value["problem"]),
        # missing in ties of earlier releases
        str(value.get("problem_code", "undetermined" if value["problem"] else "")),
        tuple(map(str, value["notes"])),
        float(value["scale_sigma"]),
        None if value["frame"] is None else WorldFrame(**value["frame"]),
        tuple(rows),
        tuple(_contradiction(one) for one in value.get("contradictions", [])),
        float(value.get("point_scatter", 1.0)),
        float(value.get("variance_factor", 1.0)),
    )


def _contradiction(value: dict[str, Any]) -> Contradiction:
    lists = {k: tuple(v) for k, v in value.items() if isinstance(v, list | tuple)}
    one = Contradiction(**{**value, **lists})
    if not all(isinstance(text, str) for text in (one.text, *one.scenes)):
        raise ValueError("names that are not strings")
    numbers = [*one.offset_m, *one.sigma_m, *([] if one.ratio is None else [one.ratio])]
    if not all(isinstance(number, float | int) for number in numbers) or not isinstance(one.count, int):
        raise ValueError("no numbers")
    return one
