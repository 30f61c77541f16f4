"""Report of a map on one self-contained HTML page: scenes, edges, uncertainty, changes and open tasks.

`page` formats a `Report` as one HTML file without scripts or external links; its Content-Security-Policy lets a
browser load nothing. `gsmap.map.report.builder` collects the content.
"""

from gsmap.report.content import EdgeEntry, Island, PoseDifferences, Report, SceneEntry
from gsmap.report.page import SECTIONS, owner_mark, owner_of, page
from gsmap.report.params import Params
from gsmap.report.plan import Plan, PlanEdge, PlanScene, make_plan
from gsmap.report.top import density_picture, top_picture

__all__ = [
    "SECTIONS",
    "EdgeEntry",
    "Island",
    "PoseDifferences",
    "Params",
    "Plan",
    "PlanEdge",
    "Report",
    "SceneEntry",
    "PlanScene",
    "density_picture",
    "make_plan",
    "owner_mark",
    "owner_of",
    "page",
    "top_picture",
]
