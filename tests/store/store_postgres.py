"""A PostgreSQL server of our own, on a socket in a folder of /tmp; gone afterwards."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path


class NoServer(Exception):
    """Why none can be started here."""


@contextlib.contextmanager
def running_server() -> Iterator[str]:
    """The URL of its databases, with ``{}`` in place of the name.

    Raises:
        NoServer: its programs, or a user to run it as, are missing.
    """
    initdb, server_ctl = _binary("initdb"), _binary("pg_ctl")
    if initdb is None or server_ctl is None:
        raise NoServer("needs a PostgreSQL server's programs (initdb, pg_ctl)")
    folder = Path("/tmp") / f"gsmap-pg-{os.getpid()}"  # a socket's path is at most 107 bytes long
    folder.mkdir()
    as_user = {}
    if os.getuid() == 0:  # the server refuses to run as root
        import pwd

        try:
            account = pwd.getpwnam("postgres")
        except KeyError:
            folder.rmdir()
            raise NoServer("running as root and there is no user postgres to run the server as") from None
        os.chown(folder, account.pw_uid, account.pw_gid)
        as_user = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": [], "cwd": folder}

    def run(*command: str) -> None:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, **as_user)
        assert done.returncode == 0, done.stdout + done.stderr

    data, log = str(folder / "data"), str(folder / "log")
    try:
        run(initdb, "-D", data, "-U", "gsmap", "-A", "trust", "--no-sync")
        rules = folder / "data" / "pg_hba.conf"  # one database wants a password
        rules.write_text("local guarded all scram-sha-256\n" + rules.read_text())
        run(server_ctl, "-D", data, "-l", log, "-w", "-o", f"-k {folder} -c listen_addresses=''", "start")
        yield f"postgresql+psycopg://gsmap@/{{}}?host={folder}"
        run(server_ctl, "-D", data, "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def make_database(url: str, name: str) -> str:
    """An empty database on the server; its URL."""
    from sqlalchemy import create_engine, text

    admin = create_engine(url.format("postgres"), isolation_level="AUTOCOMMIT")
    with admin.connect() as connection:
        connection.execute(text(f"DROP DATABASE IF EXISTS {name} WITH (FORCE)"))
        connection.execute(text(f"CREATE DATABASE {name}"))
    admin.dispose()
    return url.format(name)


def _binary(name: str) -> str | None:
    places = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]
    found = [str(p / name) for p in places if (p / name).exists()]
    return found[0] if found else shutil.which(name)
