"""Find captures in files, folders and trainer outputs, read them, and check their Gaussians and cameras."""

from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.ingest.capture import Capture, check_scale, read_capture, read_captures, take_capture
from gsmap.ingest.capture_search import (
    CaptureFiles,
    SearchResult,
    SkippedPath,
    exported_scenes,
    find_captures,
    search_captures,
)
from gsmap.ingest.dates import CaptureDate, find_date, given_date, parse_date
from gsmap.ingest.validate import validate

__all__ = [
    "Capture",
    "CaptureDate",
    "CaptureFiles",
    "SkippedPath",
    "SearchResult",
    "check_scale",
    "exported_scenes",
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
