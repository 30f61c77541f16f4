"""Synthetic scenes to try gsmap on: a furnished flat from a seed, filmed and trained into captures with known truth."""

from gsmap_synthetic.capture import Frames, film, walk
from gsmap_synthetic.make import DemoCapture, make_captures, shown, write_captures
from gsmap_synthetic.place import Place, make_place

__all__ = ["DemoCapture", "Frames", "Place", "film", "make_captures", "make_place", "shown", "walk", "write_captures"]
