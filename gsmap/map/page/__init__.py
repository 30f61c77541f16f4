"""Serve and write the page of a map."""
