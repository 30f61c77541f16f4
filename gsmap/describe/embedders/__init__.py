"""Embedders, one file each: from masks to features. The contract is in `gsmap.methods.embedder`."""
