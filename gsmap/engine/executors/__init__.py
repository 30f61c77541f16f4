"""Executors, one file each; contract in `gsmap.methods.executor`."""
