import multiprocessing
import shutil
import tempfile
from pathlib import Path

import pytest
from store_postgres import NoServer, make_database, running_server
from store_samples import make_cameras, make_gaussians
from store_swift import Swift, why_not

from gsmap.store import Store, migrate, schema
from tools.check import flips as check_flips


@pytest.fixture
def store(tmp_path):
    with Store.create(tmp_path / "site.gsmap") as made:
        yield made


@pytest.fixture
def closed(tmp_path):
    """A closed map of two scenes with free pages in its catalog."""
    path = tmp_path / "site.gsmap"
    check_flips.make_map(path)
    return path


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


@pytest.fixture(scope="session")
def server():
    """A server that speaks S3, with an empty bucket."""
    pytest.importorskip("obstore")
    folder = Path(tempfile.mkdtemp(prefix="gsmap-s3-"))
    reason = why_not(folder)
    try:
        if reason:
            pytest.skip(reason)
        with Swift(folder) as swift:
            swift.make_bucket()
            yield swift
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_url():
    pytest.importorskip("psycopg")
    try:
        with running_server() as url:
            yield url
    except NoServer as reason:
        pytest.skip(str(reason))


@pytest.fixture
def postgres_database(postgres_url):
    return make_database(postgres_url, "site")


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


@pytest.fixture
def keep_schema(monkeypatch):
    """Undo what `next_schema.install` does."""
    monkeypatch.setattr(migrate, "folder", migrate.folder)
    monkeypatch.setattr(schema, "HEAD", schema.HEAD)
