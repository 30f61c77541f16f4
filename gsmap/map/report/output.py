"""Report files, and pages in one file, as outputs that a purge deletes."""

from __future__ import annotations

from gsmap.durable import is_file, remove_file
from gsmap.map.outputs import Output
from gsmap.report import owner_of

REPORTS = Output(
    is_at=lambda path, map_id: is_file(path) and owner_of(path) == map_id,
    num_files=lambda path, map_id, scene: 1,  # it shows all scenes; gsmap report makes it anew
    forget=lambda path, map_id, scene: remove_file(path.parent, path.name),
)
