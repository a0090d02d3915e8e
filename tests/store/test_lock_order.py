"""Processes that share a PostgreSQL lock servos in one order, so that none waits for another that waits for it."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import pytest
from postgres import Server
from store_cases import claim, window
from waiting import until

from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)
NAME = "lock_order"
_times = count(1000, 1000)


@pytest.fixture(scope="module")
def shared(postgres_server: Server) -> Iterator[Store]:
    """Rows lie in the order in which they were written last, the last name first."""
    store = open_store(postgres_server.database(NAME))
    store.put([window(servo) for servo in "abc"])
    yield store
    store.close()


@pytest.mark.parametrize(
    "change",
    [
        lambda store: store.renew("me", ["b", "c", "a"], 300.0),
        lambda store: store.release("me", ["b", "c"]),
        lambda store: store.release("me"),
        lambda store: store.put([window(servo, 2) for servo in ("b", "c")]),
    ],
)
def test_who_waits_for_a_servo_has_locked_none_that_comes_after_it(
    shared: Store, postgres_server: Server, change: Callable[[Store], object]
) -> None:
    for servo in ("c", "b", "a"):
        assert len(claim(shared, servo=servo, now=float(next(_times)))) == 1
    with (
        ThreadPoolExecutor(1) as thread,
        postgres_server.connect(NAME) as other,
        postgres_server.connect(NAME) as looking,
    ):
        other.execute("BEGIN")
        other.execute("SELECT FROM twins WHERE servo = 'b' FOR UPDATE")
        waiting = thread.submit(change, shared)
        waits = "SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND datname = %s"
        until(lambda: (looking.execute(waits, [NAME]).fetchone() or [0])[0])
        other.execute("SELECT FROM twins WHERE servo = 'c' FOR UPDATE NOWAIT")
        other.execute("COMMIT")
        waiting.result()
