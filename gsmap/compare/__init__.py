"""Two captures seen from the same cameras: where they agree, where they disagree, and what neither can say."""
