"""Rows and reports: one frozen dataclass for everything that a map returns.

Each is defined once. Its fields are what Python reads and, by the same names, the keys of the JSON that ``--json``
prints; ``columns`` says which of them a table shows, and under which headings; ``Args:`` says what each means
(docs/reference/json.md is generated from it).

Ids and names go together under the same keys everywhere: ``scene`` and ``scene_name``, ``target`` and ``target_name``,
``source`` and ``source_name``. Only `SceneRow`, which is the scene, calls them ``id`` and ``name``.

A row is imported from its module (``from gsmap.types.rows.scenes import SceneRow``), so that a verb creates only the
classes that it prints: all of them take longer than most verbs.
"""
