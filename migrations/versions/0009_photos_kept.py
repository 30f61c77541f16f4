"""Photographs that a map keeps as evidence: where and when they were taken, and what they show of its things."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "photo_sightings",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("digest", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("captured_at", sa.Text),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("group_id", sa.Text),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("removed_at", sa.Text),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_photo_sightings_scene_scenes")),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_photo_sightings_group_id_groups")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_photo_sightings")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_photo_sightings_digest"), "photo_sightings", ["digest"])
    op.create_index(op.f("ix_photo_sightings_scene"), "photo_sightings", ["scene"])


def downgrade() -> None:
    op.execute("DELETE FROM files WHERE group_id IN (SELECT group_id FROM photo_sightings)")
    op.drop_index(op.f("ix_photo_sightings_scene"), table_name="photo_sightings")
    op.drop_index(op.f("ix_photo_sightings_digest"), table_name="photo_sightings")
    op.drop_table("photo_sightings")
    op.execute("DELETE FROM groups WHERE kind = 'photos'")
