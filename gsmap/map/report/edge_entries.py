"""The edges of a map with their residuals, as the page and the report show them."""

from __future__ import annotations

import math

from gsmap.map.reports.pairs import rows_of_registrations
from gsmap.report.content import EdgeEntry
from gsmap.store import Store
from gsmap.store.registrations import StoredRegistration
from gsmap.types import PoseGraph


def edge_entries(store: Store, graph: PoseGraph | None) -> list[tuple[EdgeEntry, StoredRegistration]]:
    """Return the current edge of every registered pair, with its residual in the newest poses and its probability.

    Args:
        graph: the newest poses.
    """
    current, outcomes, out = store.registrations.current(), graph.outcomes if graph else {}, []
    for row, stored in zip(rows_of_registrations(store, current), current, strict=True):
        outcome = outcomes.get((row.target, row.source))
        probability = float(stored.registration.evidence.get("probability", math.nan))
        entry = EdgeEntry(
            row,
            chi2=None if outcome is None else outcome.residual_chi2,
            probability=probability if math.isfinite(probability) else None,
        )
        out.append((entry, stored))
    return out
