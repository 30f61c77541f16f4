"""Captures the way people have them -> Gaussians and cameras, checked."""

from gsmap.ingest.capture import Capture, read_capture, read_captures
from gsmap.ingest.find import Found, find_captures
from gsmap.ingest.synthesise import synthesise_cameras
from gsmap.ingest.validate import validate

__all__ = [
    "Capture",
    "Found",
    "find_captures",
    "read_capture",
    "read_captures",
    "synthesise_cameras",
    "validate",
]
