"""Measure which small faults (mutants) in a room its tests detect, by cosmic-ray (pip install '.[mutation]').

    python -m tools.check.mutation --room store --sample 200 --seed 0
    python -m tools.check.mutation --room optimize --module component_joins

Mutants are drawn at random from all modules of the room and planted in a copy of this checkout, one after another.
First each test of the room (`tests/ROOM`, without slow ones) runs once and its lines in the room are noted. A mutant
then runs the tests that reach its statement, the quickest and those that detected most mutants first, then those that
start processes, until one fails or takes far longer than before (killed), or those of `--seconds` have passed
(survived: a fault that no test of the room detects in that time, or a change that makes no difference). Tests that
alone take longer than `--seconds` are left out, and named. Prints the share that is killed, by module, and the
survivors.
"""

from __future__ import annotations

import ast
import gc
import inspect
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]

_SKIPPED = ("BitOr", "RemoveDecorator")
"""Operators that mostly change annotations (``int | None``), or what dataclasses are by their decorator."""

_LEFT_OUT = shutil.ignore_patterns(".git", "node_modules", ".venv", "__pycache__", ".*_cache", "build", "docs", "dist")

_KILLER = Path("killer")
"""File of the copy that names the test that has detected a mutant."""

_STARTS_A_PROCESS = {"os.fork", "os.posix_spawn", "subprocess.Popen", "socket.connect"}
"""Audit events of tests that run code in other processes (the last: in those of a fork server)."""


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--room", required=True)
    parser.add_argument("tests", nargs="*", help="files of tests; default: those of the room")
    parser.add_argument("--module", action="append", help="of the room, such as backup/saving; default: all of them")
    parser.add_argument("--sample", type=int, default=200, help="mutants to plant; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the sample; default: %(default)s")
    parser.add_argument(
        "--seconds", type=float, default=20, help="of CPU for the tests of a mutant at most; default: %(default)s"
    )
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends what it has started, too
    with tempfile.TemporaryDirectory(prefix="gsmap-mutation-") as folder:
        copy = Path(folder).resolve() / "gsmap"
        shutil.copytree(ROOT, copy, ignore=_LEFT_OUT, symlinks=True)
        for built in (*copy.glob("gsmap/_native*.so"), *copy.glob("gsmap/view/built/*")):
            built.touch()  # newer than the copied sources
        os.chdir(copy)
        here = [str(copy), str(copy / "synthetic")]
        sys.path[:0] = here
        os.environ["PYTHONPATH"] = os.pathsep.join(here)  # of processes that tests start
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        mutants = list(_mutants(Path("gsmap") / given.room, given.module))
        random.Random(given.seed).shuffle(mutants)
        sizes = Counter(path for path, _ in sorted(mutants, key=lambda one: one[0]))
        session = _Session(Path("gsmap") / given.room, sizes, mutants, given.sample, given.seconds)
        tests = given.tests or [f"tests/{given.room}"]
        pytest.main(["-q", "-s", "-p", "no:cacheprovider", *tests], plugins=[session])


def _mutants(room: Path, modules: list[str] | None) -> Iterator[tuple[Path, Any]]:
    """The mutations that cosmic-ray has of a room's modules."""
    from cosmic_ray.commands.init import _all_work_items
    from cosmic_ray.config import ConfigDict

    paths = [room / f"{module}.py" for module in modules] if modules else sorted(room.rglob("*.py"))
    for item in _all_work_items(paths, ConfigDict()):
        (mutation,) = item.mutations
        if not any(skipped in mutation.operator_name for skipped in _SKIPPED):
            yield mutation.module_path, mutation


class _Reach:
    """What each test, and each fixture that several tests share, reaches and takes; pytest's hooks fill it."""

    def __init__(self) -> None:
        self.key = ""
        self.lines: defaultdict[str, set[tuple[str, int]]] = defaultdict(set)
        self.took: Counter[str] = Counter()
        self.starts: set[str] = set()
        self.failed: set[str] = set()

    def measure(self, items: list[pytest.Item], room: Path, most_s: float) -> None:
        """Run each test; one that takes more than ``most_s`` of CPU fails."""
        from coverage import Coverage

        sys.addaudithook(lambda event, _: self.starts.add(self.key) if event in _STARTS_A_PROCESS else None)
        self.coverage = Coverage(data_file=None, include=[f"{room}/*"], config_file=False)
        self.coverage.start()
        signal.signal(signal.SIGPROF, _stop)
        for item, after in zip(items, [*items[1:], None], strict=True):
            began = _cpu_s()
            self._switch(item.nodeid)
            signal.setitimer(signal.ITIMER_PROF, most_s)
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            self.took[item.nodeid] += _cpu_s() - began
        signal.setitimer(signal.ITIMER_PROF, 0)
        self.coverage.stop()
        data = self.coverage.get_data()
        for file in data.measured_files():
            for line, keys in data.contexts_by_lineno(file).items():
                for key in keys:
                    self.lines[key].add((file, line))

    def _switch(self, key: str) -> None:
        self.key = key
        self.coverage.switch_context(key)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
        before, began = self.key, _cpu_s()
        if fixturedef.scope != "function":
            self._switch(fixturedef.argname)
        try:
            return (yield)
        finally:
            if self.key != before:
                took = _cpu_s() - began
                self.took[self.key] += took
                self.took[before] -= took
                self._switch(before)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.add(report.nodeid)

    def of(self, item: pytest.Item) -> tuple[float, set[tuple[str, int]], bool]:
        """How long a test takes (s), the lines that it reaches, whether it starts processes: with its fixtures."""
        keys = [item.nodeid, *getattr(item, "fixturenames", ())]
        took = sum(self.took[key] for key in keys)
        return took, set().union(*(self.lines[key] for key in keys)), bool(self.starts & set(keys))


class _Session:
    """A plugin of pytest: plant each mutant in a fork of the session that has collected the tests."""

    def __init__(
        self, room: Path, sizes: Counter[Path], mutants: list[tuple[Path, Any]], count: int, most_s: float
    ) -> None:
        self.room, self.sizes, self.mutants, self.count, self.most_s = room, sizes, mutants, count, most_s
        self.kills: Counter[str] = Counter()

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            sys.exit("the tests cannot be collected")
        reach = self._reach(session)
        failed = [item.nodeid for item in session.items if item.nodeid in reach.failed]
        if failed:
            print("left out, since without a mutant they fail or take too long:", *failed, sep="\n", file=sys.stderr)
        tests = [(*reach.of(item), item) for item in session.items if item.nodeid not in reach.failed]
        print(f"{len(tests)} tests of {sum(took for took, *_ in tests):.0f} s", file=sys.stderr, flush=True)
        tests.sort(key=lambda test: test[0])
        planted, killed, unreached = Counter[Path](), Counter[Path](), Counter[Path]()
        survivors = []
        for path, mutation in self.mutants:
            if planted.total() == self.count:
                break
            try:
                reaching, survived, told = self._plant(tests, path, mutation)
            except SyntaxError:  # cosmic-ray takes the bare * of a signature for a product
                continue
            planted[path] += 1
            killed[path] += not survived
            unreached[path] += not reaching
            word = "killed   " if not survived else "survived " if reaching else "unreached"
            print(word, told, file=sys.stderr, flush=True)
            if survived:
                survivors.append(f"{word} {told}")
        print("\n| module | mutants | planted | killed | unreached | score |\n| --- | --- | --- | --- | --- | --- |")
        for path in self.sizes:
            row = (self.sizes[path], planted[path], killed[path], unreached[path])
            print(_row(path.relative_to("gsmap").with_suffix("").as_posix(), *row))
        print(_row("all", self.sizes.total(), planted.total(), killed.total(), unreached.total()))
        print("\nsurvivors:", *sorted(survivors), sep="\n")
        return True

    def _reach(self, session: pytest.Session) -> _Reach:
        reach, kept = _Reach(), Path("reach.pickle")

        def run() -> int:
            session.config.pluginmanager.register(reach)
            reach.measure(session.items, self.room, self.most_s)
            kept.write_bytes(pickle.dumps((reach.lines, reach.took, reach.starts, reach.failed)))
            return 0

        if not _in_a_fork(run, float("inf")):
            sys.exit("the tests do not come through without a mutant")
        reach.lines, reach.took, reach.starts, reach.failed = pickle.loads(kept.read_bytes())
        return reach

    def _plant(self, tests: list[Any], path: Path, mutation: Any) -> tuple[bool, bool, str]:
        """Return whether a test reaches the mutant, whether it survives, and the line."""
        from cosmic_ray.mutating import use_mutation
        from cosmic_ray.plugins import get_operator

        line = mutation.start_pos[0]
        operator = get_operator(mutation.operator_name)(**(mutation.operator_args or {}))
        with use_mutation(path, operator, mutation.occurrence) as (old, new):
            file = str(path.absolute())
            statement = {(file, n) for n in _statement(old, line)}
            changed = _changed_functions(old, new, file)
            if changed is None:  # what a module does when it is imported: every test of it
                statement = {(file, n) for n in range(old.count("\n") + 1)}
            reaching = [(took, item) for took, lines, _, item in tests if lines & statement]
            reaching.sort(key=lambda test: test[0] / (1 + self.kills[test[1].nodeid]))
            reached = bool(reaching)
            reaching += [(took, item) for took, lines, starts, item in tests if starts and not lines & statement]
            chosen, left_s = [], self.most_s
            for took, item in reaching:
                if took <= left_s:
                    chosen.append((took, item))
                    left_s -= took
            survived = not chosen or _in_a_fork(lambda: _run(chosen, changed), 120 + 20 * (self.most_s - left_s))
        if _KILLER.exists():
            self.kills[_KILLER.read_text()] += 1
            _KILLER.unlink()
        was, now = (text.splitlines()[line - 1].strip() for text in (old, new))
        return reached, survived, f"{path}:{line} {mutation.definition_name or ''}: {was}  ->  {now}"


def _statement(source: str, line: int) -> range:
    """The lines of the innermost statement at a line; of a compound one, those before its body."""
    found = range(line, line + 1)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0):
            body = getattr(node, "body", None)
            end = body[0].lineno if body and isinstance(body[0], ast.stmt) else (node.end_lineno or 0) + 1
            if line < max(end, node.lineno + 1):
                found = range(node.lineno, max(end, node.lineno + 1))
    return found


def _changed_functions(old: str, new: str, file: str) -> dict[CodeType, CodeType] | None:
    """The code of each function before and after; None where more than the inside of functions has changed."""
    olds, news = (list(_codes(compile(source, file, "exec"))) for source in (old, new))
    if len(olds) != len(news):
        return None
    for was, now in zip(olds, news, strict=True):
        inside = was.co_flags & inspect.CO_OPTIMIZED and was.co_freevars == now.co_freevars
        if not inside and _plain(was) != _plain(now):
            return None
    return dict(zip(olds, news, strict=True))


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _plain(code: CodeType) -> tuple[Any, ...]:
    constants = [repr(constant) for constant in code.co_consts if not isinstance(constant, CodeType)]
    return code.co_code, code.co_names, code.co_varnames, code.co_freevars, constants


def _run(tests: list[tuple[float, pytest.Item]], changed: dict[CodeType, CodeType] | None) -> int:
    """Run tests until one fails, with the code of functions changed; return the exit code."""
    if changed is None:  # import everything again
        names = [item.nodeid for _, item in tests]
        os.execv(sys.executable, [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *names])
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and function.__code__ in changed:
            function.__code__ = changed[function.__code__]
    for (took, item), after in zip(tests, [*(item for _, item in tests[1:]), None], strict=True):
        signal.setitimer(signal.ITIMER_PROF, 5 + 10 * took)  # ends this process
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
        if item.session.testsfailed:
            _KILLER.write_text(item.nodeid)
            return 1
    return 0


def _in_a_fork(run: Callable[[], int], limit_s: float) -> bool:
    """Return whether something succeeds in a fork of this process; what takes too long does not."""
    child = os.fork()
    if child == 0:
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(nothing, stream)
        try:
            code = run()
        except BaseException:
            code = 1
        os._exit(code)
    began = time.monotonic()
    try:
        while time.monotonic() - began < limit_s:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                return status == 0
            time.sleep(0.02)
        return False
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # with what it has started
        with suppress(ChildProcessError):
            os.waitpid(child, 0)


def _stop(*_: object) -> None:
    raise TimeoutError


def _cpu_s() -> float:
    """CPU time of this process and of those that it has started and waited for."""
    return sum(os.times()[:4])


def _row(name: str, mutants: int, planted: int, killed: int, unreached: int) -> str:
    score = f"{killed / planted:.0%}" if planted else "-"
    return f"| {name} | {mutants} | {planted} | {killed} | {unreached} | {score} |"


if __name__ == "__main__":
    main()
