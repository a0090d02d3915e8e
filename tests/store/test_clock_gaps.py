"""Age of windows on a clock that may be wrong, and retention that goes by it."""

import math
from collections.abc import Sequence

import pytest
from store_cases import claim, outcome, window

from servotwin.store.clock_gaps import received_before
from servotwin.store.retention import delete_old_bodies
from servotwin.store.store import Store, open_store

pytest_plugins = ("store_fixtures",)

DAY = 86400.0


def filled(store: Store, days: Sequence[float]) -> Store:
    store.put([window("a", n, received=day * DAY) for n, day in enumerate(days)])
    return store


def age_limit(store: Store, today: float, keep: float = 30.0) -> float:
    """Day before which windows are older than `keep` days."""
    return received_before(store, today * DAY, keep * DAY) / DAY


def test_without_gaps_age_is_the_time_since_the_receipt(store: Store) -> None:
    filled(store, [0.5 * n for n in range(100)])
    assert age_limit(store, 50.0) == 20.0
    assert age_limit(filled(open_store("sqlite://"), []), 50.0) == -math.inf


def test_a_clock_that_is_ahead_makes_nothing_old(store: Store) -> None:
    """Of the jump of sixty days, three count: a tenth of the age."""
    filled(store, [0.5 * n for n in range(100)])
    assert math.isclose(age_limit(store, 109.5), 109.5 - 30.0 - 57.0)
    # Neither does a window that comes on the wrong clock, nor many.
    store.put([window("b", n, received=(109.5 + 0.5 * n) * DAY) for n in range(20)])
    assert math.isclose(age_limit(store, 119.5), 119.5 - 30.0 - 57.0)


def test_gaps_within_an_age_add_up_and_earlier_ones_do_not_count(store: Store) -> None:
    filled(store, [0.0, 1.0, 300.0, 301.0, 321.0, 322.0, 342.0, 343.0])
    assert math.isclose(age_limit(store, 343.0), 343.0 - 30.0 - 17.0 - 17.0 - 296.0)
    assert math.isclose(age_limit(store, 343.0, keep=10.0), 343.0 - 10.0 - 19.0 - 19.0 - 298.0)


def test_a_clock_that_was_set_back_deletes_nothing_new(store: Store) -> None:
    filled(
        store, [*(0.5 * n for n in range(20)), *(60.0 + 0.5 * n for n in range(4)), *(10.0 + 0.5 * n for n in range(9))]
    )
    assert age_limit(store, 14.5) <= 14.5 - 30.0


@pytest.mark.parametrize("ahead", [2.0, 20.0, 365.0])
@pytest.mark.parametrize("length", [1, 20, 150])
def test_a_clock_that_was_set_forward_and_back_is_forgotten(ahead: float, length: int) -> None:
    before, wrong, after = range(200), range(200, 200 + length), range(200 + length, 600)
    days = [0.5 * n for n in before], [ahead + 0.5 * n for n in wrong], [0.5 * n for n in after]
    store = filled(open_store("sqlite://"), [day for part in days for day in part])
    assert math.isclose(age_limit(store, 300.0), 270.0)
    store.close()


def test_few_messages_are_read(store: Store, monkeypatch) -> None:
    from servotwin.store import clock_gaps

    filled(store, [0.001 * n for n in range(2000)] + [70.0])
    reads, receipt = [], clock_gaps._receipt
    monkeypatch.setattr(clock_gaps, "_receipt", lambda *query: reads.append(query) or receipt(*query))
    assert math.isclose(age_limit(store, 70.0), 70.0 - 30.0 - (70.0 - 1.999 - 3.0))
    assert len(reads) < 40


def test_one_pass_deletes_only_so_many(store: Store) -> None:
    filled(store, [0.0] * 20)
    store.commit([outcome(one) for one in claim(store, per_servo=20)], 200.0)
    assert delete_old_bodies(store, 1e9, batch=4, most=6).emptied == 8
    assert delete_old_bodies(store, 1e9, batch=4).emptied == 12
