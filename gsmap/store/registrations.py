"""Registrations of pairs of scenes and their reviews; rows are never overwritten."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import (
    ColumnElement,
    Connection,
    LargeBinary,
    Row,
    Select,
    Text,
    case,
    exists,
    func,
    insert,
    null,
    or_,
    select,
    true,
    type_coerce,
)

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import JsonText, is_object, malformed_as_corrupt
from gsmap.store.matrices import matrices_of_bytes, poses_of_bytes
from gsmap.store.scene_refs import living_ids, resolve, scene_name
from gsmap.store.schema import registrations, reviews, scenes
from gsmap.types import Registration, Sim3
from gsmap.types.plain import plain

REVIEWS = ("confirm", "reject", "withdraw")
MANUAL = "manual"
"""The value of `Registration.proposer` for a manual measurement."""


@dataclass(frozen=True, eq=False)
class StoredRegistration:
    """A registration in the history of its pair.

    Args:
        number: unique in the map, growing.
        key: `RecipeKey.digest` of its recipe and inputs; empty for a manual measurement.
        recipe: digest of its recipe (`gsmap.store.recipes.Recipes.get`); None for a manual measurement.
        review: the review of the pair in force: ``confirm``, ``reject`` or None.
        adopts: number of the earlier registration that this one makes current again; None for a computed one.
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
        """Return True for a manual measurement."""
        return self.registration.proposer == MANUAL

    @property
    def is_usable(self) -> bool:
        """Return True if it has a pose and is confirmed, or accepted and not rejected."""
        posed = self.registration.S_target_source is not None and self.registration.information is not None
        return posed and _is_usable(self.registration.status, self.review)


_UNKNOWN = float("nan")


class EdgeSummary(NamedTuple):  # created for every pair in every update: ten times faster than a dataclass
    """The current registration of a pair without evidence and matrices; see `StoredRegistration`.

    Args:
        pair: both ids with a colon between them, the lower first.
        usable: as `StoredRegistration.is_usable`.
        look_alike: probability of two places that look alike; NaN as below.
        disagreement: fraction of the surface seen by both scenes on which they disagree; NaN if unknown, not accepted,
            or not read.
        history_keys: keys of all computed registrations of the pair; None if there is one, or if they were not read.
    """

    number: int
    target: str
    source: str
    pair: str
    key: str
    review: str | None
    usable: bool
    look_alike: float = _UNKNOWN
    disagreement: float = _UNKNOWN
    history_keys: frozenset[str] | None = None

    @property
    def manual(self) -> bool:
        """Return True for a manual measurement."""
        return not self.key

    @property
    def is_specified(self) -> bool:
        """Return True if a person measured or confirmed the registration."""
        return self.manual or self.review == "confirm"

    @property
    def keys(self) -> frozenset[str]:
        """Return the keys of those computed registrations of the pair that were read."""
        return frozenset((self.key,) if self.key else ()) if self.history_keys is None else self.history_keys


@dataclass(frozen=True)
class Review:
    """A person's review of a pair (``confirm``, ``reject``, ``withdraw``), made when ``registration`` was current."""

    review: str
    registration: int
    note: str
    created_at: str


class Registrations:
    """The registrations of a map. Pairs are unordered; a registration keeps its own direction.

    The *current* registration of a pair is what a person decided last: the confirmed pose, or the manual measurement
    (proposer ``manual``); without either it is the newest. ``withdraw`` takes back the review in force, or otherwise
    the measurement.

    Readers: `get`, `history` and `reviews` of one pair; `current`, `current_of_scene`, `current_of_pairs`,
    `current_usable` and `current_with_note` return current registrations; `summaries`, `all_summaries` and
    `current_keys` read less of each; `newest_with_key`, `newest_with_keys` and `stored_keys` look up computed results.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._unreviewed: dict[str, EdgeSummary] = {}
        self._read_until: tuple[int, tuple[Any, ...]] = (0, ())

    def save(self, registration: Registration, key: RecipeKey | None = None) -> StoredRegistration:
        """Add a registration to the history of its pair, where it becomes current unless the pair is reviewed.

        Args:
            key: its recipe and inputs; None for a manual measurement only.

        Raises:
            InputError: a computed registration without a key, or a measurement with one or without a pose.
        """
        _check_key(registration, key)
        with self._catalog.write() as connection:
            pair = _pair(connection, registration.target, registration.source)
            return self._insert(connection, _row_of(registration, pair, key, recipes.save_recipe(connection, key)))

    def save_all(self, made: Sequence[tuple[Registration, RecipeKey]]) -> None:
        """Add many computed registrations with their keys in a few statements; scenes are named by id.

        Raises:
            InputError: as `save`; a registration with an unknown scene, or of a scene with itself. Nothing is stored
                then.
        """
        for registration, key in made:
            _check_key(registration, key)
        if not made:
            return
        wanted = {scene for registration, _ in made for scene in (registration.target, registration.source)}
        with self._catalog.write() as connection:
            known = recipes.stored_keys(connection, scenes.c.id, wanted)
            by_recipe = {key.recipe: key for _, key in made}
            kept = {digest: recipes.save_recipe(connection, key) for digest, key in by_recipe.items()}
            rows = []
            for registration, key in made:
                a, b = sorted((registration.target, registration.source))
                if a == b or not {a, b} <= known:
                    raise InputError(
                        f"a registration needs the ids of two scenes of the map, got {a} and {b}",
                        code="invalid_registration",
                    )
                rows.append(_row_of(registration, f"{a}:{b}", key, kept[key.recipe]))
            connection.execute(insert(registrations), rows)

    def adopt(self, number: int) -> StoredRegistration:
        """Make an earlier registration the newest of its pair, as if it had just been computed.

        A map that returns to older settings so gets its older edges back. Writes nothing if it is the newest already.

        Raises:
            NotFoundError: no such registration.
        """
        with self._catalog.write() as connection:
            row = connection.execute(select(registrations).where(registrations.c.number == number)).first()
            if row is None:
                raise NotFoundError(f"this map has no registration {number}", code="registration_not_found")
            if row.proposer == MANUAL:
                raise InputError(
                    f"registration {number} is a manual measurement and cannot be computed again: save it again "
                    "instead",
                    code="registration_measured",
                )
            pair = _rows_of(connection, row.pair)
            newest = [r for r in pair if r.proposer != MANUAL][-1]
            original = row.number if row.adopts is None else row.adopts
            if original in (newest.number, newest.adopts):
                return _stored_one(newest, _find_current(pair, _reviews_of(connection, row.pair))[1])
            copied = {name: value for name, value in row._mapping.items() if name != "number"}
            return self._insert(connection, copied | {"adopts": original, "created_at": now()})

    def current(self, *, brief: bool = False) -> list[StoredRegistration]:
        """Return the current registration of each pair of living scenes, ordered by the pair's first registration.

        Args:
            brief: leave out evidence and notes, which are most of the data.
        """
        with self._catalog.read() as connection:
            return _current(connection, columns=_BRIEF if brief else _FULL)

    def current_of_scene(self, scene: str) -> list[StoredRegistration]:
        """Return the current registrations of the pairs of one scene (id)."""
        mine = or_(registrations.c.target == scene, registrations.c.source == scene)
        with self._catalog.read() as connection:
            return _current(connection, mine)

    def current_of_pairs(self, pairs: Iterable[tuple[str, str]]) -> list[StoredRegistration]:
        """Return the current registrations of some pairs of scenes (ids), in either direction."""
        wanted = sorted({":".join(sorted(pair)) for pair in pairs})
        found: list[StoredRegistration] = []
        with self._catalog.read() as connection:
            for start in range(0, len(wanted), recipes.KEYS_PER_QUERY):
                some = wanted[start : start + recipes.KEYS_PER_QUERY]
                found += _current(connection, registrations.c.pair.in_(some))
        return found

    def summaries(self, *, usable: bool = False) -> list[EdgeSummary]:
        """Return a summary of the current registration of each pair of living scenes, by (target, source), without
        matrices.

        Reuses what `all_summaries` has cached.

        Args:
            usable: only usable ones (`EdgeSummary.usable`).
        """
        with self._catalog.read() as connection:
            if self._unreviewed:
                made = self.all_summaries()
            else:
                wanted = registrations.c.status == "accepted" if usable else true()
                made = _unreviewed_summaries(connection, wanted) + _reviewed_summaries(connection)
            living = living_ids(connection)
        found = (one for one in made if (one.usable or not usable) and one.target in living and one.source in living)
        return sorted(found, key=_ends_of)

    def current_with_note(self, *texts: str) -> list[StoredRegistration]:
        """Return the current registrations with a note that begins with one of some texts, ordered by the pair's first
        registration."""
        notes = type_coerce(registrations.c.notes, Text)
        with self._catalog.read() as connection:
            found = _current(connection, unreviewed_if=or_(*(notes.contains(text, autoescape=True) for text in texts)))
        return [one for one in found if any(note.startswith(texts) for note in one.registration.notes)]

    def all_summaries(self) -> list[EdgeSummary]:
        """Return a summary of the current registration of every pair, of living and removed scenes, with the keys of
        its history.

        Cached, since each update needs it twice: only new rows are read again.
        """
        with self._catalog.read() as connection:
            count = connection.execute(select(func.count()).select_from(registrations)).scalar_one()
            upto, then = self._read_until
            new = connection.execute(_ALL_SUMMARY_ROWS.where(registrations.c.number > upto)).all()
            if upto and then != (count - len(new), _fingerprint(connection, upto)):
                self._unreviewed.clear()
                upto, new = 0, connection.execute(_ALL_SUMMARY_ROWS).all()
            _add_summaries(self._unreviewed, new)
            upto = new[-1].number if new else upto
            self._read_until = upto, (count, _fingerprint(connection, upto))
            reviewed = _reviewed_summaries(connection)
            reviewed_pairs = set(connection.execute(_REVIEWED_PAIRS).scalars()) if reviewed else set()
        if not reviewed_pairs:
            return list(self._unreviewed.values())
        return [one for pair, one in self._unreviewed.items() if pair not in reviewed_pairs] + reviewed

    def current_keys(self) -> list[tuple[str, str]]:
        """Return each pair (`EdgeSummary.pair`) with the key of its current registration; empty if a person decided
        it."""
        every = select(*_undecoded("pair", "key")).order_by(registrations.c.number)
        with self._catalog.read() as connection:
            keys = {row[0]: row[1] for row in connection.execute(every).all()}  # the newest row of a pair wins
            reviewed = _reviewed_summaries(connection)
            for pair in connection.execute(_REVIEWED_PAIRS).scalars() if reviewed else ():
                keys.pop(pair, None)
        return [*keys.items(), *((one.pair, "" if one.is_specified else one.key) for one in reviewed)]

    def current_usable(self, among: Collection[str] | None = None) -> list[StoredRegistration]:
        """Return the current registrations that are usable (`StoredRegistration.is_usable`), by (target, source).

        Args:
            among: only pairs with both scenes (ids) among these.
        """
        inside = None
        if among is not None:
            some = sorted(among)
            inside = registrations.c.target.in_(some) & registrations.c.source.in_(some)
        with self._catalog.read() as connection:
            found = _current(connection, inside, unreviewed_if=registrations.c.status == "accepted")
        found = [one for one in found if one.is_usable]
        return sorted(found, key=lambda one: (one.registration.target, one.registration.source))

    def get(self, a: str, b: str) -> StoredRegistration | None:
        """Return the current registration of a pair (scene references, either direction); None if there is none."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            row, review = _find_current(_rows_of(connection, pair), _reviews_of(connection, pair))
        return None if row is None else _stored_one(row, review)

    def newest_with_key(self, key: RecipeKey | str) -> StoredRegistration | None:
        """Return the newest registration with a key or digest; None without one."""
        digest = recipes.digest_of(key)
        if not digest:
            return None
        query = select(registrations).where(registrations.c.key == digest).order_by(registrations.c.number.desc())
        with self._catalog.read() as connection:
            row = connection.execute(query.limit(1)).first()
            if row is None:
                return None
            _, review = _find_current(_rows_of(connection, row.pair), _reviews_of(connection, row.pair))
        return _stored_one(row, review)

    def newest_with_keys(self, keys: Iterable[RecipeKey | str]) -> list[Registration]:
        """Return the newest registration of each key (or digest) that has a registration, in the order of the keys."""
        wanted = list(dict.fromkeys(digest for key in keys if (digest := recipes.digest_of(key))))
        newest: dict[str, Row[Any]] = {}
        with self._catalog.read() as connection:
            for start in range(0, len(wanted), recipes.KEYS_PER_QUERY):
                some = registrations.c.key.in_(wanted[start : start + recipes.KEYS_PER_QUERY])
                query = select(registrations).where(some).order_by(registrations.c.number)
                newest |= {row.key: row for row in connection.execute(query)}
        return [_stored_one(newest[digest], None).registration for digest in wanted if digest in newest]

    def changed_since(self, moment: str, edges: Iterable[StoredRegistration]) -> set[int]:
        """Return the numbers of those current registrations that `optimize` would have used otherwise at a moment."""
        pairs = {":".join(sorted((one.registration.target, one.registration.source))): one for one in edges}
        then: dict[str, EdgeSummary] = {}
        with self._catalog.read() as connection:
            words = connection.execute(select(reviews).order_by(reviews.c.number)).all()
            reviewed = {word.pair for word in words if word.created_at > moment}
            asked = [pair for pair, one in pairs.items() if one.created_at > moment or pair in reviewed]
            earlier = _by_pair([word for word in words if word.created_at <= moment])
            for start in range(0, len(asked), recipes.KEYS_PER_QUERY):
                some = registrations.c.pair.in_(asked[start : start + recipes.KEYS_PER_QUERY])
                query = select(*_SUMMARY_COLUMNS, null(), *_undecoded("proposer")).order_by(registrations.c.number)
                rows = connection.execute(query.where(some, registrations.c.created_at <= moment)).all()
                for pair, of_pair in _by_pair(rows).items():
                    row, review = _find_current(of_pair, map(_review, earlier.get(pair, ())))
                    if row is not None:
                        then[pair] = _summary(tuple(row)[:-1], review, {})
        return {pairs[pair].number for pair in asked if _used(pairs[pair]) != _used(then.get(pair))}

    def stored_keys(self, keys: Iterable[RecipeKey | str], *, after: int = 0) -> set[str]:
        """Return, as digests, the keys that have a registration with a number above ``after``."""
        with self._catalog.read() as connection:
            return recipes.stored_keys(connection, registrations.c.key, keys, registrations.c.number > after)

    def newest_number(self) -> int:
        """Return the number of the newest registration; 0 if there is none."""
        with self._catalog.read() as connection:
            return connection.execute(select(func.max(registrations.c.number))).scalar_one() or 0

    def pairs_registered_after(self, number: int) -> set[tuple[str, str]]:
        """Return the pairs, (lower, higher) by id, that were registered after the registration with a number."""
        query = select(registrations.c.pair).where(registrations.c.number > number)
        with self._catalog.read() as connection:
            found = set(connection.execute(query).scalars())
        return {(a, b) for a, b in (pair.split(":") for pair in found)}

    def history(self, a: str, b: str) -> list[StoredRegistration]:
        """Return every registration of a pair, oldest first."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            rows = _rows_of(connection, pair)
            _, review = _find_current(rows, _reviews_of(connection, pair))
        return [_stored_one(row, review) for row in rows]

    def review(self, a: str, b: str, review: str, note: str = "") -> StoredRegistration | None:
        """Store a person's review of a pair: ``confirm`` its current pose, ``reject`` it, or ``withdraw`` the last
        review.

        Returns:
            The pair's current registration; None if its only one was a measurement that is now withdrawn.

        Raises:
            NotFoundError: the pair was never registered.
            InputError: there is no pose to confirm, its uncertainty is unknown, or there is nothing to withdraw.
            ConfigError: an unknown review.
        """
        if review not in REVIEWS:
            raise ConfigError(f"a review must be one of {', '.join(REVIEWS)}, got {review!r}", code="invalid_choice")
        with self._catalog.write() as connection:
            found = self.get(a, b)
            first, second = scene_name(connection, a), scene_name(connection, b)
            if found is None:
                raise NotFoundError(
                    f"{first} and {second} were never registered: gsmap register MAP --pairs {first}:{second}",
                    code="registration_not_found",
                )
            if review == "confirm" and found.registration.S_target_source is None:
                raise InputError(
                    f"{first} and {second} have no pose to confirm: "
                    f"{found.registration.reason or 'the registration found no pose'}",
                    code="no_pose_of_pair",
                )
            if review == "confirm" and found.registration.information is None:
                raise InputError(
                    f"the pose of {first} and {second} was rejected before its uncertainty was measured: "
                    f"give a pose of your own with gsmap edge MAP {first}:{second}",
                    code="no_uncertainty_of_pair",
                )
            if review == "withdraw" and found.review is None and not found.manual:
                raise InputError(
                    f"the pair {first} and {second} has no review to withdraw",
                    code="nothing_to_withdraw",
                )
            row = {"review": review, "registration": found.number, "note": note, "created_at": now()}
            connection.execute(insert(reviews), row | {"pair": _pair(connection, a, b)})
            return self.get(a, b)

    def reviews(self, a: str, b: str) -> list[Review]:
        """Return all reviews of a pair, oldest first."""
        with self._catalog.read() as connection:
            return _reviews_of(connection, _pair(connection, a, b))

    def _insert(self, connection: Connection, row: dict[str, Any]) -> StoredRegistration:
        number = connection.execute(insert(registrations).returning(registrations.c.number), row).scalar_one()
        stored = connection.execute(select(registrations).where(registrations.c.number == number)).one()
        _, review = _find_current(_rows_of(connection, stored.pair), _reviews_of(connection, stored.pair))
        return _stored_one(stored, review)


class _CurrentRow(NamedTuple):
    """The current row of a pair, and the review in force."""

    row: Row[Any]
    review: Review | None


def _find_current(rows: Sequence[Row[Any]], history: Iterable[Review]) -> tuple[Row[Any] | None, Review | None]:
    """Return the current row of a pair, and its review if one is in force; see `Registrations`.

    Args:
        rows: the pair's registrations, oldest first.
        history: its reviews, oldest first.
    """
    measured = {row.number for row in rows if row.proposer == MANUAL}
    review: Review | None = None
    withdrawn: set[int] = set()
    for one in history:
        if one.review != "withdraw":
            review = one
        elif one.registration in measured and (review is None or review.registration != one.registration):
            withdrawn.add(one.registration)  # the measurement has no review: the measurement itself is withdrawn
        else:
            review = None
    measurement = max(measured - withdrawn, default=None)
    if measurement is not None and (review is None or review.registration <= measurement):
        if review is not None and review.registration < measurement:
            review = None  # older than the measurement
        chosen: int | None = measurement
    elif review is not None and review.review == "confirm":
        chosen = review.registration
    else:
        chosen = max((row.number for row in rows if row.proposer != MANUAL), default=None)
    return next((row for row in rows if row.number == chosen), None), review


def _check_key(r: Registration, key: RecipeKey | None) -> None:
    """Validate that computed registrations have a recipe key, and manual ones have none; see `Registrations.save`."""
    if (r.proposer == MANUAL) != (key is None):
        raise InputError(
            f"a registration needs its recipe key, unless its proposer is {MANUAL!r}", code="invalid_registration"
        )
    if r.proposer == MANUAL and r.status != "accepted":
        raise InputError(
            "a manual registration needs status 'accepted', a pose and an information matrix",
            code="invalid_registration",
        )


def _row_of(r: Registration, pair: str, key: RecipeKey | None, recipe: str | None) -> dict[str, Any]:
    return {
        "target": r.target,
        "source": r.source,
        "pair": pair,
        "key": "" if key is None else key.digest,
        "recipe": recipe,
        "status": r.status,
        "reason": r.reason,
        "S_target_source": r.S_target_source,
        "information": r.information,
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


def _pair(connection: Connection, a: str, b: str) -> str:
    first, second = sorted((resolve(connection, a), resolve(connection, b)))
    if first == second:
        raise InputError(f"{a} and {b} are the same scene: a pair needs two scenes", code="same_scene")
    return f"{first}:{second}"


def _rows_of(connection: Connection, pair: str) -> Sequence[Row[Any]]:
    query = select(registrations).where(registrations.c.pair == pair).order_by(registrations.c.number)
    return connection.execute(query).all()


def _reviews_of(connection: Connection, pair: str) -> list[Review]:
    query = select(reviews).where(reviews.c.pair == pair).order_by(reviews.c.number)
    return [_review(row) for row in connection.execute(query)]


def _review(row: Row[Any]) -> Review:
    return Review(row.review, row.registration, row.note, row.created_at)


# --- current rows of all pairs ---------------------------------------------------------------------------------------

_FULL = tuple(
    type_coerce(column, LargeBinary).label(column.name) if column.name in ("S_target_source", "information") else column
    for column in registrations.columns
)
_BRIEF = tuple(null().label(column.name) if column.name in ("evidence", "notes") else column for column in _FULL)
_POSED = (registrations.c.S_target_source.is_not(None) & registrations.c.information.is_not(None)).label("posed")


def _undecoded(*names: str) -> tuple[ColumnElement[Any], ...]:
    """Return columns without validation, for values that are only compared."""
    return tuple(type_coerce(registrations.c[name], Text).label(name) for name in names)


_SUMMARY_COLUMNS = (registrations.c.number, *_undecoded("target", "source", "pair", "key", "status"), _POSED)
_SAME_PAIR = registrations.alias()
_SUPERSEDED = exists().where(_SAME_PAIR.c.pair == registrations.c.pair, _SAME_PAIR.c.number > registrations.c.number)
_FIRST = (
    select(func.min(_SAME_PAIR.c.number)).where(_SAME_PAIR.c.pair == registrations.c.pair).scalar_subquery()
).label("first")
_EVIDENCE = case((registrations.c.status == "accepted", type_coerce(registrations.c.evidence, Text))).label("evidence")


def _current(
    connection: Connection,
    of: ColumnElement[bool] | None = None,
    unreviewed_if: ColumnElement[bool] | None = None,
    columns: Sequence[ColumnElement[Any]] = _FULL,
) -> list[StoredRegistration]:
    """Return the current registration of every pair of living scenes, ordered by the pair's first row.

    For an unreviewed pair it is the newest, found by the index of pairs without reading the others.

    Args:
        of: only pairs all of whose rows meet this condition.
        unreviewed_if: unreviewed pairs only if their current row meets this condition.
    """
    wanted = true() if of is None else of
    unreviewed = _unreviewed((*columns, _FIRST)).where(wanted, true() if unreviewed_if is None else unreviewed_if)
    found = [(row.first, _CurrentRow(row, None)) for row in connection.execute(unreviewed).all()]
    found = sorted(found + _reviewed(connection, columns, wanted), key=itemgetter(0))
    living = living_ids(connection)
    return _stored_all([one for _, one in found if one.row.target in living and one.row.source in living])


_REVIEWED_PAIRS = select(reviews.c.pair).union(select(registrations.c.pair).where(registrations.c.key == ""))


def _unreviewed(columns: Sequence[ColumnElement[Any]]) -> Select[Any]:
    """Select the newest row of every unreviewed pair."""
    return select(*columns).where(registrations.c.pair.not_in(_REVIEWED_PAIRS), ~_SUPERSEDED)


def _reviewed(
    connection: Connection, columns: Sequence[ColumnElement[Any]], wanted: ColumnElement[bool]
) -> list[tuple[int, _CurrentRow]]:
    """Return the current row of every pair with a review or a manual measurement, with the number of its first row."""
    ordered = select(*columns).order_by(registrations.c.pair, registrations.c.number)
    every = connection.execute(ordered.where(wanted, registrations.c.pair.in_(_REVIEWED_PAIRS))).all()
    ordered_reviews = select(reviews).order_by(reviews.c.pair, reviews.c.number)
    review_rows = connection.execute(ordered_reviews).all() if every else ()
    by_pair = {pair: [_review(row) for row in rows] for pair, rows in groupby(review_rows, lambda row: str(row.pair))}
    found = []
    for pair, of_pair in groupby(every, lambda row: str(row.pair)):
        history = list(of_pair)
        current, review = _find_current(history, by_pair.get(pair, []))
        if current is not None:
            found.append((history[0].number, _CurrentRow(current, review)))
    return found


_OBJECT = JsonText(is_object).for_column("registrations.evidence")
_ALL_SUMMARY_ROWS = select(*_SUMMARY_COLUMNS, _EVIDENCE).order_by(registrations.c.number)


def _fingerprint(connection: Connection, upto: int) -> tuple[str, str] | None:
    """Return values that distinguish registrations with the same number; None without a row."""
    query = select(registrations.c.key, registrations.c.created_at).where(registrations.c.number == upto)
    row = connection.execute(query).first()
    return None if row is None else (row.key, row.created_at)


def _add_summaries(summaries: dict[str, EdgeSummary], rows: Iterable[Sequence[Any]]) -> None:
    """Update the summaries of unreviewed pairs by later registrations, oldest first."""
    for number, target, source, pair, key, status, posed, evidence in rows:
        before = summaries.get(pair)
        keys = None if before is None else before.keys | {key} - {""}
        usable = bool(posed) and _is_usable(status, None)
        summaries[pair] = EdgeSummary(number, target, source, pair, key, None, usable, *_figures(evidence), keys)


def _unreviewed_summaries(connection: Connection, wanted: ColumnElement[bool]) -> list[EdgeSummary]:
    """Return summaries of unreviewed pairs, without evidence and history keys."""
    rows = connection.execute(_unreviewed((*_SUMMARY_COLUMNS, null())).where(wanted)).all()
    return [_summary(tuple(row), None, {}) for row in rows]


def _reviewed_summaries(connection: Connection) -> list[EdgeSummary]:
    """Return summaries of reviewed and measured pairs."""
    found = _reviewed(connection, (*_SUMMARY_COLUMNS, _EVIDENCE, *_undecoded("proposer")), true())
    history_keys = _keys_of_repeated_pairs(connection, registrations.c.pair.in_(_REVIEWED_PAIRS)) if found else {}
    return [_summary(tuple(one.row)[:-1], one.review, history_keys) for _, one in found]


def _keys_of_repeated_pairs(connection: Connection, wanted: ColumnElement[bool]) -> dict[str, set[str]]:
    """Return all keys of pairs that were registered more than once."""
    repeated = select(registrations.c.pair).where(wanted).group_by(registrations.c.pair).having(func.count() > 1)
    again = select(registrations.c.pair, registrations.c.key).where(registrations.c.pair.in_(repeated))
    keys: dict[str, set[str]] = {}
    for pair, key in connection.execute(again).all():
        keys.setdefault(pair, set()).add(key)
    return keys


def _is_usable(status: str, review: str | None) -> bool:
    return review == "confirm" or (status == "accepted" and review != "reject")


def _used(one: StoredRegistration | EdgeSummary | None) -> tuple[str | int, str | None] | None:
    """Return what identifies a pair's registration to `optimize`; None if it uses none."""
    if one is None or not (one.is_usable if isinstance(one, StoredRegistration) else one.usable):
        return None
    return one.key or one.number, one.review


def _by_pair(rows: Iterable[Any]) -> dict[str, list[Row[Any]]]:
    found: dict[str, list[Row[Any]]] = {}
    for row in rows:
        found.setdefault(str(row.pair), []).append(row)
    return found


_ends_of = attrgetter("target", "source")


def _summary(row: tuple[Any, ...], review: Review | None, history_keys: Mapping[str, set[str]]) -> EdgeSummary:
    number, target, source, pair, key, status, posed, evidence = row
    value = None if review is None else review.review
    usable = bool(posed) and _is_usable(status, value)
    keys = frozenset(history_keys[pair] - {""}) if pair in history_keys else None
    return EdgeSummary(number, target, source, pair, key, value, usable, *_figures(evidence), keys)


def _figures(evidence: str | None) -> tuple[float, float]:
    """Parse the figures of the evidence that summaries hold."""
    if evidence is None:
        return _UNKNOWN, _UNKNOWN
    return _figure(evidence, "look_alike"), _figure(evidence, "disagreement")


def _figure(evidence: str, name: str) -> float:
    """Parse one figure of the evidence, without decoding the rest of the JSON object."""
    if f'"{name}"' not in evidence:
        return _UNKNOWN
    _, named, after = evidence.partition(f'"{name}":')
    if named and evidence.count("{") == 1 and f'"{name}"' not in after:
        with suppress(ValueError):
            return float(after[: after.find("," if "," in after else "}")])
    return float(_OBJECT.process_result_value(evidence, None).get(name, _UNKNOWN))


def _stored_all(chosen: Sequence[_CurrentRow]) -> list[StoredRegistration]:
    """Convert rows as `_stored` does, decoding poses and matrices all at once."""
    rows = [one.row for one in chosen]
    with malformed_as_corrupt("a value in registrations.S_target_source"):
        poses = iter(poses_of_bytes([bytes(r.S_target_source) for r in rows if r.S_target_source is not None]))
    with malformed_as_corrupt("a value in registrations.information"):
        matrices = iter(matrices_of_bytes([bytes(r.information) for r in rows if r.information is not None]))
    return [
        _stored(
            one.row,
            one.review,
            None if one.row.S_target_source is None else next(poses),
            None if one.row.information is None else next(matrices),
        )
        for one in chosen
    ]


def _stored_one(row: Row[Any], review: Review | None) -> StoredRegistration:
    return _stored(row, review, row.S_target_source, row.information)


def _stored(
    row: Row[Any], review: Review | None, S_target_source: Sim3 | None, information: np.ndarray | None
) -> StoredRegistration:
    registration = Registration(
        target=row.target,
        source=row.source,
        status=row.status,
        reason=row.reason,
        S_target_source=S_target_source,
        information=information,
        num_inliers=row.num_inliers,
        num_correspondences=row.num_correspondences,
        overlap=row.overlap,
        proposer=row.proposer,
        exact=bool(row.exact),
        seconds=row.seconds,
        evidence=row.evidence or {},
        notes=tuple(row.notes or ()),
    )
    value = None if review is None else review.review
    return StoredRegistration(row.number, registration, row.key, row.created_at, value, row.recipe, row.adopts)
