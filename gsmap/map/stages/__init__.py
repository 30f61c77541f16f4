"""The stages, one per file: each reads from the store, calls a pure stage, and saves the result under its recipe."""
