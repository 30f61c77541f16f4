"""Objects of the map are kept: their numbers, where captures show them, what people said of them."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "objects",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_objects")),
        sqlite_strict=True,
    )
    op.create_table(
        "object_places",
        sa.Column("object", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("box", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["object"], ["objects.number"], name=op.f("fk_object_places_object_objects")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_object_places_scene_scenes")),
        sa.PrimaryKeyConstraint("object", "scene", name=op.f("pk_object_places")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_object_places_scene"), "object_places", ["scene"])
    op.create_table(
        "object_facts",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("object", sa.Integer, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("author", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("kind in ('name', 'label', 'note', 'same_as')", name=op.f("ck_object_facts_kind")),
        sa.ForeignKeyConstraint(["object"], ["objects.number"], name=op.f("fk_object_facts_object_objects")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_object_facts")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_object_facts_object"), "object_facts", ["object"])
    op.create_table(
        "object_sets",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("key", sa.Text, nullable=False),
        sa.Column("recipe", sa.Text),
        sa.Column("poses", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.ForeignKeyConstraint(["recipe"], ["recipes.digest"], name=op.f("fk_object_sets_recipe_recipes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_object_sets")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_object_sets_key"), "object_sets", ["key"])


def downgrade() -> None:
    for table in ("object_sets", "object_facts", "object_places"):
        column = {"object_sets": "key", "object_facts": "object", "object_places": "scene"}[table]
        op.drop_index(op.f(f"ix_{table}_{column}"), table_name=table)
        op.drop_table(table)
    op.drop_table("objects")
