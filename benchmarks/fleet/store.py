"""Processor time and statements of a store for a window: `python -m benchmarks.fleet.store ADDRESS`.

Windows of 20 kB and results of glances are written together, as the group commit does, and leased in between. ADDRESS
is that of a new, empty store, as in `[service] store`.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from hashlib import blake2b
from typing import NamedTuple, TypeVar

import sqlalchemy as sa

from servotwin.store.records import EvidenceRecord, Incoming, Lease, MessageKind, WorkResult
from servotwin.store.store import Store, open_store

_SERVOS = 1000
_WINDOW, _STATE, _CONTEXT, _GLANCE = 20_300, 3500, 4000, 150  # bytes, about those of the fleet's bench
_UNCOUNTED = 40  # rounds at first: statements are compiled, caches fill
_LEASE_S = 120.0
_Result = TypeVar("_Result")


class StoreCosts(NamedTuple):
    """Sums over all calls, by what the store did: processor time (s) of the calling thread, statements."""

    seconds: defaultdict[str, float]
    statements: Counter[str]


def measure(store: Store, together: int, rounds: int) -> StoreCosts:
    """Write and lease the windows of so many servos `together`, in some rounds."""
    costs, made, now = StoreCosts(defaultdict(float), Counter()), [0], time.time()
    results: list[WorkResult] = []

    def note(*_: object) -> None:
        made[0] += 1

    for engine in store.engines.distinct:
        sa.event.listen(engine, "before_cursor_execute", note)

    def timed(what: str, call: Callable[[], _Result]) -> _Result:
        before, begun = made[0], time.thread_time()
        result = call()
        costs.seconds[what] += time.thread_time() - begun
        costs.statements[what] += made[0] - before
        return result

    for number in range(-_UNCOUNTED, rounds):
        if number == 0:
            costs.seconds.clear()
            costs.statements.clear()
        items = [_window((number + _UNCOUNTED) * together + n, now) for n in range(together)]
        timed("write", lambda items=items, done=results: store.write(items, done, now))  # type: ignore[misc]
        leases = timed("lease", lambda: store.lease("bench", together, _LEASE_S, now, newest_first=True))
        results = [_glanced(lease) for lease in leases]
    return costs


def _window(number: int, now: float) -> Incoming:
    servo, sequence = f"ax-{number % _SERVOS:05d}", number // _SERVOS
    digest = blake2b(b"%d" % number, digest_size=16).digest()
    return Incoming(
        servo, MessageKind.WINDOW, f"boot-1/{sequence}", bytes(_WINDOW), "", digest, now, "boot-1", sequence
    )


def _glanced(lease: Lease) -> WorkResult:
    """Result of a glance at a window with nothing new."""
    (window,) = lease.messages
    seen = EvidenceRecord("glance", window.id, bytes(_GLANCE), 1, 0.1, 1e-3, "nothing moved", "bench", 1e-6)
    state, text = bytes(_STATE), "x" * _CONTEXT
    return WorkResult(
        lease.servo, lease.serial, state, None, (window.id,), (seen,), contexts=(("bench", text),), deferred=0
    )


def main() -> None:
    """Measure, and print the result."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet.store", description=__doc__)
    parser.add_argument("address")
    parser.add_argument("--together", type=int, default=16, help="windows, and results, of one transaction")
    parser.add_argument("--rounds", type=int, default=150)
    given = parser.parse_args()
    store = open_store(given.address)
    try:
        costs = measure(store, given.together, given.rounds)
    finally:
        store.close()
    for what, seconds in costs.seconds.items():
        once, window = 1e3 * seconds / given.rounds, 1e3 * seconds / given.rounds / given.together
        statements = costs.statements[what] / given.rounds
        print(f"{what}: {once:.2f} ms of processor time, {window:.3f} ms a window, {statements:.0f} statements")


if __name__ == "__main__":
    main()
