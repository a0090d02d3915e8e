"""The store: what came, what was made of it and what goes out, committed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TypeVar

import sqlalchemy as sa

from servotwin.errors import InvalidInput
from servotwin.store import audit, lending, outcomes, putting, reading
from servotwin.store.address import address_of, shown
from servotwin.store.engine import Engines, engines_of, lost_race, transaction
from servotwin.store.errors import StoreUnavailable
from servotwin.store.links import Found, Held, Link
from servotwin.store.migrate import migrate
from servotwin.store.rows import Claim, Incoming, Kind, Outcome, Posted, Put, Stored, Summary, Waiting

WORK_KINDS = (Kind.WINDOW, Kind.LETTER)
_RACES = 8
HIGHEST_HEARD = 2**52
"""Of the serials that an edge may say to have heard: messages count to twice as far."""

_Result = TypeVar("_Result")


class Store:
    """A database of messages, evidence and twins; any thread may use it.

    Every method that writes returns when the transaction is on the disk, and raises StoreUnavailable when it could not
    be: then nothing of it was written. Those that read raise the same. Times are s since the epoch and come from
    outside: processes that share a database need clocks that agree to a small part of a lease.

    Parameters
    ----------
    engines : Engines
        Of a database that is up to date: `open_store` makes them.
    """

    def __init__(self, engines: Engines) -> None:
        self.engines = engines

    @property
    def name(self) -> str:
        """Where it is, for people; without a password."""
        return shown(self.engines.writer.url)

    def close(self) -> None:
        """Close every connection."""
        self.engines.dispose()

    def put(self, items: Sequence[Incoming]) -> list[Put]:
        """Keep messages, all in one transaction; what became of each.

        CONFLICT: another message has the same key, and stays.
        """
        return self._written(lambda connection: putting.put(connection, items))

    def commit(self, made: Sequence[Outcome], now: float) -> list[bool]:
        """Commit outcomes, all in one transaction; whether each was valid, or void for another one before it.

        Raises
        ------
        ValueError, sqlalchemy.exc.IntegrityError
            An outcome covers a message that is not an unprocessed one of its servo, or names no context: nothing is
            written.
        """
        return self._written(lambda connection: outcomes.commit(connection, made, now))

    def write(self, items: Sequence[Incoming], made: Sequence[Outcome], now: float) -> tuple[list[Put], list[bool]]:
        """`put` and `commit` in one transaction."""
        return self._written(lambda c: (putting.put(c, items), outcomes.commit(c, made, now)))

    def claim(
        self,
        owner: str,
        limit: int,
        lease_s: float,
        now: float,
        kinds: Collection[Kind] = WORK_KINDS,
        per_servo: int = 16,
        servo: str | None = None,
    ) -> list[Claim]:
        """Borrow servos that have unprocessed messages of these kinds, or that are due to be woken.

        A servo is lent once at a time, until its outcome is committed, it is released, or `lease_s` s are over. Being
        due counts only where windows or letters are asked for.

        Parameters
        ----------
        owner : str
            Who borrows: unique among all processes.
        limit, per_servo : int
            Servos, and messages of each, at most.
        lease_s, now : float
            s; s since the epoch.
        servo : str, optional
            Only this one.
        """
        lent = self._written(lambda c: lending.lend(c, owner, limit, now + lease_s, now, kinds, servo))
        if not lent:
            return []
        with transaction(self.engines.reader) as connection:
            found = lending.claims(connection, lent, kinds, per_servo)
            due = lending.woken(connection, lent, now)
        vain = {claim.servo for claim in found if not claim.messages and claim.servo not in due}
        if vain:
            self.release(owner, vain)
        return [claim for claim in found if claim.servo not in vain]

    def release(self, owner: str, servos: Collection[str] | None = None) -> None:
        """Give back what is borrowed, without an outcome: everything, or some servos."""
        self._written(lambda connection: lending.release(connection, owner, servos))

    def outgoing(self, servo: str, after: int, limit: int = 64) -> list[Posted]:
        """Messages to the edge of a serial above `after`, lowest first.

        An edge that has heard of later messages than there ever were knows a store from before this one was put back
        from a backup: the next message gets a serial that the edge does not take for a repeated one.
        """
        found = self._read(lambda connection: reading.outgoing(connection, servo, after, limit))
        if not found and self.posted([servo]).get(servo, after) < after <= HIGHEST_HEARD:
            self._written(lambda connection: outcomes.pass_over(connection, servo, after))
        return found

    def posted(self, servos: Collection[str]) -> dict[str, int]:
        """Serial of the newest message to the edge of each of these servos that was heard of."""
        return self._read(lambda connection: reading.posted(connection, servos))

    def waiting(self, now: float) -> Waiting:
        """How much is not yet processed, and for how long."""
        return self._read(lambda connection: reading.waiting(connection, now))

    def servos(self, after: str = "", limit: int = 1000) -> list[Summary]:
        """Servos by name, those after a name."""
        return self._read(lambda connection: reading.servos(connection, after, limit))

    def servo(self, name: str) -> Summary | None:
        """One servo; None: it was never heard of."""
        return self._read(lambda connection: reading.servo(connection, name))

    def window(self, servo: str, boot: str, sequence: int) -> Stored | None:
        """A window with its body, empty once retention took it; None: it never came."""
        return self._read(lambda connection: reading.window(connection, servo, boot, sequence))

    def audit(
        self,
        servo: str,
        since: float | None = None,
        limit: int = 100,
        window: tuple[str, int] | None = None,
        before: int | None = None,
    ) -> list[Link]:
        """The evidence chain, newest window first, in one query.

        Parameters
        ----------
        since : float, optional
            s since the epoch: windows received then or later.
        limit : int
            Windows at most.
        window : (str, int), optional
            (boot, sequence): only this one.
        before : int, optional
            Only windows of a lower id than this: the next page after the last one's.
        """
        return self._read(lambda connection: audit.audit(connection, servo, since, limit, window, before))

    def events(self, servo: str, since: float = 0.0, limit: int = 100) -> list[Found]:
        """What belongs to no window, newest first: starts of the edge, fallbacks, answers, faults of the twin itself.

        Parameters
        ----------
        since : float
            s since the epoch: only what was noted then or later.
        """
        return self._read(lambda connection: audit.events(connection, servo, since, limit))

    def windows(self, servo: str, limit: int = 100, before: int | None = None) -> list[Held]:
        """Windows without bodies, newest first."""
        return self._read(lambda connection: reading.windows(connection, servo, limit, before))

    def contexts(self, keys: Collection[str]) -> dict[str, str]:
        """JSON texts of contexts by key; unknown keys are left out."""
        return self._read(lambda connection: reading.contexts(connection, keys))

    def _read(self, action: Callable[[sa.Connection], _Result]) -> _Result:
        with transaction(self.engines.reader) as connection:
            return action(connection)

    def _written(self, action: Callable[[sa.Connection], _Result]) -> _Result:
        """The action in a transaction, again when it only lost a race."""
        for _ in range(_RACES):
            try:
                with transaction(self.engines.writer) as connection:
                    return action(connection)
            except StoreUnavailable as error:
                if not lost_race(error):
                    raise
        raise StoreUnavailable(f"store {self.name}: not available now (lost {_RACES} races with other processes)")


def open_store(url: str, password: str | None = None) -> Store:
    """The store at an address, made or brought up to date.

    Parameters
    ----------
    url : str
        sqlite:///FILE, the name of a file, or postgresql://USER@HOST/DATABASE.
    password : str, optional
        Of PostgreSQL's user, where it is not in `url`.

    Raises
    ------
    InvalidInput
        No such address, the database cannot be opened, is not servotwin's, or is of a newer servotwin. Never with the
        password in it.
    """
    engines = engines_of(address_of(url, password))
    try:
        migrate(engines.writer)
    except StoreUnavailable as error:
        engines.dispose()
        raise InvalidInput(str(error)) from None
    except BaseException:
        engines.dispose()
        raise
    return Store(engines)
