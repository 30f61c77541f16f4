"""Registrations of pairs of scenes, and what people said of them. Nothing is overwritten."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, Select, case, func, insert, select

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, to_array, to_pose
from gsmap.store.scene_refs import living_ids, resolve, scene_name
from gsmap.store.schema import registrations, reviews
from gsmap.types import Registration
from gsmap.types.plain import plain

REVIEWS = ("confirm", "reject", "withdraw")
MANUAL = "manual"
"""`Registration.proposer` of a person's own measurement."""


@dataclass(frozen=True, eq=False)
class StoredRegistration:
    """A registration and its place in the history.

    Args:
        number: unique in the map, growing.
        key: `RecipeKey.digest` of what it was computed from; empty for a person's own measurement.
        recipe: digest of its recipe (`gsmap.store.recipes.Recipes.get`); None for a person's own measurement, and in
            rows that schema 0001 wrote.
        review: a person's standing word on the pair: ``confirm``, ``reject`` or None.
        adopts: number of the earlier registration that this one makes current again, unchanged; None where it was
            computed.
    """

    number: int
    registration: Registration
    key: str
    created_at: str
    review: str | None = None
    recipe: str | None = None
    adopts: int | None = None

    @property
    def manual(self) -> bool:
        """Whether a person measured it."""
        return self.registration.proposer == MANUAL


@dataclass(frozen=True)
class Review:
    """A person's word on a pair (``confirm``, ``reject``, ``withdraw``), given when ``registration`` was current."""

    review: str
    registration: int
    note: str
    created_at: str


@dataclass(frozen=True)
class Standing:
    """What stands of a pair, without its pose.

    Args:
        key: of its current registration; empty for a person's own measurement.
        keys: of all that were computed for it.
        is_edge: whether it ties its scenes: accepted, or confirmed, and not rejected by a person.
        said: whether a person measured or confirmed it.
        disagreement: of what both scenes saw; NaN where that is not known.
    """

    target: str
    source: str
    key: str
    keys: frozenset[str]
    is_edge: bool
    said: bool
    disagreement: float


class Registrations:
    """The edges of a map. A pair is the same pair in either direction; a registration keeps its own.

    A pair's *current* registration is, first of all, what a person said last: the pose that was confirmed, or that was
    measured by hand (proposer ``manual``); else the newest. ``withdraw`` takes back the last word that stands: a
    review, or else a measurement.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def save(self, registration: Registration, key: RecipeKey | None = None) -> StoredRegistration:
        """Add a registration to its pair's history; it is the pair's current one from now on, unless a person spoke.

        Args:
            key: its recipe and inputs; None for a person's own measurement only.

        Raises:
            InputError: a computed registration without a key, or a measurement with one or without a pose.
        """
        r = registration
        if (r.proposer == MANUAL) != (key is None):
            raise InputError(f"a registration needs its recipe key, unless its proposer is {MANUAL!r}")
        if r.proposer == MANUAL and r.status != "accepted":
            raise InputError("a measured registration has status 'accepted', a pose and an information matrix")
        with self._catalog.write() as connection:
            row = {
                "target": r.target,
                "source": r.source,
                "pair": _pair(connection, r.target, r.source),
                "key": "" if key is None else key.digest,
                "recipe": recipes.keep(connection, key),
                "status": r.status,
                "reason": r.reason,
                "S_target_source": from_pose(r.S_target_source),
                "information": from_array(r.information),
                "num_inliers": int(r.num_inliers),
                "num_correspondences": int(r.num_correspondences),
                "overlap": float(r.overlap),
                "proposer": r.proposer,
                "exact": int(r.exact),
                "seconds": plain(r.seconds),
                "evidence": plain(r.evidence),
                "notes": list(r.notes),
                "created_at": now(),
            }
            return self._insert(connection, row)

    def adopt(self, number: int) -> StoredRegistration:
        """Make an earlier registration the newest of its pair again, as if it had just been computed.

        So a map that goes back to older settings has its older edges again. Nothing is written where it is the newest.

        Raises:
            NotFoundError: no such registration.
        """
        with self._catalog.write() as connection:
            row = connection.execute(select(registrations).where(registrations.c.number == number)).first()
            if row is None:
                raise NotFoundError(f"no registration {number} in this map")
            if row.proposer == MANUAL:
                raise InputError(f"registration {number} was measured by a person: save it again instead")
            pair = _rows_of(connection, row.pair)
            newest = [r for r in pair if r.proposer != MANUAL][-1]
            original = row.number if row.adopts is None else row.adopts
            if original in (newest.number, newest.adopts):
                return _stored(newest, _decide(pair, _reviews_of(connection, row.pair)).word)
            copied = {name: value for name, value in row._mapping.items() if name != "number"}
            return self._insert(connection, copied | {"adopts": original, "created_at": now()})

    def current(self) -> list[StoredRegistration]:
        """The current registration of each pair of living scenes, by the pair's first registration."""
        with self._catalog.read() as connection:
            alive = living_ids(connection)
            rows = connection.execute(select(registrations).order_by(registrations.c.number)).all()
            said = connection.execute(select(reviews).order_by(reviews.c.pair, reviews.c.number)).all()
        words = {pair: [_review(row) for row in mine] for pair, mine in groupby(said, lambda row: str(row.pair))}
        pairs: dict[str, list[Row[Any]]] = {}
        for row in rows:
            if row.target in alive and row.source in alive:
                pairs.setdefault(row.pair, []).append(row)
        chosen = [_decide(mine, words.get(pair, [])) for pair, mine in pairs.items()]
        return [_stored(choice.row, choice.word) for choice in chosen if choice.row is not None]

    def standing(self) -> list[Standing]:
        """What stands of each pair of living scenes, by the pair's first registration: `current`, read far quicker."""
        r = registrations.c
        evidence = case((r.status == "accepted", r.evidence))
        light: Select[Any] = select(
            r.number, r.target, r.source, r.pair, r.key, r.status, r.proposer, evidence.label("evidence")
        )
        with self._catalog.read() as connection:
            alive = living_ids(connection)
            rows = connection.execute(light.order_by(r.number)).all()
            said = connection.execute(select(reviews).order_by(reviews.c.pair, reviews.c.number)).all()
        words = {pair: [_review(row) for row in mine] for pair, mine in groupby(said, lambda row: str(row.pair))}
        pairs: dict[str, list[Row[Any]]] = {}
        for row in rows:
            if row.target in alive and row.source in alive:
                pairs.setdefault(row.pair, []).append(row)
        found = []
        for pair, mine in pairs.items():
            choice = _decide(mine, words.get(pair, []))
            if (current := choice.row) is None:
                continue
            row, word = current, choice.word
            review = None if word is None else word.review
            is_edge = review == "confirm" or (row.status == "accepted" and review != "reject")
            keys = frozenset(one.key for one in mine if one.key)
            doubt = float((row.evidence or {}).get("disagreement", np.nan))
            known = row.proposer == MANUAL or review == "confirm"
            found.append(Standing(row.target, row.source, row.key, keys, is_edge, known, doubt))
        return found

    def get(self, a: str, b: str) -> StoredRegistration | None:
        """The current registration of a pair (scene refs, either direction); None where there is none."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            choice = _decide(_rows_of(connection, pair), _reviews_of(connection, pair))
        return None if choice.row is None else _stored(choice.row, choice.word)

    def find(self, key: RecipeKey | str) -> StoredRegistration | None:
        """The newest registration that is kept under a key (or its digest); None where there is none."""
        digest = recipes.digest_of(key)
        if not digest:
            return None
        query = select(registrations).where(registrations.c.key == digest).order_by(registrations.c.number.desc())
        with self._catalog.read() as connection:
            row = connection.execute(query.limit(1)).first()
            if row is None:
                return None
            choice = _decide(_rows_of(connection, row.pair), _reviews_of(connection, row.pair))
        return _stored(row, choice.word)

    def kept(self, keys: Iterable[RecipeKey | str], *, after: int = 0) -> set[str]:
        """Those of the keys (as digests) that a registration is kept under, made later than the one of a number."""
        with self._catalog.read() as connection:
            return recipes.kept(connection, registrations.c.key, keys, registrations.c.number > after)

    def newest(self) -> int:
        """Number of the newest registration; 0 where there is none."""
        with self._catalog.read() as connection:
            return connection.execute(select(func.max(registrations.c.number))).scalar_one() or 0

    def history(self, a: str, b: str) -> list[StoredRegistration]:
        """Every registration of a pair, oldest first."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            rows = _rows_of(connection, pair)
            choice = _decide(rows, _reviews_of(connection, pair))
        return [_stored(row, choice.word) for row in rows]

    def review(self, a: str, b: str, review: str, note: str = "") -> StoredRegistration | None:
        """Write down a person's word on a pair: ``confirm`` its current pose, ``reject`` it, or ``withdraw`` the last.

        Returns:
            The pair's current registration; None where its only one was a measurement that is now withdrawn.

        Raises:
            NotFoundError: the pair was never registered.
            InputError: there is no pose to confirm, or nothing to withdraw.
            ConfigError: another word.
        """
        if review not in REVIEWS:
            raise ConfigError(f"a review is one of {', '.join(REVIEWS)}, got {review!r}")
        with self._catalog.write() as connection:
            found = self.get(a, b)
            first, second = scene_name(connection, a), scene_name(connection, b)
            if found is None:
                raise NotFoundError(
                    f"{first} and {second} were never registered: gsmap register MAP --pairs {first}:{second}"
                )
            if review == "confirm" and found.registration.S_target_source is None:
                raise InputError(
                    f"{first} and {second} have no pose to confirm: {found.registration.reason or 'none was found'}"
                )
            if review == "withdraw" and found.review is None and not found.manual:
                raise InputError(f"nobody has reviewed {first} and {second}: there is nothing to withdraw")
            row = {"review": review, "registration": found.number, "note": note, "created_at": now()}
            connection.execute(insert(reviews), row | {"pair": _pair(connection, a, b)})
            return self.get(a, b)

    def reviews(self, a: str, b: str) -> list[Review]:
        """Everything people said of a pair, oldest first."""
        with self._catalog.read() as connection:
            return _reviews_of(connection, _pair(connection, a, b))

    def _insert(self, connection: Connection, row: dict[str, Any]) -> StoredRegistration:
        number = connection.execute(insert(registrations).returning(registrations.c.number), row).scalar_one()
        stored = connection.execute(select(registrations).where(registrations.c.number == number)).one()
        choice = _decide(_rows_of(connection, stored.pair), _reviews_of(connection, stored.pair))
        return _stored(stored, choice.word)


@dataclass(frozen=True)
class _Choice:
    """A pair's current row, and the review that stands on it."""

    row: Row[Any] | None
    word: Review | None


def _decide(rows: Sequence[Row[Any]], said: Iterable[Review]) -> _Choice:
    """What counts of a pair: its rows and reviews, both oldest first. See `Registrations`."""
    measured = {row.number for row in rows if row.proposer == MANUAL}
    word: Review | None = None
    withdrawn: set[int] = set()
    for review in said:
        if review.review != "withdraw":
            word = review
        elif review.registration in measured and (word is None or word.registration != review.registration):
            withdrawn.add(review.registration)  # no review stood on it: the measurement itself is taken back
        else:
            word = None
    standing = max(measured - withdrawn, default=None)
    if standing is not None and (word is None or word.registration <= standing):
        if word is not None and word.registration < standing:
            word = None  # said before it was measured
        chosen: int | None = standing
    elif word is not None and word.review == "confirm":
        chosen = word.registration
    else:
        chosen = max((row.number for row in rows if row.proposer != MANUAL), default=None)
    return _Choice(next((row for row in rows if row.number == chosen), None), word)


def _pair(connection: Connection, a: str, b: str) -> str:
    first, second = sorted((resolve(connection, a), resolve(connection, b)))
    if first == second:
        raise InputError(f"{a} and {b} are the same scene: a pair needs two")
    return f"{first}:{second}"


def _rows_of(connection: Connection, pair: str) -> Sequence[Row[Any]]:
    query = select(registrations).where(registrations.c.pair == pair).order_by(registrations.c.number)
    return connection.execute(query).all()


def _reviews_of(connection: Connection, pair: str) -> list[Review]:
    query = select(reviews).where(reviews.c.pair == pair).order_by(reviews.c.number)
    return [_review(row) for row in connection.execute(query)]


def _review(row: Row[Any]) -> Review:
    return Review(row.review, row.registration, row.note, row.created_at)


def _stored(row: Row[Any], word: Review | None) -> StoredRegistration:
    registration = Registration(
        target=row.target,
        source=row.source,
        status=row.status,
        reason=row.reason,
        S_target_source=to_pose(row.S_target_source),
        information=to_array(row.information),
        num_inliers=row.num_inliers,
        num_correspondences=row.num_correspondences,
        overlap=row.overlap,
        proposer=row.proposer,
        exact=bool(row.exact),
        seconds=row.seconds,
        evidence=row.evidence,
        notes=tuple(row.notes),
    )
    review = None if word is None else word.review
    return StoredRegistration(row.number, registration, row.key, row.created_at, review, row.recipe, row.adopts)
