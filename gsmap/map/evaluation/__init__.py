"""Evaluate a map against ground truth."""
