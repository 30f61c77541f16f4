"""Recipes of results, reviews instead of verdicts, facts of scenes, one row for what became of an edge."""

import json
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_PROVENANCE = ("method", "batch_scenes", "measured", "contradicted_priors")
_WITH_RECIPE = ("graphs", "registrations", "revisions", "tiles")
# Old word, new word: of proposers, of evidence, of layers.
_PROPOSERS = {"landmarks": "graph:landmarks", "objects": "graph:objects", "dense": "kiss_matcher"}
_EVIDENCE = {"contradiction": "free_space_violation"}
_LAYERS = {"unlevelled": "landmarks_gravity_free"}


def upgrade() -> None:
    op.create_table(
        "recipes",
        sa.Column("digest", sa.Text, nullable=False),
        sa.Column("stage", sa.Text, nullable=False),
        sa.Column("method", sa.Text, nullable=False),
        sa.Column("version", sa.Text, nullable=False),
        sa.Column("settings", sa.Text, nullable=False),
        sa.Column("backend", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_recipes")),
        sqlite_strict=True,
    )
    for table in _WITH_RECIPE:
        _add(table, f"recipe TEXT CONSTRAINT fk_{table}_recipe_recipes REFERENCES recipes (digest)")
    _upgrade_scenes()
    _upgrade_graphs()
    _upgrade_registrations()
    _upgrade_revisions()
    _add("tiles", "older_recipe TEXT")
    _add("tiles", "notes TEXT NOT NULL DEFAULT '[]'")
    op.execute("UPDATE tiles SET older_recipe = method")
    op.execute("ALTER TABLE tiles DROP COLUMN method")


def downgrade() -> None:
    _add("tiles", "method TEXT NOT NULL DEFAULT ''")
    op.execute("UPDATE tiles SET method = COALESCE(older_recipe, '')")
    for column in ("older_recipe", "notes"):
        op.execute(f"ALTER TABLE tiles DROP COLUMN {column}")
    _downgrade_revisions()
    _downgrade_registrations()
    _downgrade_graphs()
    op.drop_table("scene_facts")
    for table in _WITH_RECIPE:
        _drop_reference(table, "recipe")
    op.drop_table("recipes")


def _upgrade_scenes() -> None:
    op.create_table(
        "scene_facts",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("value", sa.Text, nullable=False),
        sa.Column("author", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("kind in ('name', 'captured_at', 'note', 'tag', 'untag')", name=op.f("ck_scene_facts_kind")),
        sa.ForeignKeyConstraint(["scene"], ["scenes.id"], name=op.f("fk_scene_facts_scene_scenes")),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_scene_facts")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_scene_facts_scene"), "scene_facts", ["scene"], unique=False)
    for kind in ("name", "captured_at"):  # what was said when they were ingested
        op.execute(
            "INSERT INTO scene_facts (scene, kind, value, author, created_at) "
            f"SELECT id, '{kind}', {kind}, '', ingested_at FROM scenes WHERE {kind} IS NOT NULL ORDER BY number"
        )


def _upgrade_graphs() -> None:
    op.execute("ALTER TABLE graphs DROP COLUMN method")
    _rename_in_graphs(_LAYERS, "method", "descriptor_id")


def _downgrade_graphs() -> None:
    _add("graphs", "method TEXT NOT NULL DEFAULT ''")
    op.execute("UPDATE graphs SET method = key")
    _rename_in_graphs({new: old for old, new in _LAYERS.items()}, "descriptor_id", "method")


def _rename_in_graphs(layers: dict[str, str], field: str, new_field: str) -> None:
    changed = []
    for row in _rows("SELECT key, about FROM graphs"):
        about = json.loads(row.about)
        renamed = {}
        for name, layer in about["layers"].items():
            stem, *rest = name.split(":", 1)
            layer["rest"] = {new_field if part == field else part: value for part, value in layer["rest"].items()}
            renamed[":".join([layers.get(stem, stem), *rest])] = layer
        changed.append({"key": row.key, "about": _json(about | {"layers": renamed})})
    _run("UPDATE graphs SET about = :about WHERE key = :key", changed)


def _upgrade_registrations() -> None:
    _add(
        "registrations",
        "adopts INTEGER CONSTRAINT fk_registrations_adopts_registrations REFERENCES registrations (number)",
    )
    _add("registrations", "notes TEXT NOT NULL DEFAULT '[]'")
    op.execute("ALTER TABLE registrations RENAME COLUMN method TO proposer")
    _rename_in_registrations(_PROPOSERS, _EVIDENCE)
    op.create_table(
        "reviews",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("pair", sa.Text, nullable=False),
        sa.Column("review", sa.Text, nullable=False),
        sa.Column("registration", sa.Integer, nullable=False),
        sa.Column("note", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("review in ('confirm', 'reject', 'withdraw')", name=op.f("ck_reviews_review")),
        sa.ForeignKeyConstraint(
            ["registration"], ["registrations.number"], name=op.f("fk_reviews_registration_registrations")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_reviews")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_reviews_pair"), "reviews", ["pair"], unique=False)
    _move("verdicts", "verdict", "reviews", "review")
    op.drop_table("verdicts")


def _downgrade_registrations() -> None:
    op.create_table(
        "verdicts",
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("pair", sa.Text, nullable=False),
        sa.Column("verdict", sa.Text, nullable=False),
        sa.Column("registration", sa.Integer, nullable=False),
        sa.Column("note", sa.Text, nullable=False),
        sa.Column("created_at", sa.Text, nullable=False),
        sa.CheckConstraint("verdict in ('confirm', 'reject', 'withdraw')", name=op.f("ck_verdicts_verdict")),
        sa.ForeignKeyConstraint(
            ["registration"], ["registrations.number"], name=op.f("fk_verdicts_registration_registrations")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_verdicts")),
        sqlite_strict=True,
    )
    op.create_index(op.f("ix_verdicts_pair"), "verdicts", ["pair"], unique=False)
    _move("reviews", "review", "verdicts", "verdict")
    op.drop_table("reviews")
    back = [{new: old for old, new in names.items()} for names in (_PROPOSERS, _EVIDENCE)]
    _rename_in_registrations(*back)
    op.execute("ALTER TABLE registrations RENAME COLUMN proposer TO method")
    op.execute("ALTER TABLE registrations DROP COLUMN notes")
    _drop_reference("registrations", "adopts")


def _rename_in_registrations(proposers: dict[str, str], evidence: dict[str, str]) -> None:
    changed = []
    for row in _rows("SELECT number, proposer, evidence FROM registrations"):
        figures = {evidence.get(name, name): value for name, value in json.loads(row.evidence).items()}
        new = {"proposer": proposers.get(row.proposer, row.proposer), "evidence": _json(figures)}
        changed.append({"number": row.number} | new)
    _run("UPDATE registrations SET proposer = :proposer, evidence = :evidence WHERE number = :number", changed)


def _upgrade_revisions() -> None:
    _add("revisions", "key TEXT NOT NULL DEFAULT ''")
    _add("revisions", "settings TEXT NOT NULL DEFAULT '{}'")
    _add("revisions", "provenance TEXT NOT NULL DEFAULT '{}'")
    _add("revisions", "notes TEXT NOT NULL DEFAULT '[]'")
    _add(
        "edges",
        "use TEXT NOT NULL DEFAULT 'unused' CONSTRAINT ck_edges_use CHECK (use IN ('used', 'tentative', 'unused'))",
    )
    _add("edges", "undecided INTEGER NOT NULL DEFAULT 0")
    op.execute("ALTER TABLE edges RENAME COLUMN residual TO residual_chi2")
    op.execute("ALTER TABLE edges RENAME COLUMN reason TO old_reason")
    _add("edges", "reason TEXT NOT NULL DEFAULT ''")
    op.execute("UPDATE edges SET reason = COALESCE(old_reason, '')")
    op.execute("UPDATE edges SET use = 'used' WHERE used = 'true'")
    op.execute("UPDATE edges SET use = 'tentative' WHERE used = '\"tentative\"'")
    changed, doubtful = [], []
    for row in _rows("SELECT number, parameters, undecided FROM revisions"):
        settings = json.loads(row.parameters)
        key = str(settings.pop("inputs", ""))
        provenance = {name: settings.pop(name) for name in _PROVENANCE if name in settings}
        new = {"key": key, "settings": _json(settings), "provenance": _json(provenance)}
        changed.append({"number": row.number} | new)
        doubtful += [{"revision": row.number, "a": a, "b": b} for a, b in json.loads(row.undecided)]
    _run(
        "UPDATE revisions SET key = :key, settings = :settings, provenance = :provenance WHERE number = :number",
        changed,
    )
    _run("UPDATE edges SET undecided = 1 WHERE revision = :revision AND target = :a AND source = :b", doubtful)
    for table, column in (
        ("edges", "used"),
        ("edges", "old_reason"),
        ("revisions", "parameters"),
        ("revisions", "undecided"),
    ):
        op.execute(f"ALTER TABLE {table} DROP COLUMN {column}")


def _downgrade_revisions() -> None:
    _add("revisions", "parameters TEXT NOT NULL DEFAULT '{}'")
    _add("revisions", "undecided TEXT NOT NULL DEFAULT '[]'")
    doubtful: dict[int, list[list[str]]] = {}
    for row in _rows("SELECT revision, target, source FROM edges WHERE undecided = 1"):
        doubtful.setdefault(row.revision, []).append([row.target, row.source])
    changed = []
    for row in _rows("SELECT number, key, settings, provenance FROM revisions"):
        parameters = json.loads(row.settings) | json.loads(row.provenance) | ({"inputs": row.key} if row.key else {})
        new = {"parameters": _json(parameters), "undecided": _json(doubtful.get(row.number, []))}
        changed.append({"number": row.number} | new)
    _run("UPDATE revisions SET parameters = :parameters, undecided = :undecided WHERE number = :number", changed)
    for column in ("key", "settings", "provenance", "notes"):
        op.execute(f"ALTER TABLE revisions DROP COLUMN {column}")
    _add("edges", "used TEXT")
    op.execute(
        "UPDATE edges SET used = CASE use WHEN 'used' THEN 'true' WHEN 'unused' THEN 'false' ELSE '\"tentative\"' END"
    )
    op.execute("ALTER TABLE edges RENAME COLUMN residual_chi2 TO residual")
    op.execute("ALTER TABLE edges RENAME COLUMN reason TO new_reason")
    _add("edges", "reason TEXT")
    op.execute("UPDATE edges SET reason = NULLIF(new_reason, '')")
    for column in ("use", "new_reason", "undecided"):
        op.execute(f"ALTER TABLE edges DROP COLUMN {column}")


def _add(table: str, column: str) -> None:
    op.execute(f"ALTER TABLE {table} ADD COLUMN {column}")


def _drop_reference(table: str, column: str) -> None:
    """Drop a column that refers to another table; SQLite rebuilds the table for it, and forgets its checks."""
    status = sa.CheckConstraint("status in ('accepted', 'rejected', 'no_match')", name=op.f("ck_registrations_status"))
    kept = (status,) if table == "registrations" else ()
    with op.batch_alter_table(table, table_kwargs={"sqlite_strict": True}, table_args=kept) as batch:
        batch.drop_column(column)


def _move(old: str, old_column: str, new: str, new_column: str) -> None:
    """Rows of one table of words to the other; on PostgreSQL its sequence goes on after them."""
    same = "number, pair, registration, note, created_at"
    op.execute(f"INSERT INTO {new} ({same}, {new_column}) SELECT {same}, {old_column} FROM {old}")
    if op.get_bind().dialect.name == "postgresql":
        last = f"SELECT MAX(number) FROM {new}"
        op.execute(f"SELECT setval(pg_get_serial_sequence('{new}', 'number'), COALESCE(({last}), 0) + 1, false)")


def _rows(query: str) -> Sequence[sa.Row[Any]]:
    return op.get_bind().execute(sa.text(query)).all()


def _run(statement: str, rows: list[dict[str, Any]]) -> None:
    if rows:
        op.get_bind().execute(sa.text(statement), rows)


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
