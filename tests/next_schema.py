"""A schema after the present one, so that migrating and reading older maps is tested before there is one."""

from __future__ import annotations

import shutil
from pathlib import Path

from gsmap.store import migrate, schema

NUMBER = f"{int(schema.HEAD) + 1:04}"
_MIGRATION = f'''
from alembic import op

revision = "{NUMBER}"
down_revision = "{schema.HEAD}"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_index("ix_scenes_source", "scenes", ["source"])
    op.execute("UPDATE scenes SET source = 'migrated ' || source")


def downgrade() -> None:
    op.execute("UPDATE scenes SET source = substr(source, 10)")
    op.drop_index("ix_scenes_source", table_name="scenes")
'''


def install(folder: Path) -> None:
    """Make this process a gsmap of the next schema, whose migrations lie in a folder."""
    if not folder.exists():
        shutil.copytree(migrate.folder(), folder, ignore=shutil.ignore_patterns("__pycache__"))
        (folder / "versions" / f"{NUMBER}_next.py").write_text(_MIGRATION)
    migrate.folder = lambda: folder
    schema.HEAD = NUMBER
