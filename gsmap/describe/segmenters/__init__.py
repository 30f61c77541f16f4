"""Segmenters, one file each: masks of a view. The contract is in `gsmap.methods.segmenter`."""
