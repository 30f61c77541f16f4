"""Registrations of pairs of scenes, and what people said of them. Nothing is overwritten."""

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
from gsmap.store.columns import Json, an_object, not_ours
from gsmap.store.matrices import matrices_of_bytes, poses_of_bytes
from gsmap.store.scene_refs import living_ids, resolve, scene_name
from gsmap.store.schema import registrations, reviews, scenes
from gsmap.types import Registration, Sim3
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

    @property
    def is_usable(self) -> bool:
        """Whether it has a pose, and a person confirmed it, or it was accepted and nobody rejected it."""
        posed = self.registration.S_target_source is not None and self.registration.information is not None
        return posed and _may_be_used(self.registration.status, self.review)


_UNKNOWN = float("nan")


class Standing(NamedTuple):  # of every pair of a map, with every update: a tuple is made in a tenth of the time
    """What counts of a pair, without its figures: all that decides whether it is used; see `StoredRegistration`.

    Args:
        pair: both ids with a colon between them, the lower first.
        usable: as `StoredRegistration.is_usable`.
        disagreement: of what both scenes saw, by what counts; NaN where that is not known, it was not accepted, or not
            asked for.
        several: keys of all that was computed for the pair; None where it was registered once, or that was not asked.
    """

    number: int
    target: str
    source: str
    pair: str
    key: str
    review: str | None
    usable: bool
    disagreement: float = _UNKNOWN
    several: frozenset[str] | None = None

    @property
    def manual(self) -> bool:
        """Whether a person measured it."""
        return not self.key

    @property
    def is_told(self) -> bool:
        """Whether a person measured or confirmed it."""
        return self.manual or self.review == "confirm"

    @property
    def keys(self) -> frozenset[str]:
        """Of all that was computed for the pair, where that was asked for."""
        return frozenset((self.key,) if self.key else ()) if self.several is None else self.several


@dataclass(frozen=True)
class Review:
    """A person's word on a pair (``confirm``, ``reject``, ``withdraw``), given when ``registration`` was current."""

    review: str
    registration: int
    note: str
    created_at: str


class Registrations:
    """The edges of a map. A pair is the same pair in either direction; a registration keeps its own.

    A pair's *current* registration is, first of all, what a person said last: the pose that was confirmed, or that was
    measured by hand (proposer ``manual``); else the newest. ``withdraw`` takes back the last word that stands: a
    review, or else a measurement.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._silent: dict[str, Standing] = {}
        self._read_upto: tuple[int, tuple[Any, ...]] = (0, ())

    def save(self, registration: Registration, key: RecipeKey | None = None) -> StoredRegistration:
        """Add a registration to its pair's history; it is the pair's current one from now on, unless a person spoke.

        Args:
            key: its recipe and inputs; None for a person's own measurement only.

        Raises:
            InputError: a computed registration without a key, or a measurement with one or without a pose.
        """
        _check_told(registration, key)
        with self._catalog.write() as connection:
            pair = _pair(connection, registration.target, registration.source)
            return self._insert(connection, _row_of(registration, pair, key, recipes.keep(connection, key)))

    def save_all(self, made: Sequence[tuple[Registration, RecipeKey]]) -> None:
        """As `save`, of many that were computed, each with its key, in a few statements; scenes by their ids.

        Raises:
            InputError: as `save`; a registration of what is no scene, or of one scene alone. Nothing is kept then.
        """
        for registration, key in made:
            _check_told(registration, key)
        if not made:
            return
        wanted = {scene for registration, _ in made for scene in (registration.target, registration.source)}
        with self._catalog.write() as connection:
            known = recipes.kept(connection, scenes.c.id, wanted)
            by_recipe = {key.recipe: key for _, key in made}
            kept = {digest: recipes.keep(connection, key) for digest, key in by_recipe.items()}
            rows = []
            for registration, key in made:
                a, b = sorted((registration.target, registration.source))
                if a == b or not {a, b} <= known:
                    raise InputError(
                        f"a registration is of two scenes of the map, by their ids, got {a} and {b}",
                        code="invalid_registration",
                    )
                rows.append(_row_of(registration, f"{a}:{b}", key, kept[key.recipe]))
            connection.execute(insert(registrations), rows)

    def adopt(self, number: int) -> StoredRegistration:
        """Make an earlier registration the newest of its pair again, as if it had just been computed.

        So a map that goes back to older settings has its older edges again. Nothing is written where it is the newest.

        Raises:
            NotFoundError: no such registration.
        """
        with self._catalog.write() as connection:
            row = connection.execute(select(registrations).where(registrations.c.number == number)).first()
            if row is None:
                raise NotFoundError(f"no registration {number} in this map", code="registration_not_found")
            if row.proposer == MANUAL:
                raise InputError(
                    f"registration {number} was measured by a person: save it again instead",
                    code="registration_measured",
                )
            pair = _rows_of(connection, row.pair)
            newest = [r for r in pair if r.proposer != MANUAL][-1]
            original = row.number if row.adopts is None else row.adopts
            if original in (newest.number, newest.adopts):
                return _stored_one(newest, _decide(pair, _reviews_of(connection, row.pair))[1])
            copied = {name: value for name, value in row._mapping.items() if name != "number"}
            return self._insert(connection, copied | {"adopts": original, "created_at": now()})

    def current(self, *, brief: bool = False) -> list[StoredRegistration]:
        """The current registration of each pair of living scenes, by the pair's first registration.

        Args:
            brief: without evidence and notes, which are most of what there is to read.
        """
        with self._catalog.read() as connection:
            return _current(connection, columns=_BRIEF if brief else _FULL)

    def current_of(self, scene: str) -> list[StoredRegistration]:
        """The same of the pairs of one scene (id)."""
        mine = or_(registrations.c.target == scene, registrations.c.source == scene)
        with self._catalog.read() as connection:
            return _current(connection, mine)

    def current_of_pairs(self, pairs: Iterable[tuple[str, str]]) -> list[StoredRegistration]:
        """The same of some pairs of scenes (ids), in either direction."""
        wanted = sorted({":".join(sorted(pair)) for pair in pairs})
        found: list[StoredRegistration] = []
        with self._catalog.read() as connection:
            for start in range(0, len(wanted), recipes.ASKED_AT_ONCE):
                some = wanted[start : start + recipes.ASKED_AT_ONCE]
                found += _current(connection, registrations.c.pair.in_(some))
        return found

    def standing(self, *, usable: bool = False) -> list[Standing]:
        """What counts of each pair of living scenes, by (target, source); no matrix of any is read.

        Where `tried` was asked before, what it remembers is not read again.

        Args:
            usable: only those that are (`Standing.usable`).
        """
        with self._catalog.read() as connection:
            if self._silent:
                made = self.tried()
            else:
                wanted = registrations.c.status == "accepted" if usable else true()
                made = _of_silent(connection, wanted) + _of_spoken(connection)
            alive = living_ids(connection)
        found = (one for one in made if (one.usable or not usable) and one.target in alive and one.source in alive)
        return sorted(found, key=_ends_of)

    def noted(self, text: str) -> list[StoredRegistration]:
        """The current registrations of which a note begins with a text, by the pair's first registration."""
        notes = type_coerce(registrations.c.notes, Text).contains(text, autoescape=True)
        with self._catalog.read() as connection:
            found = _current(connection, silent_if=notes)
        return [one for one in found if any(note.startswith(text) for note in one.registration.notes)]

    def tried(self) -> list[Standing]:
        """The same of every pair, of scenes living or not, with what else was computed for it, in any order.

        Registering asks this twice an update, so what was read is remembered: of rows that stay as they are, only new
        ones are read again.
        """
        with self._catalog.read() as connection:
            count = connection.execute(select(func.count()).select_from(registrations)).scalar_one()
            upto, then = self._read_upto
            new = connection.execute(_EVERY.where(registrations.c.number > upto)).all()
            if upto and then != (count - len(new), _last(connection, upto)):
                self._silent.clear()
                upto, new = 0, connection.execute(_EVERY).all()
            _add(self._silent, new)
            upto = new[-1].number if new else upto
            self._read_upto = upto, (count, _last(connection, upto))
            spoken = _of_spoken(connection)
            said = set(connection.execute(_SPOKEN).scalars()) if spoken else set()
        if not said:
            return list(self._silent.values())
        return [one for pair, one in self._silent.items() if pair not in said] + spoken

    def keys(self) -> list[tuple[str, str]]:
        """Each pair (`Standing.pair`) with the key of what counts of it; empty where that is a person's word."""
        every = select(*_as_they_lie("pair", "key")).order_by(registrations.c.number)
        with self._catalog.read() as connection:
            keys = {row[0]: row[1] for row in connection.execute(every).all()}  # the newest stays
            spoken = _of_spoken(connection)
            for pair in connection.execute(_SPOKEN).scalars() if spoken else ():
                keys.pop(pair, None)
        return [*keys.items(), *((one.pair, "" if one.is_told else one.key) for one in spoken)]

    def usable(self, among: Collection[str] | None = None) -> list[StoredRegistration]:
        """The current registrations that may be used (`Standing.usable`) and have a pose, by (target, source).

        Args:
            among: only those both of whose scenes (ids) are among these.
        """
        inside = None
        if among is not None:
            some = sorted(among)
            inside = registrations.c.target.in_(some) & registrations.c.source.in_(some)
        with self._catalog.read() as connection:
            found = _current(connection, inside, silent_if=registrations.c.status == "accepted")
        found = [one for one in found if one.is_usable]
        return sorted(found, key=lambda one: (one.registration.target, one.registration.source))

    def get(self, a: str, b: str) -> StoredRegistration | None:
        """The current registration of a pair (scene refs, either direction); None where there is none."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            row, word = _decide(_rows_of(connection, pair), _reviews_of(connection, pair))
        return None if row is None else _stored_one(row, word)

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
            _, word = _decide(_rows_of(connection, row.pair), _reviews_of(connection, row.pair))
        return _stored_one(row, word)

    def found(self, keys: Iterable[RecipeKey | str]) -> list[Registration]:
        """The newest registration under each of the keys (or their digests) that has any, in the order of these."""
        wanted = list(dict.fromkeys(digest for key in keys if (digest := recipes.digest_of(key))))
        newest: dict[str, Row[Any]] = {}
        with self._catalog.read() as connection:
            for start in range(0, len(wanted), recipes.ASKED_AT_ONCE):
                some = registrations.c.key.in_(wanted[start : start + recipes.ASKED_AT_ONCE])
                query = select(registrations).where(some).order_by(registrations.c.number)
                newest |= {row.key: row for row in connection.execute(query)}
        return [_stored_one(newest[digest], None).registration for digest in wanted if digest in newest]

    def kept(self, keys: Iterable[RecipeKey | str], *, after: int = 0) -> set[str]:
        """Those of the keys (as digests) that a registration is kept under, made later than the one of a number."""
        with self._catalog.read() as connection:
            return recipes.kept(connection, registrations.c.key, keys, registrations.c.number > after)

    def newest(self) -> int:
        """Number of the newest registration; 0 where there is none."""
        with self._catalog.read() as connection:
            return connection.execute(select(func.max(registrations.c.number))).scalar_one() or 0

    def pairs_after(self, number: int) -> set[tuple[str, str]]:
        """(lower, higher) by id of the pairs that were registered after the registration of a number."""
        query = select(registrations.c.pair).where(registrations.c.number > number)
        with self._catalog.read() as connection:
            found = set(connection.execute(query).scalars())
        return {(a, b) for a, b in (pair.split(":") for pair in found)}

    def history(self, a: str, b: str) -> list[StoredRegistration]:
        """Every registration of a pair, oldest first."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            rows = _rows_of(connection, pair)
            _, word = _decide(rows, _reviews_of(connection, pair))
        return [_stored_one(row, word) for row in rows]

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
            raise ConfigError(f"a review is one of {', '.join(REVIEWS)}, got {review!r}", code="invalid_choice")
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
                    f"{first} and {second} have no pose to confirm: {found.registration.reason or 'none was found'}",
                    code="no_pose_of_pair",
                )
            if review == "withdraw" and found.review is None and not found.manual:
                raise InputError(
                    f"nobody has reviewed {first} and {second}: there is nothing to withdraw",
                    code="nothing_to_withdraw",
                )
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
        _, word = _decide(_rows_of(connection, stored.pair), _reviews_of(connection, stored.pair))
        return _stored_one(stored, word)


class _Choice(NamedTuple):
    """A pair's current row, and the review that stands on it."""

    row: Row[Any]
    word: Review | None


def _decide(rows: Sequence[Row[Any]], said: Iterable[Review]) -> tuple[Row[Any] | None, Review | None]:
    """What counts of a pair, and the word that stands: its rows and reviews, both oldest first. See `Registrations`."""
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
    return next((row for row in rows if row.number == chosen), None), word


def _check_told(r: Registration, key: RecipeKey | None) -> None:
    """What a registration's row asks beside its figures; see `Registrations.save`."""
    if (r.proposer == MANUAL) != (key is None):
        raise InputError(
            f"a registration needs its recipe key, unless its proposer is {MANUAL!r}", code="invalid_registration"
        )
    if r.proposer == MANUAL and r.status != "accepted":
        raise InputError(
            "a measured registration has status 'accepted', a pose and an information matrix",
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
        raise InputError(f"{a} and {b} are the same scene: a pair needs two", code="same_scene")
    return f"{first}:{second}"


def _rows_of(connection: Connection, pair: str) -> Sequence[Row[Any]]:
    query = select(registrations).where(registrations.c.pair == pair).order_by(registrations.c.number)
    return connection.execute(query).all()


def _reviews_of(connection: Connection, pair: str) -> list[Review]:
    query = select(reviews).where(reviews.c.pair == pair).order_by(reviews.c.number)
    return [_review(row) for row in connection.execute(query)]


def _review(row: Row[Any]) -> Review:
    return Review(row.review, row.registration, row.note, row.created_at)


# --- what counts of every pair ---------------------------------------------------------------------------------------

_FULL = tuple(
    type_coerce(column, LargeBinary).label(column.name) if column.name in ("S_target_source", "information") else column
    for column in registrations.columns
)
_BRIEF = tuple(null().label(column.name) if column.name in ("evidence", "notes") else column for column in _FULL)
_POSED = (registrations.c.S_target_source.is_not(None) & registrations.c.information.is_not(None)).label("posed")


def _as_they_lie(*names: str) -> tuple[ColumnElement[Any], ...]:
    """Scenes that are none of the living ones are left out, and the rest is compared with."""
    return tuple(type_coerce(registrations.c[name], Text).label(name) for name in names)


_LEAN = (registrations.c.number, *_as_they_lie("target", "source", "pair", "key", "status"), _POSED)
_SAME_PAIR = registrations.alias()
_OUTDATED = exists().where(_SAME_PAIR.c.pair == registrations.c.pair, _SAME_PAIR.c.number > registrations.c.number)
_FIRST = (
    select(func.min(_SAME_PAIR.c.number)).where(_SAME_PAIR.c.pair == registrations.c.pair).scalar_subquery()
).label("first")
_EVIDENCE = case((registrations.c.status == "accepted", type_coerce(registrations.c.evidence, Text))).label("evidence")


def _current(
    connection: Connection,
    of: ColumnElement[bool] | None = None,
    silent_if: ColumnElement[bool] | None = None,
    columns: Sequence[ColumnElement[Any]] = _FULL,
) -> list[StoredRegistration]:
    """What counts of every pair of living scenes, by the pair's first row.

    Of a pair on which nobody ever spoke it is the newest, which the index of pairs tells without reading the others.

    Args:
        of: only pairs all of whose rows meet this.
        silent_if: pairs on which nobody spoke only if their current row meets this.
    """
    wanted = true() if of is None else of
    silent = _silent((*columns, _FIRST)).where(wanted, true() if silent_if is None else silent_if)
    found = [(row.first, _Choice(row, None)) for row in connection.execute(silent).all()]
    found = sorted(found + _spoken(connection, columns, wanted), key=itemgetter(0))
    alive = living_ids(connection)
    return _stored_all([one for _, one in found if one.row.target in alive and one.row.source in alive])


_SPOKEN = select(reviews.c.pair).union(select(registrations.c.pair).where(registrations.c.key == ""))


def _silent(columns: Sequence[ColumnElement[Any]]) -> Select[Any]:
    """The newest row of every pair on which nobody ever spoke."""
    return select(*columns).where(registrations.c.pair.not_in(_SPOKEN), ~_OUTDATED)


def _spoken(
    connection: Connection, columns: Sequence[ColumnElement[Any]], wanted: ColumnElement[bool]
) -> list[tuple[int, _Choice]]:
    """What counts of every other pair that has any, each behind the number of the pair's first row."""
    ordered = select(*columns).order_by(registrations.c.pair, registrations.c.number)
    every = connection.execute(ordered.where(wanted, registrations.c.pair.in_(_SPOKEN))).all()
    said = connection.execute(select(reviews).order_by(reviews.c.pair, reviews.c.number)).all() if every else ()
    words = {pair: [_review(row) for row in of_pair] for pair, of_pair in groupby(said, lambda row: str(row.pair))}
    found = []
    for pair, of_pair in groupby(every, lambda row: str(row.pair)):
        history = list(of_pair)
        current, word = _decide(history, words.get(pair, []))
        if current is not None:
            found.append((history[0].number, _Choice(current, word)))
    return found


_OBJECT = Json(an_object).at("registrations.evidence")
_EVERY = select(*_LEAN, _EVIDENCE).order_by(registrations.c.number)


def _last(connection: Connection, upto: int) -> tuple[str, str] | None:
    """What tells a registration from another one of its number; None where there is none."""
    query = select(registrations.c.key, registrations.c.created_at).where(registrations.c.number == upto)
    row = connection.execute(query).first()
    return None if row is None else (row.key, row.created_at)


def _add(standing: dict[str, Standing], rows: Iterable[Sequence[Any]]) -> None:
    """Let registrations, oldest first, stand in place of those before them: what counts where nobody ever spoke."""
    for number, target, source, pair, key, status, posed, evidence in rows:
        before = standing.get(pair)
        keys = None if before is None else before.keys | {key} - {""}
        disagreement = _UNKNOWN if evidence is None else _disagreement(evidence)
        usable = bool(posed) and _may_be_used(status, None)
        standing[pair] = Standing(number, target, source, pair, key, None, usable, disagreement, keys)


def _of_silent(connection: Connection, wanted: ColumnElement[bool]) -> list[Standing]:
    """What counts of pairs on which nobody ever spoke, without what disagrees and what else was computed."""
    rows = connection.execute(_silent((*_LEAN, null())).where(wanted)).all()
    return [_stands(tuple(row), None, {}) for row in rows]


def _of_spoken(connection: Connection) -> list[Standing]:
    """What counts of all others."""
    found = _spoken(connection, (*_LEAN, _EVIDENCE, *_as_they_lie("proposer")), true())
    several = _several(connection, registrations.c.pair.in_(_SPOKEN)) if found else {}
    return [_stands(tuple(one.row)[:-1], one.word, several) for _, one in found]


def _several(connection: Connection, wanted: ColumnElement[bool]) -> dict[str, set[str]]:
    """By pairs that were registered more than once, all keys of theirs."""
    repeated = select(registrations.c.pair).where(wanted).group_by(registrations.c.pair).having(func.count() > 1)
    again = select(registrations.c.pair, registrations.c.key).where(registrations.c.pair.in_(repeated))
    keys: dict[str, set[str]] = {}
    for pair, key in connection.execute(again).all():
        keys.setdefault(pair, set()).add(key)
    return keys


def _may_be_used(status: str, review: str | None) -> bool:
    return review == "confirm" or (status == "accepted" and review != "reject")


_ends_of = attrgetter("target", "source")


def _stands(row: tuple[Any, ...], word: Review | None, several: Mapping[str, set[str]]) -> Standing:
    number, target, source, pair, key, status, posed, evidence = row
    disagreement = _UNKNOWN if evidence is None else _disagreement(evidence)
    review = None if word is None else word.review
    usable = bool(posed) and _may_be_used(status, review)
    keys = frozenset(several[pair] - {""}) if pair in several else None
    return Standing(number, target, source, pair, key, review, usable, disagreement, keys)


def _disagreement(evidence: str) -> float:
    """One number of a dozen; where they are a flat object and it is there once, the others are not made."""
    _, named, after = evidence.partition('"disagreement":')
    if named and evidence.count("{") == 1 and '"disagreement"' not in after:
        with suppress(ValueError):
            return float(after[: after.find("," if "," in after else "}")])
    return float(_OBJECT.process_result_value(evidence, None).get("disagreement", _UNKNOWN))


def _stored_all(chosen: Sequence[_Choice]) -> list[StoredRegistration]:
    """As `_stored`; poses and matrices are taken from their bytes all at once."""
    rows = [one.row for one in chosen]
    with not_ours("registrations.S_target_source"):
        poses = iter(poses_of_bytes([bytes(r.S_target_source) for r in rows if r.S_target_source is not None]))
    with not_ours("registrations.information"):
        matrices = iter(matrices_of_bytes([bytes(r.information) for r in rows if r.information is not None]))
    return [
        _stored(
            one.row,
            one.word,
            None if one.row.S_target_source is None else next(poses),
            None if one.row.information is None else next(matrices),
        )
        for one in chosen
    ]


def _stored_one(row: Row[Any], word: Review | None) -> StoredRegistration:
    return _stored(row, word, row.S_target_source, row.information)


def _stored(
    row: Row[Any], word: Review | None, S_target_source: Sim3 | None, information: np.ndarray | None
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
    review = None if word is None else word.review
    return StoredRegistration(row.number, registration, row.key, row.created_at, review, row.recipe, row.adopts)
