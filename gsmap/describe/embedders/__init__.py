"""Embedders, one file each: features of masks. The contract is in `gsmap.methods.embedder`."""
