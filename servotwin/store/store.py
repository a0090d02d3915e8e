"""The store: incoming messages, work results and outgoing messages, committed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TypeVar

import sqlalchemy as sa

from servotwin.errors import InvalidInput
from servotwin.store import incoming, leases, queries, results
from servotwin.store import outgoing as posting
from servotwin.store import set_aside as aside_rows
from servotwin.store.claims import StoredClaim, add_alarm, claim_of, raise_claim
from servotwin.store.engine import (
    Engines,
    ServoSetAside,
    StoreUnavailable,
    engines_of,
    lost_race,
    parse_address,
    public_address,
    transaction,
)
from servotwin.store.incoming import insert_once
from servotwin.store.migrate import VERSIONS, is_newest, migrate
from servotwin.store.records import (
    Backlog,
    Incoming,
    Lease,
    MessageKind,
    OutgoingMessage,
    PutResult,
    ServoSummary,
    StoredEvidence,
    StoredMessage,
    StoredWindow,
    WindowTrace,
    WorkResult,
)
from servotwin.store.schema import contexts
from servotwin.store.stored_value import WrongRow

WORK_KINDS = (MessageKind.WINDOW, MessageKind.LETTER, MessageKind.ACT)
FLEET = "fleet"
"""Key of the fleet's name among the contexts, whose other keys are digests."""
_RACES = 8
_NOTHING = sa.text(f"UPDATE {VERSIONS} SET version_num = version_num")

_Result = TypeVar("_Result")


class Store:
    """Database of messages, evidence and twins; any thread may use it.

    A method that writes returns when its transaction is on the disk. It raises StoreUnavailable where that failed:
    then nothing was written. Methods that read raise the same. Times are s since the epoch and come from the caller:
    the clocks of processes that share a database have to agree to a small part of a lease.

    Parameters
    ----------
    engines : Engines
        Of a migrated database, as `open_store` makes them.

    Attributes
    ----------
    damaged : bool
        Set it where the database is found damaged: from then on everything that writes raises StoreUnavailable.
    aside : mapping of str to WrongRow
        Servos that are set aside, each with a wrong row, as the database had them when this store last wrote: they have
        no turn, nothing of them is written, methods that name one raise ServoSetAside, and those that are of all leave
        them out. Each transaction that writes reads them first, since another process may set a servo aside.
    """

    def __init__(self, engines: Engines) -> None:
        self.engines = engines
        self.damaged = False
        self.aside: Mapping[str, WrongRow] = {}

    @property
    def name(self) -> str:
        """Address without the password."""
        return public_address(self.engines.writer.url)

    def close(self) -> None:
        """Close every connection."""
        self.engines.dispose()

    def sound(self, servos: Iterable[str]) -> list[str]:
        """Those of some servos that are not set aside."""
        return [servo for servo in servos if servo not in self.aside]

    def require_sound(self, *servos: str) -> None:
        """Raise ServoSetAside where one of these is set aside."""
        for servo in servos if self.aside else ():
            if servo in self.aside:
                raise ServoSetAside(servo)

    def learn_aside(self) -> None:
        """Read which servos are set aside; raises StoreUnavailable."""
        self.aside = self._read(aside_rows.noted)

    def set_aside(self, wrong: Collection[WrongRow]) -> None:
        """Set servos aside for all processes, by a wrong row of each; raises StoreUnavailable."""
        with transaction(self.engines.writer) as connection:  # of a damaged store nothing else is written
            aside_rows.note(connection, wrong)
            self.aside = aside_rows.noted(connection)

    def take_back(self, wrong: WrongRow) -> None:
        """End that a servo is set aside, unless for another row meanwhile; raises StoreUnavailable."""
        self._write(lambda connection: aside_rows.strike(connection, wrong))
        self.learn_aside()

    def put(self, items: Sequence[Incoming]) -> list[PutResult]:
        """Store messages in one transaction; returns the result of each.

        CONFLICT: another message with the same key is stored, and stays.
        """
        return self.write(items, (), 0.0)[0]

    def commit(self, work: Sequence[WorkResult], now: float) -> list[bool]:
        """Commit work results in one transaction; False for those that are void, as another one was committed before.

        Raises
        ------
        ValueError, sqlalchemy.exc.IntegrityError
            A result covers a message that is not an unprocessed one of its servo, or names an unknown context: nothing
            is written.
        """
        return self.write((), work, now)[1]

    def write(
        self, items: Sequence[Incoming], work: Sequence[WorkResult], now: float
    ) -> tuple[list[PutResult], list[bool]]:
        """`put` and `commit` in one transaction."""
        servos = {item.servo for item in items} | {result.servo for result in work}
        return self._write(lambda c: (incoming.put(c, items), results.commit(c, work, now)), *servos)

    def lease(
        self,
        owner: str,
        limit: int,
        lease_s: float,
        now: float,
        kinds: Collection[MessageKind] = WORK_KINDS,
        per_servo: int = 16,
        servo: str | None = None,
        newest_first: bool = False,
        estimate_first: bool = False,
    ) -> list[Lease]:
        """Lease servos that have unprocessed messages of these kinds, or that are due to be woken.

        A servo has one lease at a time, until its result is committed, it is released, or `lease_s` have passed. Being
        due counts only where `kinds` has windows or letters. New messages come before estimates that were deferred, of
        which one is leased, and those before a backlog.

        Parameters
        ----------
        owner : str
            Name of the owner, unique among all processes.
        limit, per_servo : int
            Servos, and messages of each, at most.
        lease_s, now : float
            s; s since the epoch.
        servo : str, optional
            Only this one.
        newest_first : bool
            Where not all windows of a servo are leased, the newest ones are; of other kinds always the oldest.
        estimate_first : bool
            An estimate that was deferred comes before new messages, this time.
        """
        until = now + lease_s
        leased = self._write(
            lambda c: leases.acquire(
                c, owner, limit, until, now, kinds, servo, estimate_first=estimate_first, aside=frozenset(self.aside)
            )
        )
        if not leased:
            return []
        with transaction(self.engines.reader) as connection:
            loaded = leases.load(connection, leased, kinds, per_servo, newest_first)
            idle = {lease.servo for lease in loaded if not lease.messages}
            if idle:
                idle -= leases.due(connection, idle, now)
        if idle:
            self.release(owner, idle)
        return [lease for lease in loaded if lease.servo not in idle]

    def release(self, owner: str, servos: Collection[str] | None = None) -> None:
        """End leases without a result: all of an owner's, or those of some servos."""
        self._write(lambda c: leases.release(c, owner, None if servos is None else self.sound(servos), self.aside))

    def renew(self, owner: str, servos: Collection[str], until: float) -> None:
        """Extend an owner's leases of some servos until a time, s since the epoch; those that it has lost stay lost."""
        self._write(lambda connection: leases.renew(connection, owner, self.sound(servos), until))

    def hold(self, servo: str, until: float) -> None:
        """Let nobody lease a servo until a time, s since the epoch; does nothing where somebody has it."""
        self._write(lambda connection: leases.hold(connection, servo, until), servo)

    def outgoing(self, servo: str, after: int, limit: int = 64) -> list[OutgoingMessage]:
        """Messages to the edge with serials above `after`, lowest first."""
        return self._read(lambda connection: posting.after_serial(connection, servo, after, limit), servo)

    def post(self, sent: Mapping[str, bytes], now: float, above: int = 0) -> None:
        """Post a message to each of these edges, its serial above `above`; unknown servos are left out."""
        self._write(lambda connection: posting.post(connection, sent, now, above), *sent)

    def skip_to_serial(self, servo: str, serial: int) -> None:
        """Make the serial of the next message to the edge exceed `serial`."""
        self._write(lambda connection: posting.skip_to_serial(connection, servo, serial), servo)

    def posted(self, servos: Collection[str]) -> dict[str, int]:
        """Serials of the newest messages to the edges of these servos; unknown servos are left out."""
        return self._read(lambda connection: posting.newest_serials(connection, self.sound(servos)))

    def claim_of(self, servo: str) -> StoredClaim:
        """Newest claim of a servo's edge."""
        return self._read(lambda connection: claim_of(connection, servo), servo)

    def raise_claim(self, servo: str, new: StoredClaim, below: int, now: float) -> StoredClaim:
        """Store a claim where the servo's newest has a number below `below`; return the one that counts then."""
        return self._write(lambda connection: raise_claim(connection, servo, new, below, now), servo)

    def add_alarm(self, sentence: str, now: float, *servos: str) -> None:
        """Store an alarm about each of some servos, which belongs to no window."""
        self._write(lambda connection: add_alarm(connection, servos, sentence, now), *servos)

    def backlog(self, now: float) -> Backlog:
        """Number and age of the unprocessed messages."""
        return self._read(lambda connection: queries.backlog(connection, now, self.aside))

    def turn_lag(self, now: float) -> float:
        """Longest time (s) for which new messages of a servo have waited for a worker."""
        return self._read(lambda connection: queries.turn_lag(connection, now, self.aside))

    def servos(self, after: str = "", limit: int = 1000) -> list[ServoSummary]:
        """Summaries of the servos whose names follow `after`, by name."""
        return self._read(lambda connection: queries.servos(connection, after, limit, self.aside))

    def servo(self, name: str) -> ServoSummary | None:
        """Summary of one servo; None: it is unknown."""
        return self._read(lambda connection: queries.servo(connection, name), name)

    def fleet(self, name: str) -> str:
        """Name of the fleet whose servos the store holds: the first one that was ever given."""
        if FLEET not in (known := self.contexts([FLEET])):
            noted = {"key": FLEET, "text": name}
            self._write(lambda connection: connection.execute(insert_once(connection.dialect.name, contexts), noted))
            known = self.contexts([FLEET])
        return known[FLEET]

    def window(self, servo: str, boot: str, sequence: int) -> StoredMessage | None:
        """A window with its body, which is empty once retention deleted it; None: it is unknown."""
        return self._read(lambda connection: queries.window(connection, servo, boot, sequence), servo)

    def audit(
        self,
        servo: str,
        since: float | None = None,
        limit: int = 100,
        window: tuple[str, int] | None = None,
        before: int | None = None,
        updates: bool = False,
    ) -> list[WindowTrace]:
        """Evidence chains of a servo's windows, newest window first, in one query.

        Parameters
        ----------
        since : float, optional
            s since the epoch: windows received then or later.
        limit : int
            Windows at most.
        window : (str, int), optional
            (boot, sequence): only this one.
        before : int, optional
            Only windows with lower ids: the id of the last window gives the next page.
        updates : bool
            Only windows that led to an update.
        """
        return self._read(lambda c: queries.audit(c, servo, since, limit, window, before, updates), servo)

    def events(self, servo: str, since: float = 0.0, limit: int = 100) -> list[StoredEvidence]:
        """Evidence that belongs to no window, newest first: starts of the edge, fallbacks, answers, faults of the twin.

        Parameters
        ----------
        since : float
            s since the epoch: only evidence from then or later.
        """
        return self._read(lambda connection: queries.events(connection, servo, since, limit), servo)

    def windows(self, servo: str, limit: int = 100, before: int | None = None) -> list[StoredWindow]:
        """Windows without bodies, newest first."""
        return self._read(lambda connection: queries.windows(connection, servo, limit, before), servo)

    def contexts(self, keys: Collection[str]) -> dict[str, str]:
        """JSON texts of contexts by key; unknown keys are left out."""
        return self._read(lambda connection: queries.contexts(connection, keys))

    def reading(self, action: Callable[[sa.Connection], _Result], *servos: str) -> _Result:
        """Run a query, such as those of `overview`, of all servos or these alone; raises StoreUnavailable."""
        return self._read(action, *servos)

    def write_nothing(self) -> None:
        """Commit a row as it is; raises StoreUnavailable where the database cannot be written.

        Nothing less tells: SQLite begins a transaction on a disk that is full or read-only, and a database that nobody
        writes looks healthy.
        """
        self._write(lambda connection: connection.execute(_NOTHING))

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Run a block in a transaction that writes; raises StoreUnavailable."""
        if self.damaged:
            raise StoreUnavailable(f"store {self.name}: is damaged and not written any more")
        with transaction(self.engines.writer) as connection:
            self.aside = aside_rows.noted(connection)
            yield connection

    def _read(self, action: Callable[[sa.Connection], _Result], *servos: str) -> _Result:
        self.require_sound(*servos)
        with transaction(self.engines.reader) as connection:
            return action(connection)

    def _write(self, action: Callable[[sa.Connection], _Result], *servos: str) -> _Result:
        """Run the action, on these servos, in a transaction; retry it where it only lost a race with another process.

        Raises
        ------
        ServoSetAside, StoreUnavailable
        """
        for _ in range(_RACES):
            try:
                with self.writing() as connection:
                    self.require_sound(*servos)
                    return action(connection)
            except StoreUnavailable as error:
                if not lost_race(error):
                    raise
        raise StoreUnavailable(f"store {self.name}: not available now (lost {_RACES} races with other processes)")


def open_store(url: str, password: str | None = None) -> Store:
    """Open the store at an address; create or migrate it where needed.

    Parameters
    ----------
    url : str
        sqlite:///FILE, the name of a file, or postgresql://USER@HOST/DATABASE.
    password : str, optional
        Of PostgreSQL's user, where it is not in `url`.

    Raises
    ------
    InvalidInput
        The address is invalid, or the database cannot be opened, is not servotwin's or is of a newer servotwin. The
        message never holds the password.
    """
    engines = engines_of(parse_address(url, password))
    try:
        # Read first: a command that only reads does not wait for whoever is writing.
        if not is_newest(engines.reader):
            migrate(engines.writer)
    except StoreUnavailable as error:
        engines.dispose()
        raise InvalidInput(str(error)) from None
    except BaseException:
        engines.dispose()
        raise
    store = Store(engines)
    with suppress(StoreUnavailable):  # whoever writes reads it again, and checks tell what is wrong
        store.learn_aside()
    return store
