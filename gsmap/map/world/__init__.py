"""Georeference a map, measure in it, and export it for surveyors."""
