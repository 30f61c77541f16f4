"""Find: which things of a map are like one that is shown, named or pointed at."""

from gsmap.find.likeness import Look, Model, look_of, looks_of
from gsmap.find.ranking import best_of, by_likeness, cosines

__all__ = ["Look", "Model", "best_of", "by_likeness", "cosines", "look_of", "looks_of"]
