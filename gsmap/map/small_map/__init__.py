"""Export a small map for localization, and localize photos in it."""
