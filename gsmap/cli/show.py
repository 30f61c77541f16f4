"""gsmap show: everything known about one thing."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from gsmap.cli.console import AsJson, MapPath, print_json, print_table, say


def command(
    map: MapPath,
    thing: Annotated[str, typer.Argument(metavar="SCENE|A:B", help="A scene, or a pair of scenes.")],
    json: AsJson = False,
    picture: Annotated[
        str | None, typer.Option("--picture", help="Also draw the scene's graph over a render, to this .png file.")
    ] = None,
) -> None:
    """Show everything known about one scene or one pair.

    Example: `gsmap show site.gsmap monday --picture monday.png`
    """
    import gsmap

    with gsmap.open(map) as m:
        facts = m.show_pair(thing) if ":" in thing else m.show_scene(thing)
        if picture:
            m.draw_graph(thing, picture)
            say(f"wrote {picture}")
    if json:
        print_json(facts)
        return
    tables = {k: v for k, v in facts.items() if isinstance(v, list) and v and isinstance(v[0], dict)}
    print_table(thing, ["what", "value"], [[k, _text(v)] for k, v in facts.items() if k not in tables])
    for title, rows in tables.items():
        columns = list(rows[0])
        print_table(title, columns, [[_text(row.get(c)) for c in columns] for row in rows])


def _text(value: Any) -> Any:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        if value and isinstance(value[0], (list, tuple)):
            return "\n".join(" ".join(f"{x: .5g}" for x in row) for row in value)
        return ", ".join(str(_text(v)) for v in value)
    return f"{value:.5g}" if isinstance(value, float) else value
