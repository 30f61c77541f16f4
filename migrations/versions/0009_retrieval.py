"""What retrieval derives from graphs: segments of its index, and what it said of each scene."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "index_segments",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("members", sa.Text, nullable=False),
        sa.Column("num_nodes", sa.Integer, nullable=False),
        sa.Column("group_id", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_index_segments_group_id_groups")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_index_segments")),
        sqlite_strict=True,
    )
    op.create_table(
        "lookups",
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("candidates", sa.Text, nullable=False),
        sa.Column("num_left", sa.Integer),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_lookups_scene_scenes")),
        sa.PrimaryKeyConstraint("scene", name=op.f("pk_lookups")),
        sqlite_strict=True,
    )


def downgrade() -> None:
    op.drop_table("lookups")
    op.execute("DELETE FROM files WHERE group_id IN (SELECT group_id FROM index_segments)")
    op.drop_table("index_segments")
    op.execute("DELETE FROM groups WHERE kind = 'indexes'")
