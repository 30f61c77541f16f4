"""Draw pairs, changes, objects and floor plans."""
