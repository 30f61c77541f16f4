"""A map that grows: groups are archives, retrieval keeps an index, poses and what became of edges are kept once for all
revisions that share them and their numbers are bytes, and jobs that end their process are set aside.

Groups that are folders of a file for every key stay as they are. Older gsmap cannot read archives.
"""

import json
import struct
from collections import Counter
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy import bindparam, text

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_COUNTS = ("num_scenes", "num_placed", "num_components", "num_used", "num_tentative", "num_unused", "num_undecided")
_USES = "use in ('used', 'tentative', 'unused')"
_TABLES = {
    "poses": (("scene",), ("S_map_scene", "component", "status", "covariance")),
    "edges": (("target", "source"), ("use", "residual_chi2", "reason", "undecided")),
}
_BATCH = 1000


def upgrade() -> None:
    _tables_of_retrieval()
    _table_of_what_is_set_aside()
    connection = op.get_bind()
    for name in _COUNTS:
        op.execute(f"ALTER TABLE revisions ADD COLUMN {name} INTEGER NOT NULL DEFAULT 0")
    for name in _TABLES:
        op.rename_table(name, f"older_{name}")
    if op.get_context().dialect.name != "sqlite":  # whose names of constraints are each table's own
        for name, ends in (("poses", ("revision", "scene")), ("edges", ("revision", "target", "source"))):
            op.execute(f"ALTER TABLE older_{name} DROP CONSTRAINT pk_{name} CASCADE")
            for end in ends:
                to = "revisions" if end == "revision" else "scenes"
                op.execute(f"ALTER TABLE older_{name} DROP CONSTRAINT fk_{name}_{end}_{to}")
        op.execute("ALTER TABLE older_edges DROP CONSTRAINT ck_edges_use")
    _tables_of_differences()
    _write_differences(connection)
    for name in _TABLES:
        op.drop_table(f"older_{name}")
    _retype(connection, "S_target_source", _of_pose)
    _retype(connection, "information", _of_matrix)
    for name in ("target", "source"):
        op.create_index(op.f(f"ix_registrations_{name}"), "registrations", [name])


def downgrade() -> None:
    connection = op.get_bind()
    for name in ("target", "source"):
        op.drop_index(op.f(f"ix_registrations_{name}"), table_name="registrations")
    _retype(connection, "S_target_source", _to_pose, "TEXT")
    _retype(connection, "information", _to_matrix, "TEXT")
    numbers = connection.execute(text("SELECT number FROM revisions ORDER BY number")).scalars().all()
    whole = {name: [_whole(connection, name, number) for number in numbers] for name in _TABLES}
    for name in _TABLES:
        op.drop_table(name)
    _tables_of_whole_revisions()
    for name, (ends, values) in _TABLES.items():
        columns = ("revision", *ends, *values)
        places = ", ".join(f":{column}" for column in columns)
        query = text(f"INSERT INTO {name} ({', '.join(_quoted(columns))}) VALUES ({places})")
        for rows in whole[name]:
            if rows:
                connection.execute(query, [dict(zip(columns, row, strict=True)) for row in rows])
    for name in _COUNTS:
        op.execute(f"ALTER TABLE revisions DROP COLUMN {name}")
    op.drop_table("set_aside")
    op.drop_table("lookups")
    op.execute("DELETE FROM files WHERE group_id IN (SELECT group_id FROM index_segments)")
    op.drop_table("index_segments")
    op.execute("DELETE FROM groups WHERE kind = 'indexes'")


# --- tables ----------------------------------------------------------------------------------------------------------


def _tables_of_retrieval() -> None:
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


def _table_of_what_is_set_aside() -> None:
    op.create_table(
        "set_aside",
        sa.Column("what", sa.Text, nullable=False),
        sa.Column("about", sa.Text, nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("what", name=op.f("pk_set_aside")),
        sqlite_strict=True,
    )


def _tables_of_differences() -> None:
    real = sa.Double().with_variant(sa.REAL(), "sqlite")
    op.create_table(
        "poses",
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("since", sa.Integer, nullable=False),
        sa.Column("until", sa.Integer),
        sa.Column("S_map_scene", sa.LargeBinary),
        sa.Column("component", sa.Integer, nullable=False),
        sa.Column("status", sa.Text, nullable=False),
        sa.Column("covariance", sa.LargeBinary),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_poses_scene_scenes")),
        sa.ForeignKeyConstraint(["since"], ["revisions.number"], name=op.f("fk_poses_since_revisions")),
        sa.ForeignKeyConstraint(["until"], ["revisions.number"], name=op.f("fk_poses_until_revisions")),
        sa.PrimaryKeyConstraint("scene", "since", name=op.f("pk_poses")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_poses_until"), "poses", ["until"])
    op.create_table(
        "edges",
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("since", sa.Integer, nullable=False),
        sa.Column("until", sa.Integer),
        sa.Column("use", sa.Text, nullable=False, server_default="unused"),
        sa.Column("residual_chi2", real),
        sa.Column("reason", sa.Text, nullable=False, server_default=""),
        sa.Column("undecided", sa.Integer, nullable=False, server_default="0"),
        sa.CheckConstraint(_USES, name=op.f("ck_edges_use")),
        sa.ForeignKeyConstraint(["target"], ["scenes.id"], name=op.f("fk_edges_target_scenes")),
        sa.ForeignKeyConstraint(["source"], ["scenes.id"], name=op.f("fk_edges_source_scenes")),
        sa.ForeignKeyConstraint(["since"], ["revisions.number"], name=op.f("fk_edges_since_revisions")),
        sa.ForeignKeyConstraint(["until"], ["revisions.number"], name=op.f("fk_edges_until_revisions")),
        sa.PrimaryKeyConstraint("target", "source", "since", name=op.f("pk_edges")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_edges_until"), "edges", ["until"])


def _tables_of_whole_revisions() -> None:
    real = sa.Double().with_variant(sa.REAL(), "sqlite")
    op.create_table(
        "poses",
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("S_map_scene", sa.Text),
        sa.Column("component", sa.Integer, nullable=False),
        sa.Column("status", sa.Text, nullable=False),
        sa.Column("covariance", sa.Text),
        sa.ForeignKeyConstraint(["revision"], ["revisions.number"], name=op.f("fk_poses_revision_revisions")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_poses_scene_scenes")),
        sa.PrimaryKeyConstraint("revision", "scene", name=op.f("pk_poses")),
        sqlite_strict=True,
    )
    op.create_table(
        "edges",
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("residual_chi2", real),
        sa.Column("reason", sa.Text, nullable=False, server_default=""),
        sa.Column("undecided", sa.Integer, nullable=False, server_default="0"),
        sa.ForeignKeyConstraint(["revision"], ["revisions.number"], name=op.f("fk_edges_revision_revisions")),
        sa.ForeignKeyConstraint(["target"], ["scenes.id"], name=op.f("fk_edges_target_scenes")),
        sa.ForeignKeyConstraint(["source"], ["scenes.id"], name=op.f("fk_edges_source_scenes")),
        sa.PrimaryKeyConstraint("revision", "target", "source", name=op.f("pk_edges")),
        sqlite_strict=True,
    )
    # With a check of its own, so that the column can go again.
    op.execute(
        f"ALTER TABLE edges ADD COLUMN use TEXT NOT NULL DEFAULT 'unused' CONSTRAINT ck_edges_use CHECK ({_USES})"
    )


# --- revisions -------------------------------------------------------------------------------------------------------


def _write_differences(connection: sa.Connection) -> None:
    numbers = connection.execute(text("SELECT number FROM revisions ORDER BY number")).scalars().all()
    standing: dict[str, dict[tuple[Any, ...], tuple[int, tuple[Any, ...]]]] = {name: {} for name in _TABLES}
    for number in numbers:
        found = {name: _older_lines(connection, name, number) for name in _TABLES}
        for name in _TABLES:
            _put(connection, name, number, found[name], standing[name])
        counts = _counts(found["poses"].values(), found["edges"].values())
        row = dict(zip(_COUNTS, counts, strict=True)) | {"number": number}
        named = ", ".join(f"{column} = :{column}" for column in _COUNTS)
        connection.execute(text(f"UPDATE revisions SET {named} WHERE number = :number"), row)


def _older_lines(connection: sa.Connection, name: str, number: int) -> dict[tuple[Any, ...], tuple[Any, ...]]:
    ends, values = _TABLES[name]
    query = text(f"SELECT {', '.join((*ends, *_quoted(values)))} FROM older_{name} WHERE revision = :number")
    rows = connection.execute(query, {"number": number})
    return {tuple(row[: len(ends)]): tuple(row[len(ends) :]) for row in rows}


def _put(
    connection: sa.Connection,
    name: str,
    number: int,
    found: dict[tuple[Any, ...], tuple[Any, ...]],
    standing: dict[tuple[Any, ...], tuple[int, tuple[Any, ...]]],
) -> None:
    """Write what differs from the revision before; texts are compared as they lie."""
    ends, values = _TABLES[name]
    ended = [key for key, (_, before) in standing.items() if found.get(key) != before]
    begun = [key for key, now in found.items() if key not in standing or standing[key][1] != now]
    if ended:
        where = " AND ".join(f"{column} = :{column}" for column in (*ends, "since"))
        rows = [dict(zip((*ends, "since"), (*key, standing[key][0]), strict=True)) | {"n": number} for key in ended]
        connection.execute(text(f"UPDATE {name} SET until = :n WHERE {where}"), rows)
    for key in ended:
        del standing[key]
    columns = (*ends, "since", *values)
    query = text(f"INSERT INTO {name} ({', '.join(_quoted(columns))}) VALUES ({', '.join(f':{c}' for c in columns)})")
    if name == "poses":
        query = query.bindparams(*(bindparam(c, type_=sa.LargeBinary) for c in ("S_map_scene", "covariance")))
    for start in range(0, len(begun), _BATCH):
        rows = []
        for key in begun[start : start + _BATCH]:
            line = found[key]
            standing[key] = (number, line)
            if name == "poses":
                line = (_of_pose(line[0]), line[1], line[2], _of_covariance(line[3]))
            rows.append(dict(zip(columns, (*key, number, *line), strict=True)))
        connection.execute(query, rows)


def _whole(connection: sa.Connection, name: str, number: int) -> list[tuple[Any, ...]]:
    ends, values = _TABLES[name]
    query = text(
        f"SELECT {', '.join((*ends, *_quoted(values)))} FROM {name} WHERE since <= :number AND "
        "(until IS NULL OR until > :number)"
    )
    rows = [(number, *row) for row in connection.execute(query, {"number": number})]
    if name == "poses":
        rows = [(*row[:2], _to_pose(row[2]), *row[3:5], _to_covariance(row[5])) for row in rows]
    return rows


def _counts(placed: Any, outcomes: Any) -> tuple[int, ...]:
    placed, outcomes = list(placed), list(outcomes)
    uses = Counter(outcome[0] for outcome in outcomes)
    return (
        len(placed),
        sum(row[0] is not None for row in placed),
        len({row[1] for row in placed}),
        uses["used"],
        uses["tentative"],
        uses["unused"],
        sum(outcome[3] for outcome in outcomes),
    )


def _quoted(columns: tuple[str, ...]) -> tuple[str, ...]:
    """PostgreSQL makes names small that are not quoted."""
    return tuple(f'"{column}"' for column in columns)


# --- numbers ---------------------------------------------------------------------------------------------------------


def _retype(connection: sa.Connection, column: str, convert: Any, kind: str | None = None) -> None:
    """Give a column of the registrations another type, and its values another form."""
    made = kind or ("BLOB" if op.get_context().dialect.name == "sqlite" else "BYTEA")
    op.execute(f'ALTER TABLE registrations ADD COLUMN "new_{column}" {made}')
    query = text(f'UPDATE registrations SET "new_{column}" = :value WHERE number = :number')
    if kind is None:
        query = query.bindparams(bindparam("value", type_=sa.LargeBinary))
    after = 0
    while True:
        some = text(
            f'SELECT number, "{column}" AS value FROM registrations WHERE "{column}" IS NOT NULL AND number > :after '
            "ORDER BY number LIMIT :many"
        )
        rows = connection.execute(some, {"after": after, "many": _BATCH}).all()
        if not rows:
            break
        after = rows[-1].number
        connection.execute(query, [{"number": row.number, "value": convert(row.value)} for row in rows])
    op.execute(f'ALTER TABLE registrations DROP COLUMN "{column}"')
    op.execute(f'ALTER TABLE registrations RENAME COLUMN "new_{column}" TO "{column}"')


def _of_pose(value: str | None) -> bytes | None:
    if value is None:
        return None
    pose = json.loads(value)
    return _packed([*(x for row in pose["rotation"] for x in row), *pose["translation"], pose["scale"]])


def _to_pose(value: bytes | None) -> str | None:
    if value is None:
        return None
    numbers = _unpacked(value)
    rotation = [numbers[i : i + 3] for i in (0, 3, 6)]
    return json.dumps({"rotation": rotation, "translation": numbers[9:12], "scale": numbers[12]}, separators=(",", ":"))


def _of_matrix(value: str) -> bytes:
    return _packed([x for row in json.loads(value) for x in row])


def _to_matrix(value: bytes) -> str:
    numbers = _unpacked(value)
    return json.dumps([numbers[i : i + 7] for i in range(0, 49, 7)], separators=(",", ":"))


def _of_covariance(value: str | None) -> bytes | None:
    if value is None:
        return None
    return _packed([x for i, row in enumerate(json.loads(value)) for x in row[: i + 1]])


def _to_covariance(value: bytes | None) -> str | None:
    if value is None:
        return None
    numbers, rows = _unpacked(value), [[0.0] * 7 for _ in range(7)]
    for i in range(7):
        for j in range(i + 1):
            rows[i][j] = rows[j][i] = numbers[i * (i + 1) // 2 + j]
    return json.dumps(rows, separators=(",", ":"))


def _packed(numbers: list[float]) -> bytes:
    return struct.pack(f"<{len(numbers)}d", *numbers)


def _unpacked(value: bytes) -> list[float]:
    return list(struct.unpack(f"<{len(value) // 8}d", bytes(value)))
