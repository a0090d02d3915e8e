"""Timing side by side: in every round each contestant runs in turn, so that a busy machine slows all of them."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, TypeAlias

from benchmarks.contest import Contestant, Job, Workload
from servotwin.hybrid.automaton import Array

Clock: TypeAlias = Callable[[], float]
Notice: TypeAlias = Callable[[str], None]
MOST_REPEATS = 50
SCHEMA = "servotwin-bench/1"


@dataclass(frozen=True)
class ContestantTimes:
    """Measurements of one contestant.

    Attributes
    ----------
    first : float
        s, preparation and first run, compilation included.
    rounds : tuple of tuples of float
        s, every run of every round.
    errors : dict
        By the name of the check.
    missing : str
        Reason for which it did not take part; all else is then empty.
    processor : tuple of float
        s, processor time of a run, of all threads of this process: of each round.
    """

    name: str
    first: float
    rounds: tuple[tuple[float, ...], ...]
    errors: dict[str, float]
    remark: str
    missing: str
    processor: tuple[float, ...] = ()

    @property
    def times(self) -> tuple[float, ...]:
        """Median of each round, s."""
        return tuple(median(runs) for runs in self.rounds)

    @property
    def median(self) -> float:
        """Median of the rounds' medians, s."""
        return median(self.times)

    def ratios(self, base: ContestantTimes) -> tuple[float, ...]:
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
    processor: list[float]

    def run(self, clock: Clock) -> None:
        """Measure one round."""
        times, before = [], time.process_time()
        for _ in range(self.repeats):
            begin = clock()
            self.answer = self.job()
            times.append(clock() - begin)
        self.processor.append((time.process_time() - before) / self.repeats)
        self.rounds.append(tuple(times))


def race(workload: Workload, runs: int, block: float, clock: Clock, notice: Notice) -> tuple[ContestantTimes, ...]:
    """Measure all contestants of a workload.

    Parameters
    ----------
    workload : Workload
    runs : int
        Rounds.
    block : float
        s: a shorter job is repeated within its turn for about this time.
    clock : callable
        Seconds.
    notice : callable
        Called with the next activity, once for each preparation, turn and check.
    """
    runners = {c.name: _prepared(c, block, clock, notice) for c in workload.contestants if not c.missing}
    for number in range(runs):
        for runner in runners.values():
            notice(f"round {number + 1}: {runner.contestant.name}")
            runner.run(clock)
    return tuple(_row(c, runners.get(c.name), workload, notice) for c in workload.contestants)


def turns(workload: Workload, runs: int) -> int:
    """Number of calls of the notice by `race`."""
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
    return _Runner(contestant, job, first, repeats, answer, [], [])


def _row(contestant: Contestant, runner: _Runner | None, workload: Workload, notice: Notice) -> ContestantTimes:
    if runner is None:
        return ContestantTimes(contestant.name, 0.0, (), {}, "", contestant.missing)
    notice(f"checking {contestant.name}")
    errors = {check.name: check.of(runner.answer) for check in workload.checks}
    rounds, processor = tuple(runner.rounds), tuple(runner.processor)
    return ContestantTimes(contestant.name, runner.first, rounds, errors, contestant.remark(), "", processor)


@dataclass(frozen=True)
class WorkloadResult:
    """A workload and the measurements of its contestants, servotwin first."""

    workload: Workload
    rows: tuple[ContestantTimes, ...]

    def ratio(self, row: ContestantTimes) -> float:
        """Median over the rounds of the time over servotwin's in the same round."""
        return median(row.ratios(self.rows[0]))

    def processor_ratio(self, row: ContestantTimes) -> float:
        """Median over the rounds of the processor time over servotwin's in the same round; NaN where that is zero."""
        pairs = zip(row.processor, self.rows[0].processor, strict=True)
        return median(own / base if base > 0.0 else math.nan for own, base in pairs)

    def note(self, row: ContestantTimes) -> str:
        """Remark beside the numbers."""
        if row.missing:
            return row.missing
        return ", ".join(part for part in (self.workload.pace(row.median), row.remark) if part)


def dumps(results: Sequence[WorkloadResult], machine: Mapping[str, Any], date: str, quick: bool) -> str:
    """The document: schema, date, machine, and for each workload every run of every contestant."""
    document = {
        "schema": SCHEMA,
        "date": date,
        "quick": quick,
        "machine": dict(machine),
        "workloads": [_workload(result) for result in results],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _workload(result: WorkloadResult) -> dict[str, Any]:
    return {
        "name": result.workload.name,
        "title": result.workload.title,
        "units": {check.name: check.unit for check in result.workload.checks},
        "contestants": [_row_json(result, row) for row in result.rows],
    }


def _row_json(result: WorkloadResult, row: ContestantTimes) -> dict[str, Any]:
    if row.missing:
        return {"name": row.name, "missing": row.missing}
    return {
        "name": row.name,
        "median_s": row.median,
        "ratio": result.ratio(row),
        "ratios": list(row.ratios(result.rows[0])),
        "first_s": row.first,
        "rounds_s": [list(times) for times in row.rounds],
        "processor_s": list(row.processor),
        "errors": {name: None if math.isnan(value) else value for name, value in row.errors.items()},
        "note": result.note(row),
    }
