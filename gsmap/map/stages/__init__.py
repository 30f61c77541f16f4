"""The stages, one file each: read from the store, call a pure stage, save the result under its recipe."""
