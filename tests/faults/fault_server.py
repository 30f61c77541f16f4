"""A process that has imported everything once, and runs verbs in forked children that it kills or fails.

Started with the shim in ``LD_PRELOAD``; takes one JSON object a line and answers with one; see `fault_client`.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import fault_judge
import fault_power
import next_schema
from fault_judge import State, Verdict
from fault_shim import MODES, PASS, Shim, changes
from fault_verbs import BASES, FUNCTIONS, VERBS, Verb, copy_map, words, write_samples

from gsmap.cli.app import run
from gsmap.errors import GsmapError
from gsmap.store import Store, schema

PATIENCE_S = 120.0


class Server:
    """Bases, and undisturbed runs, are made when first asked for.

    Args:
        root: a folder of its own, best in memory; ``root/work`` is where every verb runs, so that paths are the same.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.samples = root / "samples"
        self.work = root / "work"
        self.shim = Shim()
        self._states: dict[str, State] = {}
        self._after: dict[str, tuple[State, list[str]]] = {}
        self._known: set[str] = set()
        if not self.samples.exists():
            self._forked(lambda: write_samples(self.samples))

    # --- doing -------------------------------------------------------------------------------------------------------

    def ask(self, what: str, **options: Any) -> Any:
        return getattr(self, f"do_{what}")(**options)

    def do_ops(self, verb: str) -> list[str]:
        """The changes of an undisturbed run, in words."""
        return self._undisturbed(VERBS[verb])[1]

    def do_point(self, verb: str, n: int, mode: str) -> dict[str, Any]:
        """Run a verb, disturb its ``n``-th change, and judge."""
        began = time.process_time(), _children_s()
        wanted = VERBS[verb]
        before, (after, _) = self._base(wanted), self._undisturbed(wanted)
        self._lay_out(wanted)
        log = self.root / "log"
        log.unlink(missing_ok=True)
        code, stderr = self._run(wanted.line, lambda: self.shim.arm(self.work, n, MODES[mode], log))
        fired = [c for c in changes(log) if c.kind == "!"]
        verdict = self._forked(lambda: self._judge(wanted, before, after, code, stderr, bool(fired)))
        spent = time.process_time() - began[0] + _children_s() - began[1]
        out = {"verb": verb, "n": n, "mode": mode, "code": code, "seconds": spent, **asdict(verdict)}
        out["at"] = f"{fired[0].other} {_short(fired[0].path, self.work)}" if fired else ""
        out["said"] = stderr.strip().splitlines()[-1:] if code else []
        return out

    def do_power(self, verb: str, states: int) -> list[dict[str, Any]]:
        """Run a verb, cut the power at points of it, and judge what a disk might hold."""
        wanted = VERBS[verb]
        before, (after, _) = self._base(wanted), self._undisturbed(wanted)
        self._lay_out(wanted)
        log = self.root / "log"
        log.unlink(missing_ok=True)
        disk = fault_power.Disk(self.work)
        code, stderr = self._run(wanted.line, lambda: self.shim.arm(self.work, 0, PASS, log, data=True))
        assert code == 0, stderr
        done = list(changes(log))
        out = []
        for at, policy in fault_power.cuts(done, states):
            shutil.rmtree(self.work)
            disk.materialise(done[:at], policy, self.work)
            finished = at == len(done)
            verdict = self._forked(lambda end=finished: self._judge(wanted, before, after, None, "", True, end=end))
            last = str(done[at - 1]) if at else "the start"
            one = {"verb": verb, "n": at, "mode": policy, "code": None, "seconds": 0.0, "said": [], **asdict(verdict)}
            out.append(one | {"at": _short(last, self.work)})
        return out

    # --- parts -------------------------------------------------------------------------------------------------------

    def _base(self, verb: Verb) -> State:
        self._make_base(verb.base)
        return self._states[verb.base]

    def _make_base(self, name: str) -> None:
        if name in self._states:
            return
        parent, lines = BASES[name]
        if parent:
            self._make_base(parent)
        self._empty_work()
        if parent:
            copy_map(self.root / "bases" / parent, self.work)
        for line in lines:
            if line in FUNCTIONS:
                FUNCTIONS[line](self.work / "site.gsmap")
            else:
                code, stderr = self._run(line, learn=True)
                if code:
                    raise RuntimeError(f"making the base {name}: gsmap {line} ended with {code}: {stderr}")
        self._states[name] = self._forked(lambda: fault_judge.state(self.work))
        shutil.copytree(self.work, self.root / "bases" / name, symlinks=True)

    def _undisturbed(self, verb: Verb) -> tuple[State, list[str]]:
        if verb.name not in self._after:
            self._base(verb)
            self._lay_out(verb)
            log = self.root / "log"
            log.unlink(missing_ok=True)
            code, stderr = self._run(verb.line, lambda: self.shim.arm(self.work, 0, PASS, log), learn=True)
            if code:
                raise RuntimeError(f"undisturbed, gsmap {verb.line} ended with {code}: {stderr}")
            ops = [_short(str(change), self.work) for change in changes(log)]
            self._after[verb.name] = self._forked(lambda: fault_judge.state(self.work)), ops
        return self._after[verb.name]

    def _empty_work(self) -> None:
        shutil.rmtree(self.work, ignore_errors=True)
        self.work.mkdir(parents=True)

    def _lay_out(self, verb: Verb) -> None:
        self._empty_work()
        if verb.base != "nothing":
            copy_map(self.root / "bases" / verb.base, self.work)
        for line in verb.also:
            self._run(line)

    def _run(
        self, line: str, before: Callable[[], None] | None = None, *, learn: bool = False
    ) -> tuple[int | None, str]:
        """A line of the command line in a child; its exit code (None where it was killed) and what it said."""
        streams = [self.root / "stdout", self.root / "stderr"]
        pid = os.fork()
        if pid == 0:
            self._child(line, streams, before, learn)
        code, hung = _waited(pid)
        stderr = streams[1].read_text(errors="replace") + ("\nTraceback: it hung\n" if hung else "")
        if learn:
            self._learn()
        return code, stderr

    def _child(self, line: str, streams: list[Path], before: Callable[[], None] | None, learn: bool) -> None:
        code = 70
        try:
            for number, path in enumerate(streams, 1):
                handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(handle, number)
                os.close(handle)
            os.environ["GSMAP_WORKERS"] = "1"
            os.environ["GSMAP_CACHE"] = str(self.work / "cache")  # what a purge clears must be the same every time
            self._update_gsmap(line)
            if before is not None:
                before()
            try:
                run(words(line, self.work, self.samples))
                code = 0
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(bool(end.code))
            except BaseException:
                traceback.print_exc()
                code = 1
            self.shim.disarm()
            if learn:
                (self.root / "modules").write_text("\n".join(m for m in sys.modules if m.isidentifier() or "." in m))
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)

    def _learn(self) -> None:
        """Import what children had to import, so that the next ones have it."""
        noted = self.root / "modules"
        for name in noted.read_text().split():
            if name not in sys.modules and name not in self._known and not name.startswith(("onnxruntime", "tests")):
                self._known.add(name)
                with contextlib.suppress(BaseException):
                    importlib.import_module(name)

    def _judge(
        self, verb: Verb, before: State, after: State, code: int | None, stderr: str, fired: bool, *, end: bool = False
    ) -> Verdict:
        self._update_gsmap(verb.line)
        site, out = self.work / "site.gsmap", Verdict()
        now = fault_judge.state(self.work)
        out.lost += fault_judge.judge_rows(before, after, now)
        if end and not now.same(after):
            out.lost.append(f"what was done is not there: {fault_judge.differences(after, now)}")
        out.tracebacks += fault_judge.tracebacks(stderr)
        problems = self._problems()
        out.lost += problems + fault_judge.tiles_problems(self.work)
        out.untrue += fault_judge.judge_words(code, stderr, before, after, now, whole=not problems)
        if code is None and not fired and not end:
            out.untrue.append("ended by a signal that nobody sent, or hung")
        if code == 0 or end:
            out.lost += self._then(verb)
        again, said = self._run(verb.line)
        out.tracebacks += fault_judge.tracebacks(said)
        ended = fault_judge.state(self.work)
        if again != 0 and not (verb.done_says and verb.done_says in said and now.same(after)):
            out.repeat.append(f"ended with {again}: {said.strip().splitlines()[-1:]}")
        elif not ended.same(after, history=True):
            out.repeat.append(f"ended otherwise than undisturbed: {fault_judge.differences(after, ended)}")
        out.lost += [f"after the repeat: {p}" for p in (*self._problems(), *self._then(verb))]
        fault_judge.age(self.work)
        try:
            with Store.open(site) as store:
                store.prune()
        except GsmapError as error:
            out.lost.append(f"does not open to be pruned: {error}")
        out.left += fault_judge.leftovers(self.work, locks=again == 0)
        return out

    def _update_gsmap(self, line: str) -> None:
        """Make this child a gsmap that is newer than the map, if a line migrates."""
        if line.startswith("migrate ") and schema.HEAD != next_schema.NUMBER:
            next_schema.install(self.root / "migrations")

    def _problems(self) -> list[str]:
        """What `check` finds in any map, or why one does not open."""
        out = []
        for place in fault_judge.catalogs(self.work):
            home = place.parents[1] if place.parent.name == "branches" else place
            try:
                with Store.open(home if home == place else f"{home}@{place.name}", "r") as store:
                    out += [f"check: {problem}" for problem in store.check().problems]
            except Exception as error:
                out.append(f"does not open: {error}")
        return out

    def _then(self, verb: Verb) -> list[str]:
        """What does not work of what the verb was for."""
        out = fault_judge.told(self.work, verb.forgets) if verb.forgets else []
        for line in verb.then:
            code, stderr = self._run(line)
            out += [f"gsmap {line} ended with {code}: {stderr[-300:]}"] if code else []
        shutil.rmtree(self.work / "proof.gsmap", ignore_errors=True)
        return out

    def _forked(self, work: Callable[[], Any]) -> Any:
        """The result of something, done in a child, so that this process stays as it is."""
        import pickle

        ours, theirs = os.pipe()
        pid = os.fork()
        if pid == 0:
            try:
                os.close(ours)
                try:
                    done: tuple[bool, Any] = True, work()
                except BaseException:
                    done = False, traceback.format_exc()
                with os.fdopen(theirs, "wb") as pipe:
                    pickle.dump(done, pipe)
            finally:
                os._exit(0)
        os.close(theirs)
        with os.fdopen(ours, "rb") as pipe:
            content = pipe.read()
        os.waitpid(pid, 0)
        fine, result = pickle.loads(content)
        if not fine:
            raise RuntimeError(result)
        return result


def _waited(pid: int) -> tuple[int | None, bool]:
    """The exit code of a child (None where a signal ended it), and whether it had to be ended."""
    deadline = time.monotonic() + PATIENCE_S
    pause, hung = 0.0005, False
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.WEXITSTATUS(status) if os.WIFEXITED(status) else None, hung
        if time.monotonic() > deadline and not hung:
            os.kill(pid, signal.SIGKILL)
            hung = True
        time.sleep(pause)
        pause = min(pause * 1.3, 0.01)


def _children_s() -> float:
    used = os.times()
    return used.children_user + used.children_system


def _short(text: str, work: Path) -> str:
    return text.replace(f"{work}/", "")


def main() -> None:
    # What children print must not meet the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    server = Server(Path(sys.argv[1]))
    for line in sys.stdin:
        try:
            answer = {"answer": server.ask(**json.loads(line))}
        except Exception:
            answer = {"error": traceback.format_exc()}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
