"""Several processes at one map, in any order and at once: nothing that was acknowledged is lost.

Every rule runs real verbs in processes of their own, two at a time, some of which are killed while they run.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import tempfile
import time
from pathlib import Path

import fault_children
import pytest
from fault_client import memory_folder
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

# Processes that start in a moment, from one that has imported everything and has no threads.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["fault_children", "zarr", "zarr.codecs", "gsmap.map.stages.export"])

# What a verb may say instead of doing something.
REFUSALS = ("no scene is called", "nothing to export", "no poses yet", "is exporting to it")


class Site(RuleBasedStateMachine):
    """What was acknowledged: scenes that must be there, or must not, and what was said of them."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="gsmap-stateful-", dir=memory_folder()))
        self.path, self.out, self.said = self.folder / "site.gsmap", self.folder / "out", self.folder / "said"
        self.said.mkdir()
        self.sure: set[str] = set()
        self.gone: set[str] = set()
        self.tagged: set[str] = set()
        self.count = 0

    def start(self, target, *arguments):
        """A process, and the file with what it says."""
        self.count += 1
        said = self.said / str(self.count)
        process = CONTEXT.Process(target=target, args=(*arguments, said))
        process.start()
        return process, said

    def run(self, *todo: tuple[str, str], kill_after_s: float | None = None) -> list[int]:
        """Verbs at once, the first of which is killed after a while if so asked; their exit codes."""
        started = [self.start(fault_children.do, what, self.path, self.out, about) for what, about in todo]
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            started[0][0].kill()
        codes = []
        for (process, said), (what, about) in zip(started, todo, strict=True):
            process.join(60)
            assert process.exitcode is not None, f"{what} {about} hangs"
            text = said.read_text() if said.exists() else ""
            assert "Traceback" not in text, f"{what} {about}: {text}"
            fine = process.exitcode == 0 or any(refusal in text for refusal in REFUSALS)
            assert fine or process.exitcode < 0, f"{what} {about} ended with {process.exitcode}: {text}"
            codes.append(process.exitcode)
        return codes

    @initialize()
    def an_empty_map(self) -> None:
        assert self.run(("create", "")) == [0]

    scenes = st.integers(0, 4)
    beside = st.sampled_from(["prune", "place", "export"])

    @rule(one=scenes, two=scenes)
    def two_ingest(self, one: int, two: int) -> None:
        assert self.run(("ingest", str(one)), ("ingest", str(two))) == [0, 0]
        self.sure |= {f"scene{one}", f"scene{two}"}
        self.gone -= self.sure

    @rule(one=scenes, other=beside)
    def one_ingests_meanwhile(self, one: int, other: str) -> None:
        assert self.run(("ingest", str(one)), (other, ""))[0] == 0
        self.sure.add(f"scene{one}")
        self.gone -= self.sure

    @rule(one=scenes, other=beside)
    def one_is_removed_meanwhile(self, one: int, other: str) -> None:
        name = f"scene{one}"
        code = self.run(("remove", name), (other, ""))[0]
        assert code == 0 or name not in self.sure
        self.sure.discard(name)
        self.tagged.discard(name)
        self.gone.add(name)

    @rule(one=scenes, other=st.sampled_from(["prune", "place", "export", "anchor"]))
    def one_is_tagged_meanwhile(self, one: int, other: str) -> None:
        name = f"scene{one}"
        code = self.run(("edit", name), (other, name))[0]
        assert code == 0 or name not in self.sure
        self.tagged |= {name} & self.sure

    @rule(what=st.sampled_from(["ingest", "prune", "place", "export"]), one=scenes, after_s=st.floats(0, 0.2))
    def one_is_killed(self, what: str, one: int, after_s: float) -> None:
        self.run((what, str(one)), ("place", ""), kill_after_s=after_s)
        if what == "ingest":
            self.gone.discard(f"scene{one}")  # it may have come to its end

    @rule()
    def an_export_goes_on(self) -> None:
        self.run(("place", ""))
        self.run(("export", ""))

    @invariant()
    def nothing_is_lost(self) -> None:
        if self.path.exists():
            process, said = self.start(fault_children.look, self.path, self.sure, self.gone, self.tagged)
            process.join(60)
            assert process.exitcode == 0, said.read_text() if said.exists() else "it cannot be looked at"

    def teardown(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def options(examples: int, steps: int) -> settings:
    return settings(
        max_examples=examples,
        stateful_step_count=steps,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


class TestSite(Site.TestCase):
    settings = options(2, 4)


@pytest.mark.slow
class TestSiteForLong(Site.TestCase):
    settings = options(60, 30)
