"""Landmarks: typed blobs of colour and density with a descriptor of their surroundings; no renders, no networks."""
