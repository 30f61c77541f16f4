"""Digests of how a layer was made."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, is_dataclass


def method_digest(name: str, *parts: object) -> str:
    """``name-`` and 16 hex digits over everything that decides a layer: version, parameters, model digests."""
    plain = [asdict(p) if is_dataclass(p) and not isinstance(p, type) else p for p in parts]
    text = json.dumps([name, *plain], sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
