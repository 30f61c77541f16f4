"""Objects: parts found in renders, lifted to the surface, associated over views, with their context."""
