"""Localize photos and scans, and store localized photos."""
