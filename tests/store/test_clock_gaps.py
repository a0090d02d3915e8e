"""Age of windows on a clock that may be wrong, and retention that goes by it."""

from collections.abc import Callable, Sequence
from random import Random

import pytest
import sqlalchemy as sa
from store_cases import claim, outcome, window

from servotwin.store.clock_gaps import old_messages
from servotwin.store.engine import transaction
from servotwin.store.retention import delete_old_bodies
from servotwin.store.schema import messages
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)

DAY = 86400.0


def filled(store: Store, days: Sequence[float]) -> Store:
    store.put([window("a", n, received=day * DAY) for n, day in enumerate(days)])
    return store


def old(store: Store, today: float, keep: float = 30.0) -> int:
    """How many messages are older than `keep` days."""
    through = old_messages(store, today * DAY, keep * DAY).through
    with transaction(store.engines.reader) as connection:
        count: int = connection.scalar(sa.select(sa.func.count()).where(messages.c.id <= through))
    return count


@pytest.mark.slow
def test_without_gaps_age_is_the_time_since_the_receipt(store: Store) -> None:
    filled(store, [0.5 * n for n in range(100)])
    assert old(store, 50.0) == 40  # the one of day 20 is just as old as is kept
    assert old(store, 50.01) == 41
    assert old(store, 49.5, 50.0) == 0
    assert old(filled(open_store("sqlite://"), []), 50.0) == 0


def test_a_clock_that_is_ahead_makes_nothing_old(store: Store) -> None:
    """Of the jump of sixty days, three count: a tenth of the age."""
    filled(store, [0.5 * n for n in range(100)])
    assert old(store, 109.25) == 2 * (109.5 - 30.0 - 57.0)
    assert old_messages(store, 109.5 * DAY, 30.0 * DAY).left_out == 57.0 * DAY
    # Neither does a window that comes on the wrong clock, nor many.
    store.put([window("b", n, received=(109.5 + 0.5 * n) * DAY) for n in range(20)])
    assert old(store, 119.25) == 2 * (119.5 - 30.0 - 57.0)


def test_gaps_within_an_age_add_up_and_earlier_ones_do_not_count(store: Store) -> None:
    days = [0.0, 1.0, 300.0, 301.0, 321.0, 322.0, 342.0, 343.0]
    filled(store, days)
    # Of ten days a gap is one at most: the messages are 7, 6, 5, ... days old.
    assert [old(store, 343.0, 10.0), old(store, 344.0, 10.0)] == [0, 0]
    store.put([window("b", n, received=(343.5 + 0.5 * n) * DAY) for n in range(10)])
    assert [old(store, 348.0, 10.0), old(store, 348.9, 10.0)] == [2, 3]
    assert old_messages(store, 348.0 * DAY, 10.0 * DAY).left_out == pytest.approx((19.0 + 19.0) * DAY)


@pytest.mark.parametrize("ahead", [2.0, 20.0, 75.0, 365.0])
@pytest.mark.parametrize("length", [1, 20, 150])
def test_a_clock_that_was_set_forward_and_back_is_forgotten(ahead: float, length: int) -> None:
    before, wrong, after = range(200), range(200, 200 + length), range(200 + length, 600)
    days = [0.5 * n for n in before], [ahead + 0.5 * n for n in wrong], [0.5 * n for n in after]
    store = filled(open_store("sqlite://"), [day for part in days for day in part])
    assert old(store, 300.0) == 540
    store.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("begin", "end"), [(100.0, 100.4), (100.0, 106.0), (100.0, 130.0)], ids=["hours", "days", "a month"]
)
@pytest.mark.parametrize("error", [75.0, -75.0], ids=["ahead", "behind"])
def test_on_every_day_of_a_clock_that_was_75_days_off_windows_live_as_long_as_they_must(
    begin: float, end: float, error: float
) -> None:
    """A window every 6 h: while the clock is wrong and after it none is deleted before 27 days, nor kept for 31."""
    store, step, longest = open_store("sqlite://"), 0.25, 0.0

    def put(numbers: range) -> None:
        store.put([window("a", n, received=shown(n * step) * DAY) for n in numbers])

    def shown(day: float) -> float:
        return day + error if begin <= day < end else day

    first = round(begin / step)
    put(range(first))
    for n in range(first, round((end + 100.0) / step), 3):
        put(range(n, n + 3))
        today = (n + 2) * step
        through = old(store, shown(today) + 0.001)
        assert today - (through - 1) * step > 27.0 or through == 0
        longest = max(longest, today - through * step)
    store.close()
    assert 29.0 < longest < 31.0


def test_windows_of_a_clock_that_was_ahead_are_deleted_with_their_neighbours(store: Store) -> None:
    """Not 75 days later, when their own times are old."""
    days = [*(0.5 * n for n in range(40)), *(95.0 + 0.5 * n for n in range(40)), *(40.0 + 0.5 * n for n in range(80))]
    filled(store, days)
    while claims := claim(store, per_servo=40):
        store.commit([outcome(one) for one in claims], 200.0)
    through = old_messages(store, 79.5 * DAY, 30.0 * DAY).through
    assert delete_old_bodies(store, through).emptied == old(store, 79.5) == 99


def test_few_messages_are_read(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    from servotwin.store import clock_gaps

    filled(store, [0.001 * n for n in range(2000)] + [70.0])
    reads: list[object] = []
    receipt: Callable[..., object] = clock_gaps._receipt
    monkeypatch.setattr(clock_gaps, "_receipt", lambda *query: reads.append(query) or receipt(*query))
    found = old_messages(store, 70.0 * DAY, 30.0 * DAY)
    assert found.through == 0
    assert found.left_out == pytest.approx((70.0 - 1.999 - 3.0) * DAY)
    assert len(reads) < 60


def test_messages_that_came_at_once_in_any_order_are_not_read_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    from servotwin.store import clock_gaps

    store, random = open_store("sqlite://"), Random(1)
    filled(store, [40.0 + random.uniform(0.0, 20.0) / DAY for _ in range(1000)])
    reads: list[object] = []
    receipt: Callable[..., object] = clock_gaps._receipt
    monkeypatch.setattr(clock_gaps, "_receipt", lambda *query: reads.append(query) or receipt(*query))
    assert old(store, 50.0) == 0
    assert len(reads) < 20
    store.close()


def test_one_pass_deletes_only_so_many(store: Store) -> None:
    filled(store, [0.0] * 20)
    store.commit([outcome(one) for one in claim(store, per_servo=20)], 200.0)
    assert delete_old_bodies(store, 10**9, batch=4, most=6).emptied == 8
    assert delete_old_bodies(store, 10**9, batch=4).emptied == 12
