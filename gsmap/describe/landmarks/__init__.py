"""Landmarks: typed blobs of colour and density with a descriptor of their surroundings, without renders and
networks."""
