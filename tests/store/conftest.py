import multiprocessing
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from store_samples import make_cameras, make_gaussians

from gsmap.store import Store


@pytest.fixture
def store(tmp_path):
    with Store.create(tmp_path / "site.gsmap") as made:
        yield made


@pytest.fixture
def two_scenes(store):
    return [store.scenes.add(make_gaussians(seed=i), make_cameras(), name=f"scene{i}")[0] for i in range(2)]


@pytest.fixture(scope="session")
def context():
    """Processes that start in a moment: the server has imported everything, and has no threads."""
    made = multiprocessing.get_context("forkserver")
    made.set_forkserver_preload(["gsmap.store", "zarr", "zarr.codecs"])
    return made


@pytest.fixture
def start(context):
    started = []

    def run(target, *arguments):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=target, args=(*arguments, theirs))
        process.start()
        theirs.close()
        started.append(process)
        return process, ours

    yield run
    for process in started:
        if process.is_alive():
            process.kill()
        process.join()


def _postgres_binary(name: str) -> str | None:
    places = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]
    found = [str(p / name) for p in places if (p / name).exists()]
    return found[0] if found else shutil.which(name)


@pytest.fixture(scope="session")
def postgres_url(tmp_path_factory):
    """A real server of our own, on a socket in a temporary folder; gone afterwards."""
    pytest.importorskip("psycopg")
    initdb, server_ctl = _postgres_binary("initdb"), _postgres_binary("pg_ctl")
    if initdb is None or server_ctl is None:
        pytest.skip("needs a PostgreSQL server's programs (initdb, pg_ctl)")
    folder = Path("/tmp") / f"gsmap-pg-{os.getpid()}"  # a socket's path is at most 107 bytes long
    folder.mkdir()
    as_user = {}
    if os.getuid() == 0:  # the server refuses to run as root
        import pwd

        try:
            account = pwd.getpwnam("postgres")
        except KeyError:
            folder.rmdir()
            pytest.skip("running as root and there is no user postgres to run the server as")
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


@pytest.fixture
def postgres_database(postgres_url):
    from sqlalchemy import create_engine, text

    admin = create_engine(postgres_url.format("postgres"), isolation_level="AUTOCOMMIT")
    with admin.connect() as connection:
        connection.execute(text("DROP DATABASE IF EXISTS site WITH (FORCE)"))
        connection.execute(text("CREATE DATABASE site"))
    admin.dispose()
    return postgres_url.format("site")


@pytest.fixture
def guarded_database(postgres_url):
    """A database that wants the password ``secret``; the URL has it."""
    from sqlalchemy import create_engine, text

    admin = create_engine(postgres_url.format("postgres"), isolation_level="AUTOCOMMIT")
    with admin.connect() as connection:
        connection.execute(text("ALTER ROLE gsmap PASSWORD 'secret'"))
        connection.execute(text("CREATE DATABASE guarded"))
    admin.dispose()
    return postgres_url.format("guarded").replace("gsmap@", "gsmap:secret@")
