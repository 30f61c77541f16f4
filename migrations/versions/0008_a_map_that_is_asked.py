"""A map that is asked: features of views, by which photographs are localised; and the world.

Of the world: what was observed of it, and where each revision has the components in it.
"""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_KINDS = "kind in ('frame', 'point', 'image', 'fix', 'bar')"


def upgrade() -> None:
    op.create_table(
        "view_features",
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("recipe", sa.Text),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("num_views", sa.Integer, nullable=False),
        sa.Column("num_features", sa.Integer, nullable=False),
        sa.Column("summaries", sa.LargeBinary, nullable=False),
        sa.Column("group_id", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_view_features_recipe_recipes")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_view_features_scene_scenes")),
        sa.ForeignKeyConstraint(["group_id"], ["groups.id"], name=op.f("fk_view_features_group_id_groups")),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_view_features")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_view_features_scene"), "view_features", ["scene"])
    op.create_table(
        "observations",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("scene", sa.Text),
        sa.Column("other", sa.Text),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.Column("removed_at", sa.Text),
        sa.CheckConstraint(_KINDS, name=op.f("ck_observations_kind")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_observations_scene_scenes")),
        sa.ForeignKeyConstraint(["other"], ["scenes.id"], name=op.f("fk_observations_other_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_observations")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_observations_scene"), "observations", ["scene"])
    op.execute("ALTER TABLE revisions ADD COLUMN world TEXT NOT NULL DEFAULT '[]'")


def downgrade() -> None:
    op.execute("ALTER TABLE revisions DROP COLUMN world")
    op.drop_table("observations")
    op.execute("DELETE FROM files WHERE group_id IN (SELECT group_id FROM view_features)")
    op.drop_index(op.f("ix_view_features_scene"), table_name="view_features")
    op.drop_table("view_features")
    op.execute("DELETE FROM groups WHERE kind = 'views'")
