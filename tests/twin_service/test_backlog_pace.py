"""Pace of backlogs: pauses of a fleet's edges, on a clock and a lag of the test."""

import pytest

from servotwin.link.transport import LONGEST_OLDER_PAUSE_S
from servotwin.twin_service import missing_windows
from servotwin.twin_service.backlog_pace import LOOK_S, BacklogPace


class Machine:
    """Clock, and processor time at so many s for each window."""

    def __init__(self, cost: float = 1e-3) -> None:
        self.now = self.used = 0.0
        self.cost = cost
        self.pace = BacklogPace(lambda: self.now, 30.0, lambda: self.used)

    def window(self, servo: int, waiting: int, passed: float = 0.0) -> float:
        self.now, self.used = self.now + passed, self.used + self.cost
        return self.pace.pause(f"ax-{servo}", waiting)


def rush(machine: Machine, servos: int, waiting: int = 30) -> list[float]:
    return [machine.window(n, waiting, 1e-3) for n in range(servos)]


@pytest.mark.parametrize("servos", [1, 10, 200])
def test_a_small_fleet_sends_its_backlog_at_full_speed(servos: int) -> None:
    machine = Machine()
    assert set(rush(machine, servos) + rush(machine, servos)) == {0.0}


def test_the_older_windows_of_a_large_fleet_take_a_quarter_of_a_core_at_first() -> None:
    machine = Machine()
    pauses = rush(machine, 4000)
    assert pauses[0] == 0.0
    assert pauses[-1] == pytest.approx(16.0)
    assert max(rush(machine, 40_000)) == LONGEST_OLDER_PAUSE_S


def test_the_cost_of_a_window_is_measured() -> None:
    machine = Machine(4e-3)
    for _ in range(20):
        rush(machine, 2001)
    assert machine.window(0, 30) == pytest.approx(20.0)
    machine.cost = 0.5e-3
    for _ in range(20):
        rush(machine, 2001)
    assert machine.window(0, 30) == pytest.approx(4.0, rel=0.1)


def test_a_process_that_rests_is_no_measure_of_the_cost() -> None:
    machine = Machine(5e-2)
    for n in range(300):
        machine.window(n % 100, 0, 1.0)
    assert machine.window(0, 1) == 0.0


def test_older_windows_come_faster_while_new_ones_do_not_wait_and_slower_while_they_do() -> None:
    machine = Machine()
    rush(machine, 4000)
    pauses = []
    for lag in [0.0] * 30 + [5.0] * 300:
        machine.now += LOOK_S
        machine.pace.note_lag(lag)
        if machine.now % 20.0 < LOOK_S:
            rush(machine, 4000)
        pauses.append(machine.window(0, 30))
    assert list(dict.fromkeys(round(pause, 1) for pause in pauses))[:3] == [16.0, 11.4, 8.2]
    assert min(pauses) < 4.0
    assert pauses[-1] == pytest.approx(16.0, rel=0.01)


def test_an_edge_without_a_backlog_is_told_what_the_whole_fleet_would_need() -> None:
    machine = Machine()
    rush(machine, 4000, waiting=0)
    assert machine.window(0, 0) == pytest.approx(16.0)
    assert machine.pace.behind == 0
    assert machine.window(1, 30) == 0.0
    machine.now += 3601.0
    assert machine.window(0, 0) == 0.0


def test_an_edge_that_is_done_or_gone_has_no_backlog() -> None:
    machine = Machine()
    rush(machine, 4000)
    for n in range(2000):
        machine.window(n, 0)
    assert machine.window(2000, 30) == pytest.approx(8.0)
    machine.now += 3.1 * LONGEST_OLDER_PAUSE_S
    machine.pace.note_lag(0.0)
    assert machine.pace.behind == 0


def test_a_backlog_at_the_longest_pause_is_not_missing() -> None:
    assert LONGEST_OLDER_PAUSE_S <= 2.0 / 3.0 * missing_windows._PATIENCE_S
