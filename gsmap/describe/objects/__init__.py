"""Objects: masks of renders that are lifted to the surface and associated over views; and segments of the surface."""
