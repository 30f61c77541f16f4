"""Build the report of a map."""
