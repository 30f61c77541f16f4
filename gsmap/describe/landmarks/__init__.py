"""Landmarks: typed blobs of colour and density, with what surrounds them; needs neither renders nor models."""
