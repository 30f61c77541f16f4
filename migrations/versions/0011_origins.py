"""Where the origin of a scene's frame lies in the coordinates of its file, for captures in map coordinates."""

from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute("ALTER TABLE scenes ADD COLUMN origin TEXT")


def downgrade() -> None:
    op.execute("ALTER TABLE scenes DROP COLUMN origin")
