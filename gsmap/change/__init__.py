"""What changed between two captures of one place."""
