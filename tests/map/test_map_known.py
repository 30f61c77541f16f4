"""What registering knows of pairs is what a first look finds, however much of it was found before."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import delete

from gsmap.map.stages.describe import graph_keys
from gsmap.map.stages.register import RegisteredPairs, _RegistrationContext
from gsmap.methods import RecipeKey
from gsmap.store.schema import registrations, reviews
from gsmap.types import Registration, Sim3
from tools.make.large_maps import Filled, filled, tiny_pattern


@pytest.fixture
def street(tmp_path: Path) -> Iterator[Filled]:
    with filled(tmp_path / "street.gsmap", 6, tiny_pattern()) as one:
        yield one


def work(street: Filled) -> _RegistrationContext:
    store, settings = street.map.store, street.map.settings
    scenes = store.scenes.summaries()
    return _RegistrationContext(store, scenes, graph_keys(store, scenes, settings), settings, lambda *_: None)


def found(known: RegisteredPairs, street: Filled) -> tuple[object, ...]:
    has = [pair for pair in combinations(sorted(street.order), 2) if known.has(*pair)]
    return has, sorted(known.held.items()), known.stale


def test_a_second_look_finds_what_a_first_one_would(street: Filled) -> None:
    store, rng, known = street.map.store, np.random.default_rng(3), RegisteredPairs()
    seen = set()
    for step in range(60):
        mine = work(street)
        a, b = sorted(rng.choice(street.order, 2, replace=False).tolist())
        kind, stored = rng.integers(6), store.registrations.get(a, b)
        if kind < 2 or stored is None:  # by this recipe, or by another one
            key = mine.key(a, b) if kind else RecipeKey("register", "other", {}).of(a, b, str(step))
            edge = Registration(a, b, "no_match")
            if rng.integers(2):
                pose, evidence = (Sim3.identity(), np.eye(7)), {"look_alike": float(rng.choice([0.001, 0.9]))}
                edge = Registration(a, b, "accepted", "", *pose, evidence=evidence)
            store.registrations.save(edge, key)
        elif kind == 2 and (stored.review or stored.manual):
            store.registrations.review(a, b, "withdraw")
        elif kind == 3:
            store.registrations.review(a, b, "reject")
        elif kind == 4:  # all that is known of a pair goes
            with store.catalog.write() as connection:
                for table in (reviews, registrations):
                    connection.execute(delete(table).where(table.c.pair == f"{a}:{b}"))
        else:
            street.map.with_settings({"register.verdict.max_log_nfa": float(rng.choice([-9.5, -9.0]))})
        fresh = RegisteredPairs()
        known.update(work(street))
        fresh.update(work(street))
        assert found(known, street) == found(fresh, street)
        seen |= {kind for kind, one in enumerate(found(fresh, street)) if one}
    assert seen == {0, 1, 2}


def test_a_second_look_judges_what_has_changed(street: Filled, monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[tuple[str, ...]] = []
    known, mine, digest_of = RegisteredPairs(), work(street), RecipeKey.digest_of

    def noted(key: RecipeKey, *inputs: str) -> str:
        judged.append(inputs)
        return digest_of(key, *inputs)

    def look() -> int:
        judged.clear()
        with monkeypatch.context() as patch:
            patch.setattr(RecipeKey, "digest_of", noted)
            known.update(mine)
        return len(judged)

    assert look() >= len(street.order) * (len(street.order) - 1) / 2
    assert look() == 0
    a, b = sorted(street.order[:2])
    assert (a, b) in known.held.values()
    street.map.store.registrations.save(Registration(a, b, "no_match"), mine.key(a, b))
    assert look() == 1
    assert (a, b) not in known.held.values()
