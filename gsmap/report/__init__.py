"""A map on one page: what it holds, what is certain and what is not, drawn and told for people.

`page` makes one HTML file of a `Report`. It holds everything it shows: no script, no link to anything outside,
and a Content-Security-Policy that lets a browser load nothing. What a report says is put together in
`gsmap.map.report_builder`; here is how it is drawn.
"""

from gsmap.report.content import (
    Additions,
    ChangePicture,
    EdgeEntry,
    Island,
    PairPicture,
    PoseDifferences,
    Report,
    SceneEntry,
    StorageEntry,
)
from gsmap.report.page import SECTIONS, owner_of, page
from gsmap.report.params import Params
from gsmap.report.plan import Plan, PlanEdge, PlanScene, make_plan
from gsmap.report.top import density_picture, top_picture

__all__ = [
    "SECTIONS",
    "ChangePicture",
    "EdgeEntry",
    "Island",
    "PoseDifferences",
    "Additions",
    "PairPicture",
    "Params",
    "Plan",
    "PlanEdge",
    "Report",
    "SceneEntry",
    "PlanScene",
    "StorageEntry",
    "density_picture",
    "make_plan",
    "owner_of",
    "page",
    "top_picture",
]
