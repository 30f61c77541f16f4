"""Settings: a frozen tree of parameters with dotted names, which a map stores as TOML and ``--set`` changes.

This room knows how any such tree is walked, changed and written; the tree itself is put together in `gsmap.map`, which
knows all stages. Stages are handed their own ``Params``: nothing here is global.
"""

from gsmap.settings.docs import field_docs, unit_of
from gsmap.settings.file import FILE_NAME, load, save
from gsmap.settings.tree import Leaf, changed, contains, differences, leaves, parse

__all__ = [
    "FILE_NAME",
    "Leaf",
    "changed",
    "contains",
    "differences",
    "field_docs",
    "leaves",
    "load",
    "parse",
    "save",
    "unit_of",
]
