"""Maps as values, as typed rows: branches and tags."""

from __future__ import annotations

from gsmap.store.branches import Branch
from gsmap.types.rows import BranchRow


def branch_row(branch: Branch) -> BranchRow:
    """A branch or a tag."""
    return BranchRow(
        name=branch.name,
        kind="tag" if branch.is_tag else "branch",
        map=branch.location,
        parent=branch.parent,
        created_at=branch.created_at,
        revision=branch.revision,
        num_scenes=branch.num_scenes,
        num_bytes=branch.num_bytes,
    )
