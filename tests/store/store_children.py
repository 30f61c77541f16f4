"""What the processes do that the crash tests start and kill."""

import errno
import itertools
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from store_samples import key, made_prepared, make_cameras, make_gaussians

from gsmap.store import Store, sqlite
from gsmap.types import PoseGraph, SceneGraph, ScenePose, Sim3

# Every event of the interpreter that changes the disk; writing itself has none, but each file is opened first.
EVENTS = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree", "os.truncate")


def changes_disk(event: str, arguments: tuple) -> bool:
    if event == "open":
        _, mode, flags = arguments
        return bool(set(mode or "") & set("wxa+")) or bool((flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
    return event in EVENTS


def add(store: Store, seed: int) -> str:
    return store.scenes.add(make_gaussians(300, seed=seed), make_cameras(), name=f"scene{seed}")[0].id


def work(path: str, first_seed: int, pipe) -> None:
    """Change the map until killed, telling before and after each step."""
    store = Store.open(path)
    for seed in itertools.count(first_seed):
        pipe.send(("begin", "add", seed))
        scene = add(store, seed)
        pipe.send(("done", "add", scene))
        pipe.send(("begin", "revise", None))
        alive = [s.id for s in store.scenes.list()]
        poses = {s: ScenePose(s, Sim3.identity(), 0, "placed") for s in alive}
        pipe.send(("done", "revise", store.revisions.save(PoseGraph(poses))))
        pipe.send(("begin", "describe", scene))
        store.graphs.save(SceneGraph(scene), key("describe", scene, seed=seed))
        pipe.send(("done", "describe", scene))
        if seed % 2:
            pipe.send(("begin", "remove", alive[0]))
            store.scenes.remove(alive[0])
            pipe.send(("done", "remove", alive[0]))
            pipe.send(("begin", "prune", None))
            store.prune(keep_revisions=1)
            pipe.send(("done", "prune", None))


@contextmanager
def dying_at(step: int, pipe) -> Iterator[None]:
    """Die at the given change of the disk while this is open, and tell where."""
    left = [step]

    def hook(event: str, arguments: tuple) -> None:
        if changes_disk(event, arguments):
            left[0] -= 1
            if left[0] == 0:
                pipe.send(f"died at {event} {arguments[0]}")
                os._exit(9)

    sys.addaudithook(hook)
    yield
    left[0] = -1


def die_at(path: str, seed: int, step: int, pipe) -> None:
    """Add a scene, and die at the given change of the disk; tells where, or that it came through."""
    with Store.open(path) as store, dying_at(step, pipe):
        add(store, seed)
    pipe.send("through")


def fail_at_steps(path: str, code: int, pipe) -> None:
    """Add one scene after another, each failing at a later change of the disk, until one comes through."""
    armed = [0]

    def hook(event: str, arguments: tuple) -> None:
        if armed[0] > 0 and changes_disk(event, arguments) and str(path) in str(arguments[0]):
            armed[0] -= 1
            if armed[0] == 0:
                raise OSError(code, os.strerror(code))

    sys.addaudithook(hook)
    for step in itertools.count(1):
        with Store.open(path) as store:
            before = len(store.scenes.list())
            armed[0] = step
            try:
                add(store, step)
                kind, text = "through", ""
            except BaseException as error:
                kind, text = type(error).__name__, str(error)
            fired, armed[0] = armed[0] <= 0, 0
            pipe.send((step, kind, text, len(store.scenes.list()) - before, store.check().problems))
            if not fired:
                return


def write_some(path: str, worker: int, count: int, pipe) -> None:
    """One of several writers: scenes of its own, one that all share, and revisions."""
    try:
        with Store.open(path) as store:
            for i in range(count):
                add(store, 1000 * (worker + 1) + i)
                add(store, i)
                scene = store.scenes.list()[0].id
                store.revisions.save(PoseGraph({scene: ScenePose(scene, Sim3.identity(), 0, "placed")}))
        pipe.send("done")
    except BaseException as error:
        pipe.send(repr(error))


def read_some(path: str, stop, pipe) -> None:
    """One of several readers: every scene that is listed can be read, and the map never shrinks."""
    try:
        with Store.open(path, "r") as store:
            seen = rounds = 0
            while not stop.is_set() or not rounds:
                scenes = store.scenes.list()
                assert len(scenes) >= seen
                seen, rounds = len(scenes), rounds + 1
                for scene in scenes[-2:]:
                    assert len(store.scenes.gaussians(scene.id)) == 300
        pipe.send("done")
    except BaseException as error:
        pipe.send(repr(error))


def messages(pipe) -> list:
    out = []
    try:
        while pipe.poll(0):
            out.append(pipe.recv())
    except EOFError:
        pass
    return out


CODES = (errno.ENOSPC, errno.EIO)


def fold_often(path: str, worker: int, count: int, pipe) -> None:
    """A writer that folds the log in after every transaction."""
    sqlite.CHECKPOINT_BYTES = 1
    try:
        with Store.open(path) as store:
            for i in range(count):
                store.exports.begin(f"/out/{worker}/{i}", revision=None, settings={"x": "y" * 5000})
        pipe.send("done")
    except BaseException as error:
        pipe.send(repr(error))


def open_often(path: str, mode: str, stop, pipe) -> None:
    """A reader that opens the map, and so compares its pages with their digests, again and again."""
    try:
        rounds = 0
        while not stop.is_set() or not rounds:
            with Store.open(path, mode) as store:
                store.exports.list()
            rounds += 1
        pipe.send(rounds)
    except BaseException as error:
        pipe.send(repr(error))


def open_and_close(path: str, pipe) -> None:
    with Store.open(path) as store:
        pipe.send([scene.name for scene in store.scenes.list()])


def stage_and_save(path: str, step: int, pipe) -> None:
    """Describe a scene as a worker and its caller do, and die at the given change of the disk."""
    with Store.open(path) as store, Store.open(path, "r") as worker:
        scene = store.scenes.list()[0].id
        with dying_at(step, pipe), store.arrays.inbox() as inbox:
            staged = worker.graphs.stage(SceneGraph(scene), key("describe", scene), inbox)
            more = worker.prepared_scenes.stage(made_prepared(scene), key("register", scene), inbox)
            with store.transaction():
                store.graphs.save(staged, key("describe", scene))
                store.prepared_scenes.save(more, key("register", scene))
    pipe.send("through")


def stage_for(path: str, scene: str, inbox: str, pipe) -> None:
    """Stage a graph in the inbox of another process, and end without saying so."""
    with Store.open(path, "r") as worker:
        pipe.send(worker.graphs.stage(SceneGraph(scene), key("describe", scene), inbox).staged.folder.name)
    os._exit(9)


def hold_inbox(path: str, pipe) -> None:
    """Stage a graph for this process, and wait to be killed."""
    with Store.open(path) as store, store.arrays.inbox() as inbox:
        scene = store.scenes.list()[0].id
        store.graphs.stage(SceneGraph(scene), key("describe", scene), inbox)
        pipe.send(inbox)
        time.sleep(600)
