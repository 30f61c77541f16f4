"""64-bit fingerprint of the measurements from which an answer was computed."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from gsmap.types import Edge, Prior
from gsmap.types.plain import canonical
from gsmap.types.world import Survey


def fingerprint(edges: Sequence[Edge], priors: Sequence[Prior] = (), survey: Survey | None = None) -> int:
    """Compute a 64-bit sum of the hashes of all measurements, by which unchanged measurements are recognized.

    The fingerprint is independent of the order of measurements, and additive over sets of measurements (modulo 2^64).
    It detects changes, not attacks.
    """
    flat = [(e.S_target_source, e.information, _named(e), 2 + e.confirmed) for e in edges]
    flat += [(p.S_map_scene, np.diag(p.sigmas), f"{p.scene}\0{p.up!r}{p.up_sigma_rad!r}", 4) for p in priors]
    n = len(flat)
    values = np.empty((n, 64))
    values[:, :49] = np.array([row[1] for row in flat], dtype=np.float64).reshape(n, 49)
    values[:, 49:58] = np.array([row[0].rotation for row in flat]).reshape(n, 9)
    values[:, 58:61] = np.array([row[0].translation for row in flat]).reshape(n, 3)
    values[:, 61] = [row[0].scale for row in flat]
    values[:, 62] = [zlib.crc32(row[2].encode()) for row in flat]
    values[:, 63] = [row[3] for row in flat]
    factors = np.random.default_rng(0).integers(1, 2**63, 64, dtype=np.uint64) | np.uint64(1)
    mixed = ((values.view(np.uint64) ^ (values.view(np.uint64) >> np.uint64(29))) * factors).sum(1)
    mixed = (mixed ^ (mixed >> np.uint64(32))) * factors[0]
    observed = zlib.crc32(canonical(survey).encode()) if survey else 0
    return int((mixed ^ (mixed >> np.uint64(29))).sum()) + observed * 0x9E3779B97F4A7C15


def _named(edge: Edge) -> str:
    """Return the part of an edge's hashed text that is not numbers."""
    same = "duplicate" * edge.duplicate
    likeness = f"{edge.disagreement!r}{edge.look_alike!r}{edge.same_visit!r}{edge.log_odds_wrong!r}"
    return f"{edge.target}\0{edge.source}\0{likeness}{same}"
