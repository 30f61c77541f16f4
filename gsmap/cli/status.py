"""gsmap status: show the open tasks of a map."""

from __future__ import annotations

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, print_table

PANEL = "Map", 7
OUTPUTS = {"status": Output("maps.MapStatus")}
_SHOWN = 4  # number of components whose metric scale is printed, largest first


def command(map: MapPath, json: AsJson = False) -> None:
    """Show missing and stale results and open reviews, each with the command to run.

    Example: `gsmap status site.gsmap`
    """
    from gsmap.types.metric_scale import MetricScale, as_known_by

    with opened(map) as m:
        report = m.status()
    if json:
        print_rows("status", report, json)
        return
    if report.todo:
        print_table("to do", report.todo[0].columns, report.todo)
    components = f"{report.components} component{'s' * (report.components != 1)}"
    whole = [
        row for row in report.at_work if row.what.split(" ")[0] not in ("graph", "edge", "comparison")
    ]  # without single jobs
    if whole:
        print_table("at work", whole[0].columns, whole)
    print(
        f"{report.scenes} scenes in {components}, {report.one_pair} placed by one pair, "
        f"{report.tentative - report.one_pair} in doubt; "
        + ("no revision yet" if report.revision is None else f"revision {report.revision}")
        + ("" if report.todo else "; nothing to do")
    )
    for row in report.metres[:_SHOWN]:
        metre = MetricScale(row.metres_per_unit, row.metre_sigma or float("inf"), as_known_by(row.metre_known_by))
        print(f"component {row.component}: {metre.text()}" + (f" ({row.metre_note})" if row.metre_note else ""))
    if len(report.metres) > _SHOWN:
        print(f"... and {len(report.metres) - _SHOWN} more components: gsmap status MAP --json")
