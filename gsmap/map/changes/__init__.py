"""Compare visits, and report changes."""
