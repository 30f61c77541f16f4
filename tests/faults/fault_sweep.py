"""Every change of every verb, met in every way: which points there are, who runs them, and what came of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from fault_client import Client, faulty
from fault_shim import FAULTS, KILLS, MODES, NAMES

_LETTERS = {name: letter for letter, name in NAMES.items()}
COLUMNS = ("lost", "tracebacks", "untrue", "repeat", "left")


@dataclass(frozen=True)
class Point:
    """Where to disturb a verb: at its ``n``-th change in a way of `MODES`; or ``n`` states after a power cut."""

    verb: str
    mode: str
    n: int

    @property
    def kind(self) -> str:
        return "power" if self.mode == "power" else "kill" if MODES[self.mode].kills else "fault"


def points(verb: str, ops: Sequence[str], modes: Iterable[str], every: int = 1, first: int = 1) -> list[Point]:
    """All points of a verb with these changes (or one of ``every``), where the mode can do something."""
    out = []
    for mode in modes:
        for n in range(first, len(ops) + 1, every):
            if _LETTERS[ops[n - 1].split()[0]] in MODES[mode].kinds:
                out.append(Point(verb, mode, n))
    return out


def run(todo: Sequence[Point], clients: Sequence[Client], told: Callable[[dict[str, Any]], None]) -> None:
    """Run points, as many at once as there are clients; each answer is told as it comes."""
    queue: SimpleQueue[Point | None] = SimpleQueue()
    answers: SimpleQueue[list[dict[str, Any]] | BaseException | None] = SimpleQueue()
    for point in todo:
        queue.put(point)

    def work(client: Client) -> None:
        try:
            while not queue.empty():
                point = queue.get()
                if point is None:
                    break
                if point.kind == "power":
                    answers.put(client.ask("power", verb=point.verb, states=point.n))
                else:
                    answers.put([client.ask("point", verb=point.verb, n=point.n, mode=point.mode)])
        except BaseException as error:
            answers.put(error)
        answers.put(None)

    with ThreadPoolExecutor(len(clients)) as pool:
        for client in clients:
            queue.put(None)
            pool.submit(work, client)
        left = len(clients)
        while left:
            answer = answers.get()
            if isinstance(answer, BaseException):
                while not queue.empty():
                    queue.get()
                raise answer
            if answer is None:
                left -= 1
            for one in answer or ():
                told(one)


class Tally:
    """What came of a sweep: counts by verb, and complaints that are alike under one heading."""

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, float]] = {}
        self.complaints: dict[str, list[dict[str, Any]]] = {}

    def add(self, point: dict[str, Any]) -> None:
        kind = "power" if point["mode"] not in MODES else "kill" if MODES[point["mode"]].kills else "fault"
        row = self.rows.setdefault(point["verb"], dict.fromkeys(("kill", "fault", "power", *COLUMNS, "seconds"), 0))
        row[kind] += 1
        row["seconds"] += point["seconds"]
        for column, items in faulty(point).items():
            row[column] += 1
            heading = f"{point['verb']}: {column}: {_alike(items[0])}"
            self.complaints.setdefault(heading, []).append(point)

    @property
    def total(self) -> dict[str, float]:
        names = ("kill", "fault", "power", *COLUMNS, "seconds")
        return {name: sum(row[name] for row in self.rows.values()) for name in names}

    @property
    def ok(self) -> bool:
        return not self.complaints

    def table(self) -> str:
        heads = ("verb", "kill points", "fault points", "power cuts", *COLUMNS, "CPU s")
        lines = [[verb, *(f"{value:.0f}" for value in row.values())] for verb, row in self.rows.items()]
        lines.append(["all", *(f"{value:.0f}" for value in self.total.values())])
        widths = [max(len(line[i]) for line in [list(heads), *lines]) for i in range(len(heads))]
        text = [[h.ljust(w) for h, w in zip(heads, widths, strict=True)]]
        text += [
            [c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(x, widths, strict=True))] for x in lines
        ]
        return "\n".join("  ".join(line).rstrip() for line in text)

    def report(self) -> str:
        """Complaints with how often and where first."""
        out = []
        for heading, found in self.complaints.items():
            first = found[0]
            by_mode: dict[str, list[int]] = {}
            for point in found:
                by_mode.setdefault(point["mode"], []).append(point["n"])
            where = "; ".join(f"{mode} at {', '.join(map(str, sorted(ns)[:8]))}" for mode, ns in by_mode.items())
            out.append(f"{heading}\n    {len(found)} times: {where}\n    first at {first['at']}; said {first['said']}")
        return "\n".join(out)


def _alike(text: str) -> str:
    text = re.sub(r"/\S*?/work/", "", text)
    return re.sub(r"[0-9a-f]{8,64}", "*", text)[:400]


__all__ = ["COLUMNS", "FAULTS", "KILLS", "Point", "Tally", "points", "run"]
