"""Pace of backlogs: pauses of a fleet's edges, on a clock and a lag of the test."""

import pytest
from service_system import window

from servotwin.link.transport import LONGEST_OLDER_PAUSE_S
from servotwin.twin_service.backlog_pace import LOOK_S, NEWEST_S, BacklogPace
from servotwin.twin_service.missing_windows import SequenceWatch


class Machine:
    """Clock, and a pace beside workers that take so many s for one window."""

    def __init__(self, work: float = 5e-4) -> None:
        self.now = 0.0
        self.pace = BacklogPace(lambda: self.now, 30.0, lambda: work)

    def rush(self, servos: int, waiting: int = 30, took: float = 2.0) -> list[float]:
        """Every servo sends a window; the pauses."""
        pauses = []
        for n in range(servos):
            self.now += took / servos
            pauses.append(self.pace.pause(f"ax-{n}", waiting))
        return pauses

    def look(self, lag: float, times: int, servos: int) -> list[float]:
        """Look at the lag so many times; the pause of the servos, which all send a window after each."""
        pauses = []
        for _ in range(times):
            self.now += LOOK_S
            self.pace.note_lag(lag)
            pauses.append(round(self.rush(servos, took=0.0)[-1], 2))
        return pauses


@pytest.mark.parametrize(("servos", "work"), [(1, 1e-3), (40, 1e-3), (1, 0.2), (40, 0.2), (40, 0.0)])
def test_a_small_fleet_sends_its_backlog_at_full_speed(servos: int, work: float) -> None:
    """Even where the workers are slow: storing its windows costs them nothing."""
    machine = Machine(work)
    assert set(machine.rush(servos) + machine.look(60.0, 20, servos) + machine.rush(servos)) == {0.0}


def test_the_older_windows_of_a_large_fleet_begin_after_the_newest_ones_and_then_come_slowly() -> None:
    """At any speed of the workers: store and edges share their cores, so that all windows together are too many."""
    for work, then in ((5e-4, 8.0), (1.25e-4, 2.0), (5e-3, LONGEST_OLDER_PAUSE_S)):
        machine = Machine(work)
        machine.rush(4000, waiting=0)
        first, later = machine.rush(4000), machine.rush(4000)
        assert first == sorted(first)
        assert (first[0], first[-1]) == (NEWEST_S, pytest.approx(1.5 * NEWEST_S, rel=1e-3))
        assert (later[0], later[-1]) == (pytest.approx(then), pytest.approx(then))


def test_a_few_older_windows_keep_their_order() -> None:
    """Those that hold up the newest one for less than 10 s go before it, as far apart as a whole fleet's would."""
    machine = Machine()
    machine.rush(4000, waiting=0)
    pauses = [machine.pace.pause(servo, waiting) for servo, waiting in (("ax-7", 1), ("ax-8", 2))]
    assert pauses == [8.0, pytest.approx(NEWEST_S, rel=1e-3)]


def test_an_edge_that_comes_back_alone_sends_at_full_speed_after_a_first_pause() -> None:
    machine = Machine()
    machine.rush(4000, waiting=0)
    assert machine.pace.pause("ax-7", 30) == NEWEST_S
    assert machine.pace.pause("ax-7", 29) == 0.0


def test_older_windows_come_faster_while_new_ones_do_not_wait_and_slower_while_they_do() -> None:
    machine = Machine(2e-3)
    machine.rush(1000, waiting=0)
    machine.rush(1000)
    assert machine.look(60.0, 15, 1000) == [8.0] * 15  # new messages wait although no older window has come yet
    assert list(dict.fromkeys(machine.look(0.0, 12, 1000)))[:4] == [8.0, 4.0, 2.0, 1.0]
    assert machine.look(0.0, 12, 1000)[-1] == 0.0
    machine.look(2.0, 12, 1000)
    slower = machine.look(5.0, 100, 1000)
    assert slower == sorted(slower)
    assert slower[-1] == pytest.approx(20.0)


def test_an_edge_that_always_has_a_backlog_says_nothing_of_a_whole_fleets() -> None:
    """The rate rose at every look, to 1e300 within the hour, and a fleet that came back got no pause."""
    machine = Machine()
    machine.rush(4000, waiting=0)
    for _ in range(1800):
        machine.now += LOOK_S
        machine.pace.pause("ax-7", 1)
        machine.pace.note_lag(0.0)
    machine.rush(4000)
    assert machine.rush(4000)[-1] == pytest.approx(8.0)


def test_an_edge_without_a_backlog_is_told_what_the_whole_fleet_would_need() -> None:
    machine = Machine()
    machine.rush(4000, waiting=0)
    assert machine.pace.pause("ax-0", 0) == pytest.approx(8.0)
    assert machine.pace.behind == 0
    machine.now += 3601.0
    assert machine.pace.pause("ax-0", 0) == 0.0


def test_a_window_is_overtaken_by_a_newer_one_of_its_boot_only() -> None:
    pace = Machine().pace
    assert not pace.has_overtaken("ax-0", "b0", 5.0)
    pace.note("ax-0", "b0", 5.0)
    pace.note("ax-0", "b0", 3.0)
    asked = [("ax-0", "b0", 4.0), ("ax-0", "b0", 5.0), ("ax-0", "b1", 1.0), ("ax-1", "b0", 1.0)]
    assert [pace.has_overtaken(*one) for one in asked] == [True, False, False, False]


def test_an_edge_that_is_done_or_gone_has_no_backlog() -> None:
    machine = Machine()
    machine.rush(4000)
    machine.rush(2000, waiting=0)
    assert machine.pace.pause("ax-2000", 30) == pytest.approx(4.0)
    assert [machine.pace.holds(servo) for servo in ("ax-2000", "ax-0", "other")] == [True, False, False]
    machine.now += 2.1 * LONGEST_OLDER_PAUSE_S
    assert not machine.pace.holds("ax-2000")
    machine.pace.note_lag(0.0)
    assert machine.pace.behind == 0


def test_windows_of_a_backlog_are_not_missing_while_the_edge_waits_and_are_once_it_is_done() -> None:
    machine = Machine()
    watch = SequenceWatch(lambda: machine.now, machine.pace.holds)
    machine.rush(4000)
    for n, (sequence, waiting) in enumerate(((0, 0), (31, 30), (1, 29), (32, 29), (2, 28))):
        machine.now += 40.0 * (n > 1)
        machine.rush(4000)
        assert watch.due() == []
        watch.note(window(sequence))
        machine.pace.pause("ax-1", waiting)
    machine.now += 31.0
    assert watch.due() == []
    machine.pace.pause("ax-1", 0)
    assert watch.due() == [("ax-1", "b")]
