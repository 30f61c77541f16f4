"""Surface cells and renders of each scene, which all its registrations share."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "prepared_scenes",
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("recipe", sa.Text),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("unit_m", sa.Double().with_variant(sa.REAL(), "sqlite"), nullable=False),
        sa.Column("num_gaussians", sa.Integer, nullable=False),
        sa.Column("num_cells", sa.Integer, nullable=False),
        sa.Column("num_views", sa.Integer, nullable=False),
        sa.Column("num_own", sa.Integer, nullable=False),
        sa.Column("group_id", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_prepared_scenes_recipe_recipes")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_prepared_scenes_scene_scenes")),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_prepared_scenes_group_id_groups")),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_prepared_scenes")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_prepared_scenes_scene"), "prepared_scenes", ["scene"])


def downgrade() -> None:
    op.execute("DELETE FROM files WHERE group_id IN (SELECT group_id FROM prepared_scenes)")
    op.drop_index(op.f("ix_prepared_scenes_scene"), table_name="prepared_scenes")
    op.drop_table("prepared_scenes")
    op.execute("DELETE FROM groups WHERE kind = 'prepared'")
