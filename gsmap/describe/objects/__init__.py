"""Objects: masks from renders, lifted to the surface and associated over views; and segments of the surface."""
