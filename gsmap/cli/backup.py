"""gsmap backup: save a map, while it is in use."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say

Dest = Annotated[
    str,
    typer.Argument(
        metavar="DEST",
        help="The backup: a folder, `file:///FOLDER` or `s3://BUCKET/PREFIX`, of one map alone.",
        show_default=False,
    ),
]


def command(
    map: MapPath,
    dest: Dest,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read again all that is there; send again what is damaged.")
    ] = False,
    keep: Annotated[
        int | None, typer.Option("--keep", metavar="N", help="Then delete all but the newest N snapshots.")
    ] = None,
    list: Annotated[
        bool, typer.Option("--list", help="Save nothing: list the snapshots. MAP need not exist any more.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Save the map as it is now, while others go on writing to it. Only what the backup lacks is sent.

    Of the map the catalog and what is sent are read; where those are damaged, nothing is saved. Damage that came to
    files after they were sent is found by `gsmap check` alone, and the backup keeps the sound bytes. Exit code 1 where
    `--verify` finds damage in the backup that the map cannot mend. S3 is reached as `AWS_ACCESS_KEY_ID`,
    `AWS_SECRET_ACCESS_KEY`, `AWS_REGION` and `AWS_ENDPOINT_URL` say.

    Example: `gsmap backup site.gsmap /mnt/backup/site --keep 30`
    """
    if list:
        from gsmap.map import snapshots

        if verify or keep is not None:
            raise typer.BadParameter("--list saves, verifies and deletes nothing: give it alone")
        print_rows("backup --list", snapshots(dest), json, "snapshots")
        return
    with opened(map, bars=True) as m:
        report = m.backup(dest, verify=verify, keep=keep)
    if json:
        print_rows("backup", report, json)
    else:
        for problem in report.problems:
            print(problem)
    for note in report.notes:
        say(note)
    done = report.snapshot
    say(
        f"snapshot {done.snapshot}: {done.num_files} files, {done.num_bytes / 1e6:.1f} MB, "
        f"of which {done.num_bytes_new / 1e6:.1f} MB are new"
    )
    if report.deleted:
        say(f"deleted {len(report.deleted)} older snapshots; freed {report.num_bytes_freed / 1e6:.1f} MB")
    if report.problems:
        raise typer.Exit(1)
