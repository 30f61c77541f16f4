"""gsmap backup: save a map while it is in use."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Branches and backups", 6
OUTPUTS = {"backup": Output("backups.BackupReport"), "backup --list": Output("backups.SnapshotRow", "snapshots")}
Dest = Annotated[
    str,
    typer.Argument(
        metavar="DEST",
        help="Backup folder, `file:///FOLDER` or `s3://BUCKET/PREFIX`; it holds the snapshots of one map.",
        show_default=False,
    ),
]


def command(
    map: MapPath,
    dest: Dest,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read every stored byte again, and send damaged files again.")
    ] = False,
    keep: Annotated[
        int | None,
        typer.Option("--keep", metavar="N", help="After the backup, delete all snapshots except the newest N."),
    ] = None,
    list: Annotated[
        bool, typer.Option("--list", help="Only list the snapshots and save nothing; MAP may be missing.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Save the map as it is now, while other processes may write to it. Only files that the backup lacks are sent.

    The command reads the catalog and the files to send; if one of them is damaged, it saves nothing. A branch whose
    catalog is damaged is left out, and no older snapshot is deleted. Files that were damaged after they had been sent
    are found by `gsmap check`, and the backup keeps their sound bytes. Exit code 1 if a branch was left out, if
    `--verify` finds damage that the map cannot repair, or if `--list` finds a damaged snapshot. For S3, set
    `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION` and `AWS_ENDPOINT_URL`.

    Example: `gsmap backup site.gsmap /mnt/backup/site --keep 30`
    """
    if list:
        from gsmap.map.backups import snapshots

        if verify or keep is not None:
            raise typer.BadParameter("--list cannot be combined with --verify or --keep")
        rows, problems = snapshots(dest)
        print_rows("backup --list", rows, json, "snapshots")
        for problem in problems:
            say(problem)
        if problems:
            raise typer.Exit(1)
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
