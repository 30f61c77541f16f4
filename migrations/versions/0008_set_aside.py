"""Jobs that ended the processes they ran in, and are left out until a person asks for them."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "set_aside",
        sa.Column("what", sa.Text, nullable=False),
        sa.Column("about", sa.Text, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("what", name=op.f("pk_set_aside")),
        sqlite_strict=True,
    )


def downgrade() -> None:
    op.drop_table("set_aside")
