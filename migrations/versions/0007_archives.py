"""Groups of arrays are archives: no table changes, but gsmap before this cannot read what is written from here on."""

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Groups that are folders of a file for every key stay as they are."""


def downgrade() -> None:
    """Groups that are archives stay as they are, and older releases call them damaged."""
