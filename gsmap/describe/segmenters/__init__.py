"""Segmenters, one file each: from a view to masks. The contract is in `gsmap.methods.segmenter`."""
