"""Captures the way people have them -> Gaussians and cameras, checked."""

from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.ingest.capture import Capture, check_scale, read_capture, read_captures, take_capture
from gsmap.ingest.dates import CaptureDate, find_date, given_date, parse_date
from gsmap.ingest.find import Found, LeftOut, Search, find_captures, search_captures
from gsmap.ingest.validate import validate

__all__ = [
    "Capture",
    "CaptureDate",
    "Found",
    "LeftOut",
    "Search",
    "check_scale",
    "find_captures",
    "find_date",
    "given_date",
    "parse_date",
    "read_capture",
    "read_captures",
    "search_captures",
    "synthesise_cameras",
    "take_capture",
    "validate",
]
