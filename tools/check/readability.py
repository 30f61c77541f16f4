"""Print how readable the tree is for a stranger: start-up, settings, names, docstrings, tests of wording, prose.

    python -m tools.check.readability               all measures, with their bars
    python -m tools.check.readability --list        also the settings, docstrings, names and places that miss a bar
    python -m tools.check.readability --no-startup  without timing verbs (a minute of CPU)

The exit status is 1 if a measure misses its bar. Mutation scores are printed by ``tools/check/mutation.py``; the
equality of outputs is tested by ``tests/contracts/test_golden.py``.
"""

from __future__ import annotations

import ast
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]

RIDDLE = re.compile(r"(What|Which|Whether|Who|Whose|How|Where|When|That|Those)\b")
"""First words of a docstring that names neither an action nor a thing."""

PARTICIPLE = re.compile(
    r"(?:[A-Z][a-z]+ed|Known|Shown|Told|Held|Found|Laid|Taken|Drawn|Sought|Made|Kept|Given|Seen|Lent|Put|Left|Swept|Spent"
    r"|Spoken|Said|Gone|Built|Read)$"
)
_EVERYDAY = """
Accepting Around Belief Carrying Doors Doubts Eyes Glance Growth Home Kin Look Looks Mark Maybe Near Nearby Many News
One Others
Passing Paint Pictured Rounds Sights Sight Standing Stopping Snap Teller Tells Things Thing Unlike Waiting Waste
Whole What Word Words Work Both Joining Matching Proposing Settling Sharing Strongest Vanished Wanted
"""
_NOUNS = "Bed Seed Speed Feed Need Embed Shed Thread Unnamed"
EVERYDAY = frozenset(_EVERYDAY.split())
NOUNS = frozenset(_NOUNS.split())
"""Words that end as participles do."""


@dataclass
class Measure:
    """One line of the table.

    Args:
        name: the quantity and its unit.
        value: as measured.
        bar: largest value that passes.
        misses: the items that count against it.
    """

    name: str
    value: float
    bar: float
    misses: list[str] = field(default_factory=list)

    @property
    def met(self) -> bool:
        return self.value <= self.bar


@cache
def tracked(*patterns: str) -> tuple[Path, ...]:
    """Return the files of the checkout that match, whether committed or only added."""
    listed = subprocess.run(["git", "ls-files", "--", *patterns], cwd=ROOT, text=True, capture_output=True, check=True)
    return tuple(path for line in listed.stdout.splitlines() if (path := ROOT / line).is_file())


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


# --- settings --------------------------------------------------------------------------------------------------------


def is_sentence(meaning: str) -> bool:
    """Return true for a text that can be read alone: capital letter, full stop, no fragment."""
    return bool(
        re.match(r"[A-Z`\"'(]", meaning)
        and meaning.rstrip().endswith(".")
        and "..." not in meaning
        and len(meaning.split()) >= 5
    )


def _is_used(name: str, text: str) -> bool:
    """Return true if a text has the name as a keyword argument, an attribute or a quoted word."""
    return bool(re.search(rf"\b{name}\s*=(?!=)|[.\"`]{name}[\"`\s=\])]", text))


def settings_measures() -> Iterator[Measure]:
    from gsmap.map.settings import Settings
    from gsmap.settings import leaves

    found = list(leaves(Settings()))
    fragments = [f"{leaf.name}: {leaf.meaning}" for leaf in found if not is_sentence(leaf.meaning)]
    text = "\n".join(path.read_text(encoding="utf-8") for path in tracked("README.md", "docs/*.md", "tests/*.py"))
    unnamed = [leaf.name for leaf in found if leaf.name not in text and not _is_used(leaf.name.split(".")[-1], text)]
    yield Measure("settings", len(found), 160)
    yield Measure("settings whose meaning is not one whole sentence", len(fragments), 0, fragments)
    yield Measure("settings named in no document or test", len(unnamed), 0, unnamed)


# --- docstrings and names --------------------------------------------------------------------------------------------


def docstring_measures() -> Iterator[Measure]:
    modules, others = [], []
    for path in tracked("gsmap/*.py"):
        tree = tree_of(path)
        if RIDDLE.match(ast.get_docstring(tree) or ""):
            modules.append(f"{path.relative_to(ROOT)}: {(ast.get_docstring(tree) or '').splitlines()[0]}")
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                first = (ast.get_docstring(node) or "").split("\n")[0]
                if RIDDLE.match(first):
                    others.append(f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}: {first}")
    yield Measure("module docstrings that start with What, Which, Whether, Who, How ...", len(modules), 0, modules)
    yield Measure("docstrings of classes and functions that do", len(others), 0, others)


def is_everyday(name: str) -> bool:
    """Return true for a class name that is a participle or an everyday word."""
    words = re.findall(r"[A-Z][a-z0-9]*|[A-Z]+(?![a-z])", name.strip("_")) or [name]
    last = words[-1]
    return (len(words) == 1 and last in EVERYDAY) or (
        bool(PARTICIPLE.match(last.lower().capitalize())) and last not in NOUNS
    )


def name_measures() -> Iterator[Measure]:
    classes = [
        (path, node)
        for path in tracked("gsmap/*.py")
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.ClassDef)
    ]
    bad = [f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}" for path, node in classes if is_everyday(node.name)]
    yield Measure("class names that are participles or everyday words", len(bad), 0, bad)


# --- tests -----------------------------------------------------------------------------------------------------------


def test_measures() -> Iterator[Measure]:
    faults = [
        f"{path.relative_to(ROOT)}"
        for path in tracked("tools/*.toml", "tests/*.toml")
        for _ in range(path.read_text(encoding="utf-8").count("[[fault]]"))
    ]
    wording = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in tracked("tests/*.py")
        if path.name != "raising.py"  # which compares codes
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call)
        and "match" in (given := {word.arg for word in node.keywords})
        and "code" not in given  # beside a code it names a file, a line or an option
    ]
    yield Measure("planted faults that quote source", len(faults), 0, faults)
    yield Measure("tests that tell errors apart by the wording of a message", len(wording), 50, wording)


# --- prose -----------------------------------------------------------------------------------------------------------


def prose_measures() -> Iterator[Measure]:
    total = sum(len(page.read_text(encoding="utf-8").split()) for page in tracked("*.md"))
    notes = tracked("docs/design/[0-9]*.md")
    yield Measure("words of prose", total, 50_000)
    yield Measure("README, bytes", (ROOT / "README.md").stat().st_size, 9_000)
    yield Measure("CHANGELOG, bytes", (ROOT / "CHANGELOG.md").stat().st_size, 12_000)
    yield Measure("design notes", len(notes), 25)


def command_measures() -> Iterator[Measure]:
    sys.path[:0] = [str(ROOT / "tests" / "contracts"), str(ROOT / "tests")]
    import test_documents as documents

    lines = [(page, line, whole) for page in documents.PAGES for line, whole in documents.commands_in(page.read_text())]
    refused = [
        f"{page.relative_to(ROOT)}: {line}: {why}"
        for page, line, whole in lines
        if (why := documents.refusal(line, whole=whole))
    ]
    yield Measure(f"commands in documents that gsmap does not parse, of {len(lines)}", len(refused), 0, refused)


# --- start-up --------------------------------------------------------------------------------------------------------

VERBS = ("list {} scenes", "status {}", "show {} hall", "edit {} hall --note wet", "poses {}")
_ROUNDS = 10


def cpu_s(command: list[str], environment: dict[str, str]) -> float:
    """Return the CPU seconds, user and system, of a command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    quiet = subprocess.DEVNULL
    subprocess.run(command, check=True, stdout=quiet, stderr=quiet, cwd=ROOT, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def startup_measures() -> Iterator[Measure]:
    import numpy as np

    import gsmap

    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder) / "site.gsmap"
        rng = np.random.default_rng(0)
        rotations, scales = np.tile(np.float32([1, 0, 0, 0]), (50, 1)), np.full((50, 3), -4, np.float32)
        opacities, sh = np.zeros(50, np.float32), np.zeros((50, 1, 3), np.float32)
        with gsmap.map.create(site) as m:
            for name in ("hall", "porch", "attic"):
                means = rng.uniform(size=(50, 3)).astype(np.float32)
                m.ingest(gsmap.Gaussians(means, rotations, scales, opacities, sh), name=name, scale="known")
            m.optimize()
        # Compiled, as an installer leaves gsmap and the packages that it is compared with.
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        environment["PYTHONPYCACHEPREFIX"] = str(Path(folder) / "compiled")
        commands = [[sys.executable, "-c", "import sqlalchemy, numpy"]]
        commands += [[sys.executable, "-m", "gsmap", *verb.format(site).split()] for verb in VERBS]
        # In turn, so that other work on the machine slows all of them alike; the first round compiles.
        rounds = [[cpu_s(command, environment) for command in commands] for _ in range(_ROUNDS + 1)][1:]
    base, *spent = (statistics.median(times) for times in zip(*rounds, strict=True))
    for verb, seconds in zip(VERBS, spent, strict=True):
        name = f"CPU of `gsmap {verb.format('MAP')}` over that of `import sqlalchemy, numpy`"
        yield Measure(name, seconds / base, 2.5)


MEASURES: tuple[Callable[[], Iterator[Measure]], ...] = (
    settings_measures,
    docstring_measures,
    name_measures,
    test_measures,
    prose_measures,
    command_measures,
)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--list", action="store_true", help="print what misses each bar")
    parser.add_argument("--no-startup", action="store_true", help="do not time verbs")
    options = parser.parse_args()
    failed = False
    print(f"{'measure':<90} {'value':>9} {'bar':>8}")
    for measures in MEASURES + (() if options.no_startup else (startup_measures,)):
        for one in measures():
            shown = f"{one.value:,.2f}" if one.value != int(one.value) else f"{int(one.value):,}"
            print(f"{one.name:<90} {shown:>9} {one.bar:>8,}{'' if one.met else '  missed'}", flush=True)
            if options.list and not one.met:
                print("\n".join(f"    {miss}" for miss in one.misses))
            failed |= not one.met
    sys.exit(failed)


if __name__ == "__main__":
    main()
