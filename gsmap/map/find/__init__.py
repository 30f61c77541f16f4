"""Search for objects and places."""
