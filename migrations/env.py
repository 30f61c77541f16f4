"""Alembic's entry: runs on the connection `gsmap.store.migrate` hands over, inside its transaction.

To draft a migration after changing `gsmap.store.schema`: ``alembic -x url=sqlite:///some.gsmap/map.sqlite revision
--autogenerate --rev-id 0002 -m "what it does"`` from a checkout (settings in ``pyproject.toml``), then read it, and set
`gsmap.store.schema.HEAD`. Revisions are numbered: gsmap compares them to tell older from newer.
"""

from typing import Any

from alembic import context
from sqlalchemy import Connection, create_engine

from gsmap.store.schema import CHUNK_BOXES, metadata


def ours(name: str | None, kind: str, parents: Any) -> bool:
    """The R*Tree and its shadow tables are no part of the metadata."""
    return not (kind == "table" and name is not None and name.startswith(CHUNK_BOXES))


def run(connection: Connection) -> None:
    context.configure(
        connection=connection,
        target_metadata=metadata,
        render_as_batch=True,
        include_name=ours,
        compare_type=True,
    )
    with context.begin_transaction():
        context.run_migrations()


given = context.config.attributes.get("connection")
if given is not None:
    run(given)
else:
    with create_engine(context.get_x_argument(as_dictionary=True)["url"]).begin() as opened:
        run(opened)
