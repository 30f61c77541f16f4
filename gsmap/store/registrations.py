"""Registrations of pairs of scenes, and what people said of them. Nothing is overwritten."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, Row, insert, select

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, plain, to_array, to_pose
from gsmap.store.scenes import living_ids, resolve
from gsmap.store.schema import registrations, verdicts
from gsmap.types import Registration

VERDICTS = ("confirm", "reject", "withdraw")


@dataclass(frozen=True, eq=False)
class StoredRegistration:
    """A registration and its place in the history.

    Args:
        number: unique in the map, growing.
        key: digest of what it was computed from (graph keys and parameters), as given to `Registrations.save`.
        verdict: a person's standing word on the pair: ``confirm``, ``reject`` or None.
    """

    number: int
    registration: Registration
    key: str
    created_at: str
    verdict: str | None = None


@dataclass(frozen=True)
class Verdict:
    """A person's word on a pair, given when ``registration`` (a number) was current."""

    verdict: str
    registration: int
    note: str
    created_at: str


class Registrations:
    """The edges of a map. A pair is the same pair in either direction; a registration keeps its own."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def save(self, registration: Registration, key: str = "") -> StoredRegistration:
        """Add a registration to its pair's history; it is the pair's current one from now on (but see `current`)."""
        r = registration
        with self._catalog.write() as connection:
            pair = _pair(connection, r.target, r.source)
            row = {
                "target": r.target,
                "source": r.source,
                "pair": pair,
                "key": key,
                "status": r.status,
                "reason": r.reason,
                "S_target_source": from_pose(r.S_target_source),
                "information": from_array(r.information),
                "num_inliers": int(r.num_inliers),
                "num_correspondences": int(r.num_correspondences),
                "overlap": float(r.overlap),
                "method": r.proposer,
                "exact": int(r.exact),
                "seconds": plain(r.seconds),
                "evidence": plain(r.evidence),
                "created_at": now(),
            }
            number = connection.execute(insert(registrations).returning(registrations.c.number), row).scalar_one()
            stored = connection.execute(select(registrations).where(registrations.c.number == number)).one()
            return _stored(stored, _standing(connection).get(pair))

    def current(self) -> list[StoredRegistration]:
        """One registration for each pair of living scenes: the newest, or the one that a person confirmed."""
        with self._catalog.read() as connection:
            alive, standing = living_ids(connection), _standing(connection)
            rows = connection.execute(select(registrations).order_by(registrations.c.number)).all()
        chosen: dict[str, Row] = {}
        for row in rows:
            word = standing.get(row.pair)
            superseded = word is not None and word.verdict == "confirm" and row.number > word.registration
            if row.target in alive and row.source in alive and not superseded:
                chosen[row.pair] = row
        return [_stored(row, standing.get(row.pair)) for row in chosen.values()]

    def get(self, a: str, b: str) -> StoredRegistration | None:
        """The current registration of a pair (scene refs, either direction); None where there was none."""
        history = self.history(a, b)
        if not history:
            return None
        words = self.verdicts(a, b)
        if words and words[-1].verdict == "confirm":
            return next(r for r in history if r.number == words[-1].registration)
        return history[-1]

    def find(self, key: str) -> StoredRegistration | None:
        """The newest registration that was computed from exactly this; None where none was."""
        query = select(registrations).where(registrations.c.key == key).order_by(registrations.c.number.desc())
        with self._catalog.read() as connection:
            row = connection.execute(query).first()
            return None if row is None else _stored(row, _standing(connection).get(row.pair))

    def history(self, a: str, b: str) -> list[StoredRegistration]:
        """Every registration of a pair, oldest first."""
        with self._catalog.read() as connection:
            pair = _pair(connection, a, b)
            query = select(registrations).where(registrations.c.pair == pair).order_by(registrations.c.number)
            word = _standing(connection).get(pair)
            return [_stored(row, word) for row in connection.execute(query)]

    def judge(self, a: str, b: str, verdict: str, note: str = "") -> StoredRegistration:
        """Write down a person's word on a pair: ``confirm`` its current pose, ``reject`` it, or ``withdraw`` the word.

        Raises:
            NotFoundError: the pair was never registered.
            InputError: there is no pose to confirm.
            ConfigError: another word.
        """
        if verdict not in VERDICTS:
            raise ConfigError(f"a verdict is one of {', '.join(VERDICTS)}, got {verdict!r}")
        with self._catalog.write() as connection:
            found = self.get(a, b)
            if found is None:
                raise NotFoundError(f"{a} and {b} were never registered: gsmap register MAP --pairs {a}:{b}")
            if verdict == "confirm" and found.registration.S_target_source is None:
                raise InputError(
                    f"{a} and {b} have no pose to confirm: {found.registration.reason or 'none was found'}"
                )
            row = {"verdict": verdict, "registration": found.number, "note": note, "created_at": now()}
            connection.execute(insert(verdicts), row | {"pair": _pair(connection, a, b)})
            judged = self.get(a, b)
        assert judged is not None
        return judged

    def verdicts(self, a: str, b: str) -> list[Verdict]:
        """Everything people said of a pair, oldest first."""
        with self._catalog.read() as connection:
            query = select(verdicts).where(verdicts.c.pair == _pair(connection, a, b)).order_by(verdicts.c.number)
            return [_verdict(row) for row in connection.execute(query)]


def _pair(connection: Connection, a: str, b: str) -> str:
    first, second = sorted((resolve(connection, a), resolve(connection, b)))
    if first == second:
        raise InputError(f"{a} and {b} are the same scene: a pair needs two")
    return f"{first}:{second}"


def _standing(connection: Connection) -> dict[str, Verdict]:
    """The last word on each pair, unless it was withdrawn."""
    last = {row.pair: _verdict(row) for row in connection.execute(select(verdicts).order_by(verdicts.c.number))}
    return {pair: word for pair, word in last.items() if word.verdict != "withdraw"}


def _verdict(row: Row) -> Verdict:
    return Verdict(row.verdict, row.registration, row.note, row.created_at)


def _stored(row: Row, word: Verdict | None) -> StoredRegistration:
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
        proposer=row.method,
        exact=bool(row.exact),
        seconds=row.seconds,
        evidence=row.evidence,
    )
    return StoredRegistration(row.number, registration, row.key, row.created_at, word.verdict if word else None)
