"""Captures the way people have them -> Gaussians and cameras, checked."""

from gsmap.ingest.capture import Capture, parse_date, read_capture, read_captures, take_capture
from gsmap.ingest.find import Found, find_captures
from gsmap.ingest.synthesise import synthesise_cameras
from gsmap.ingest.validate import validate

__all__ = [
    "Capture",
    "Found",
    "find_captures",
    "parse_date",
    "read_capture",
    "read_captures",
    "synthesise_cameras",
    "take_capture",
    "validate",
]
