"""Order of an edge's windows: by age, the newest one first where a fleet's backlog would hold it up."""

from servotwin.link.window_order import WindowOrder


def choose(order: WindowOrder, now: float, waiting: list[int], fresh: bool = True) -> int | None:
    return order.next(now, waiting[0], waiting[-1] if fresh else None, len(waiting) - 1)


def test_without_a_pause_a_backlog_goes_in_order_and_at_once() -> None:
    order, waiting = WindowOrder(), list(range(1000))
    for n in range(1000):
        assert choose(order, 1e-3 * n, waiting) == waiting.pop(0)
        order.taken(1e-3 * n, not waiting, len(waiting), 0.0)


def test_where_older_windows_would_hold_up_the_newest_one_it_goes_at_once() -> None:
    """After a long outage of a small fleet, and after any of a large one; else the windows go in their order."""
    for pause, waiting, first in ((20.0, list(range(31)), 30), (20.0, [0, 1], 1), (1.0, list(range(12)), 11)):
        order = WindowOrder()
        order.taken(0.0, True, 0, pause)
        order.out_of_reach()
        assert choose(order, 600.0, waiting) == first
    for pause, waiting, first in ((1.0, list(range(11)), 0), (2.0, [0, 1], 0), (0.0, list(range(31)), 0)):
        order = WindowOrder()
        order.taken(0.0, True, 0, pause)
        order.out_of_reach()
        assert choose(order, 600.0, waiting) == first


def test_older_windows_wait_for_the_pause_and_the_newest_does_not() -> None:
    order = WindowOrder(20.0)
    assert choose(order, 0.0, list(range(31))) == 30
    order.taken(0.0, True, 30, 20.0)
    assert choose(order, 19.0, list(range(30)), fresh=False) is None
    assert order.pause_left(19.0) == 1.0
    assert choose(order, 19.0, [*range(30), 31]) == 31
    order.taken(19.0, True, 30, 20.0)
    assert choose(order, 20.0, list(range(30)), fresh=False) == 0
    order.taken(20.0, False, 29, 5.0)
    assert choose(order, 24.9, list(range(1, 30)), fresh=False) is None
    assert choose(order, 25.0, list(range(1, 30)), fresh=False) == 1


def test_a_backlog_shrinks_although_new_windows_come_faster_than_the_pause() -> None:
    """An older one goes after every four of them, so that the outbox is never much fuller."""
    order, waiting, taken = WindowOrder(20.0), list(range(100)), -1
    for n in range(400):
        now = 2.0 * n
        waiting.append(100 + n)
        while waiting and (item := choose(order, now, waiting, waiting[-1] > taken)) is not None:
            waiting.remove(item)
            order.taken(now, item > taken, len(waiting), 20.0)
            taken = max(taken, item)
        assert len(waiting) <= 101
        assert n >= 3 or waiting[:100] == list(range(100))
    assert not waiting


def test_once_the_backlog_is_gone_windows_go_as_they_come() -> None:
    order = WindowOrder()
    order.taken(0.0, False, 1, 5.0)
    order.taken(1.0, True, 0, 5.0)
    assert choose(order, 2.0, [5]) == 5
    assert choose(order, 2.0, [5, 6]) == 5
    order.out_of_reach()
    assert order.pause_left(0.0) == 0.0
