"""Timing side by side: in every round each contestant runs in turn, so that a busy machine slows all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import TypeAlias

from benchmarks.contest import Contestant, Job, Workload
from servotwin.hybrid.automaton import Array

Clock: TypeAlias = Callable[[], float]
Notice: TypeAlias = Callable[[str], None]
MOST_REPEATS = 50


@dataclass(frozen=True)
class Row:
    """What was measured of one contestant.

    Attributes
    ----------
    first : float
        s, preparation and first run, compilation included.
    rounds : tuple of tuples of float
        s, every run of every round.
    errors : dict
        By the name of the check.
    missing : str
        Why it did not take part; all else is then empty.
    """

    name: str
    first: float
    rounds: tuple[tuple[float, ...], ...]
    errors: dict[str, float]
    remark: str
    missing: str

    @property
    def times(self) -> tuple[float, ...]:
        """Median of each round, s."""
        return tuple(median(runs) for runs in self.rounds)

    @property
    def median(self) -> float:
        """Median of the rounds' medians, s."""
        return median(self.times)

    def ratios(self, base: Row) -> tuple[float, ...]:
        """Time over that of `base` in the same round."""
        return tuple(own / other for own, other in zip(self.times, base.times, strict=True))


@dataclass
class _Runner:
    """A contestant that has been prepared."""

    contestant: Contestant
    job: Job
    first: float
    repeats: int
    answer: Array
    rounds: list[tuple[float, ...]]

    def run(self, clock: Clock) -> None:
        """One round."""
        times = []
        for _ in range(self.repeats):
            begin = clock()
            self.answer = self.job()
            times.append(clock() - begin)
        self.rounds.append(tuple(times))


def race(workload: Workload, runs: int, block: float, clock: Clock, notice: Notice) -> tuple[Row, ...]:
    """Measure all contestants of a workload.

    Parameters
    ----------
    workload : Workload
    runs : int
        Rounds.
    block : float
        s: a shorter job is repeated within its turn until about so much has passed.
    clock : callable
        Seconds.
    notice : callable
        Told what is about to happen, once for each preparation, turn and check.
    """
    runners = {c.name: _prepared(c, block, clock, notice) for c in workload.contestants if not c.missing}
    for number in range(runs):
        for runner in runners.values():
            notice(f"round {number + 1}: {runner.contestant.name}")
            runner.run(clock)
    return tuple(_row(c, runners.get(c.name), workload, notice) for c in workload.contestants)


def turns(workload: Workload, runs: int) -> int:
    """How often `race` calls its notice."""
    return (runs + 2) * sum(not c.missing for c in workload.contestants)


def _prepared(contestant: Contestant, block: float, clock: Clock, notice: Notice) -> _Runner:
    notice(f"preparing {contestant.name}")
    begin = clock()
    job = contestant.prepare()
    answer = job()
    first = clock() - begin
    begin = clock()
    job()
    warm = clock() - begin
    repeats = max(1, min(MOST_REPEATS, round(block / warm))) if warm > 0.0 else 1
    return _Runner(contestant, job, first, repeats, answer, [])


def _row(contestant: Contestant, runner: _Runner | None, workload: Workload, notice: Notice) -> Row:
    if runner is None:
        return Row(contestant.name, 0.0, (), {}, "", contestant.missing)
    notice(f"checking {contestant.name}")
    errors = {check.name: check.of(runner.answer) for check in workload.checks}
    return Row(contestant.name, runner.first, tuple(runner.rounds), errors, contestant.remark(), "")
