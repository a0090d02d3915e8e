"""Age of messages on a clock that may be wrong, or may have been wrong when they were received.

The age of a message is the sum of the times between it, all messages after it, and now. A longer gap is silence, or a
clock that was set forward. Which of the two cannot be told, so that only a part of it counts: little becomes old
because a clock was wrong, and after a long silence messages only stay for longer. A clock that was set back gives no
time. So messages are old by their numbers, which rise for ever, and not by their own times.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import NamedTuple

import sqlalchemy as sa

from servotwin.store.engine import POSTGRESQL, transaction
from servotwin.store.schema import messages
from servotwin.store.set_aside import without
from servotwin.store.store import Store

_LONGEST_GAP = 0.1
"""Share of an age; a longer gap is not counted beyond it."""
_RESOLUTION = 0.25
"""Share of the longest gap up to which the time between two messages that were read is taken as even."""

_JITTER_S = 60.0
"""s by which messages may be committed in another order than they were received, by several processes at once."""


class OldMessages(NamedTuple):
    """Messages that are older than an age.

    Attributes
    ----------
    through : int
        Number (id) of the newest of them: all up to it are old; 0: none is.
    left_out : float
        s of gaps that did not count.
    """

    through: int
    left_out: float


class _Receipt(NamedTuple):
    """A message's id, and when it was received, s since the epoch."""

    id: int
    received: float


def old_messages(store: Store, now: float, age: float) -> OldMessages:
    """Find the messages that are older than `age`; few are read.

    Parameters
    ----------
    store : Store
    now : float
        s since the epoch, on a clock that may be wrong.
    age : float
        s. Of a gap in the times of receipt, a tenth of that counts.
    """
    longest = _LONGEST_GAP * age
    with transaction(store.engines.reader) as connection:

        def up_to(id_: int) -> _Receipt | None:
            return _receipt(connection, _UP_TO, store.aside, id_)

        first, last = (_receipt(connection, query, store.aside) for query in (_FIRST, _LAST))
        elapsed, left_out, later = 0.0, 0.0, _Receipt(0, now)
        for receipt in () if first is None or last is None else _backwards(first, last, _RESOLUTION * longest, up_to):
            gap = max(0.0, later.received - receipt.received)
            counted = min(gap, longest)
            if elapsed + counted > age:
                return OldMessages(_last_before(receipt, later, later.received - (age - elapsed), up_to), left_out)
            elapsed, left_out, later = elapsed + counted, left_out + gap - counted, receipt
    return OldMessages(0, left_out)


def newest_receipt(store: Store) -> float:
    """Time at which the message with the highest number was received, s since the epoch; 0: there is none."""
    with transaction(store.engines.reader) as connection:
        last = _receipt(connection, _LAST, store.aside)
    return 0.0 if last is None else last.received


def server_clock(store: Store) -> float | None:
    """Time of PostgreSQL's server, s since the epoch; None: the store is a file of this machine."""
    if store.engines.reader.dialect.name != POSTGRESQL:
        return None
    with transaction(store.engines.reader) as connection:
        return float(connection.execute(sa.select(sa.func.extract("epoch", sa.func.clock_timestamp()))).scalar_one())


def _backwards(
    first: _Receipt, last: _Receipt, step: float, up_to: Callable[[int], _Receipt | None]
) -> Iterator[_Receipt]:
    """Yield messages from the last to the first, so close that at most `step` s are between two, or none.

    Where the clock was set back, the messages before and after that are found as well.
    """
    yield last
    waiting, right = [first], last
    while waiting:
        left = waiting[-1]
        middle = _middle(left, right, up_to)
        if middle is not None and not _even(left, middle, right, step):
            waiting.append(middle)
            continue
        right = waiting.pop()
        if right.id < last.id:
            yield right


def _even(left: _Receipt, middle: _Receipt, right: _Receipt, step: float) -> bool:
    """True where three times rise, and no further than `step`: between them the clock is taken as right."""
    times = left.received, middle.received, right.received
    return min(times[1] - times[0], times[2] - times[1]) >= -_JITTER_S and times[2] - times[0] <= step


def _middle(left: _Receipt, right: _Receipt, up_to: Callable[[int], _Receipt | None]) -> _Receipt | None:
    """A message between two; None: there is none."""
    middle = up_to((left.id + right.id) // 2)
    if middle is not None and middle.id > left.id:
        return middle
    middle = up_to(right.id - 1)  # numbers are missing
    return middle if middle is not None and middle.id > left.id else None


def _last_before(old: _Receipt, later: _Receipt, time: float, up_to: Callable[[int], _Receipt | None]) -> int:
    """Id of the last message before a time, from `old` on, which is before it, to `later`, which is not."""
    while (middle := _middle(old, later, up_to)) is not None:
        old, later = (middle, later) if middle.received < time else (old, middle)
    return old.id


def _receipt(
    connection: sa.Connection, query: sa.Select[tuple[int, float]], aside: Collection[str], id_: int = 0
) -> _Receipt | None:
    row = connection.execute(without(query, messages.c.servo, aside), {"_id": id_}).one_or_none()
    return None if row is None else _Receipt(row.id, row.received)


_RECEIVED = sa.select(messages.c.id, messages.c.received).limit(1)
_ALL = _RECEIVED.where(messages.c.id > 0)  # so that a plan names the key, by which the first row ends the search
_FIRST, _LAST = _ALL.order_by(messages.c.id), _ALL.order_by(messages.c.id.desc())
_UP_TO = _RECEIVED.where(messages.c.id <= sa.bindparam("_id")).order_by(messages.c.id.desc())
