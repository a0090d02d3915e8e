"""`servotwin bench loops`: the whole twin in the loop, on machines that differ from their model and wear."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.batch import Batch
from benchmarks.policies.contenders import candidates, without_bounds
from benchmarks.policies.worn import BLOCKS, HALF_PERIOD, RATE, STEPS, WornMachine, worn_machines
from servotwin.analysis.maps.pool import shared, workplace
from servotwin.cosim import Cosimulation, SimulatedMachine
from servotwin.messages.updates import Update
from servotwin.redesign.design import Design
from servotwin.redesign.registry import certified_policy
from servotwin.simulation import Run

SCHEMA, NAME = "servotwin-bench-loops/1", "loops"
MACHINES, QUICK, SEED = 40, 1, 2027
TWIN, OWN, FALLBACK = "twin", "own PD", "fallback set, held"
_WITHIN, _FED = "within the bounds: ", ", velocity x "
"""Parts of the names of constants: one that the policy's bounds on Ms allow, one with velocity feedforward."""
_GAP_OFF = math.radians(0.05)
# Steps of which most are made with little knowledge.
_FIRST = 4
# A step has settled where the error's half peak-to-peak over the last third of its time is below this share of it, and
# at least two counts of the sensor.
_STILL = 0.01


class LoopScores(NamedTuple):
    """Measures of one run.

    Attributes
    ----------
    cost : float
        s, integral of the absolute error per step, mean of all steps.
    later : float
        s, the same of the steps after the first four: until then a twin knows little of its machine.
    settled : float
        1.0 where the last step has settled.
    tail : float
        m, largest error in the last third of the last step.
    updates, off, worst : float
        Number of updates applied, of those whose gap was off by more than 0.05 deg, and the largest error, rad.
    outside : float
        Of those that were off: the gap lay outside of the interval.
    fallbacks : float
    """

    cost: float
    later: float
    settled: float
    tail: float
    updates: float = 0.0
    off: float = 0.0
    worst: float = 0.0
    outside: float = 0.0
    fallbacks: float = 0.0


class LoopRow(NamedTuple):
    """Scores of one contender on every machine of a block."""

    block: str
    name: str
    scores: tuple[LoopScores, ...]

    def at(self, measure: str, percent: float) -> float:
        """A percentile of a measure over the machines."""
        return float(np.percentile([getattr(each, measure) for each in self.scores], percent))

    def total(self, measure: str) -> float:
        """Sum of a measure over the machines."""
        return float(sum(getattr(each, measure) for each in self.scores))


class _Task(NamedTuple):
    place: int
    machine: WornMachine


def loops(
    date: str = "",
    output: Path | None = None,
    count: int = MACHINES,
    blocks: Sequence[str] = BLOCKS,
    console: Console | None = None,
    seed: int = SEED,
    workers: int | None = None,
) -> tuple[LoopRow, ...]:
    """Compare the twin with constant controllers, show it, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    count, seed : int
        Machines of each block.
    blocks : sequence of str
    console : Console, optional
    workers : int, optional
        Processes; one per core by default.

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    rows: list[LoopRow] = []
    with workplace(workers):
        for block in blocks:
            rows += _block(block, count, seed)
            console.print(shown([row for row in rows if row.block == block]))
    table = [
        {"block": row.block, "contender": row.name, "machines": [each._asdict() for each in row.scores]} for row in rows
    ]
    report.write(output, report.text(SCHEMA, date, rows=table), console)
    return tuple(rows)


def _block(block: str, count: int, seed: int) -> list[LoopRow]:
    """Rows of the twin, the constant that is verified, the own gains, and, with hindsight, the best constants."""
    tasks = [_Task(place, machine) for place, machine in enumerate(worn_machines(block, count, seed))]
    found = dict(sorted((task.place, scores) for task, scores in shared(_compared, tasks)))
    return best_rows(block, list(found.values()))


def best_rows(block: str, found: Sequence[Mapping[str, LoopScores]]) -> list[LoopRow]:
    """Rows of a block from the scores of all contenders on each machine."""
    rows = {name: LoopRow(block, name, tuple(scores[name] for scores in found)) for name in found[0]}
    constants = [row for row in rows.values() if row.name not in (TWIN, FALLBACK)]
    within = [row for row in constants if row.name.startswith(_WITHIN)]
    return [
        *(rows[name] for name in (TWIN, FALLBACK, OWN)),
        _best("without velocity feedforward", [row for row in constants if _FED not in row.name]),
        _best("of all", [*constants, rows[FALLBACK]]),
        _best("within the bounds", [*within, rows[FALLBACK]]),
    ]


def _best(which: str, constants: Sequence[LoopRow]) -> LoopRow:
    """The constant with the lowest cost p95."""
    best = min(constants, key=lambda row: row.at("cost", 95.0))
    return best._replace(name=f"best constant {which}: {best.name.removeprefix(_WITHIN)}")


def _compared(task: _Task) -> dict[str, LoopScores]:
    machine = task.machine
    scores = {TWIN: with_twin(machine)}
    for name, setting in constants_of(machine).items():
        scores[name] = scored(machine, machine.under(setting.pid, setting.tolerance))
    return scores


def constants_of(machine: WornMachine) -> dict[str, Design]:
    """Constant settings by name: the fallback set, the candidates of the policy, and those beyond its bounds on Ms.

    The zones that stop the integral are left out, but for that of the fallback set.
    """
    policy = certified_policy(machine.model, machine.scenario.twin)
    demands = replace(policy.demands, stops=())
    within = candidates(machine.model, policy.uncertainty, demands)
    beyond = candidates(machine.model, policy.uncertainty, without_bounds(demands))
    own = Design(machine.model.controller.replace(Ki=0.0))
    others = {name: each for name, each in beyond.items() if each != own and each not in within.values()}
    result = {FALLBACK: policy.fallback().setting, OWN: own}
    return result | {f"{_WITHIN}{name}": each for name, each in within.items()} | others


def with_twin(machine: WornMachine) -> LoopScores:
    """Run a machine with edge, link and twin."""
    simulation = machine.simulation()
    cosimulation = Cosimulation(machine.scenario, SimulatedMachine(machine.scenario, simulation))
    while not cosimulation.done:
        cosimulation.advance()
    loop = cosimulation.loop(simulation.run())
    applied = {receipt.version for receipt in loop.receipts if receipt.applied}
    times = {(window.boot, window.sequence): window.middle for window in loop.windows}
    estimates = [u for u in loop.updates if u.version in applied and u.status == "ok"]
    true = [float(np.interp(times[update.window], loop.run.time, loop.run.gap)) for update in estimates]
    errors, outside = zip(*map(_off, estimates, true), strict=True) if estimates else ((), ())
    return scored(machine, loop.run)._replace(
        updates=float(len(applied)),
        off=float(sum(error > _GAP_OFF for error in errors)),
        worst=max(errors, default=0.0),
        outside=float(sum(error > _GAP_OFF and out for error, out in zip(errors, outside, strict=True))),
        fallbacks=float(len(loop.fallbacks)),
    )


def _off(update: Update, gap: float) -> tuple[float, bool]:
    """Error of an update's gap, rad, and if the true one lies outside of its interval."""
    if update.gap is None:
        return 0.0, False
    low, high = update.interval
    return abs(update.gap - gap), (low is not None and gap < low) or (high is not None and gap > high)


def scored(machine: WornMachine, run: Run) -> LoopScores:
    """Measure a run; the first step begins at zero and is half as large as the others."""
    error = (run.reference - run.position)[:-1].reshape(STEPS, -1)
    sizes = np.full(STEPS, 2.0 * machine.amplitude)
    sizes[0] = machine.amplitude
    costs = np.abs(error).mean(axis=1) * HALF_PERIOD / sizes
    last = error[-1, -round(RATE * HALF_PERIOD / 3.0) :]
    still = _STILL * sizes[-1] + 2.0 * machine.model.position_resolution
    return LoopScores(
        cost=float(costs.mean()),
        later=float(costs[_FIRST:].mean()),
        settled=float(0.5 * np.ptp(last) <= still),
        tail=float(np.abs(last).max()),
    )


def _units(blocks: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, _Task]]:
    """Machines of all blocks by turns, so that a run that ends early has as many of each."""
    drawn = {block: worn_machines(block, count, seed) for block in blocks}
    for place in range(count):
        yield from ((f"{seed}/{block}/{place}", _Task(place, machines[place])) for block, machines in drawn.items())


def _numbers(task: _Task) -> dict[str, dict[str, float]]:
    return {name: scores._asdict() for name, scores in _compared(task).items()}


def _show(found: Mapping[str, Any], console: Console) -> None:
    """A table for each block, of all its machines of whatever seed."""
    for block in BLOCKS:
        those = [numbers for key, numbers in sorted(found.items()) if key.split("/")[1] == block]
        if those:
            scores = [{name: LoopScores(**each) for name, each in numbers.items()} for numbers in those]
            console.print(shown(best_rows(block, scores)))


BATCH = Batch(_units, _numbers, _show, BLOCKS)
"""For `benchmarks.batch`."""


def shown(rows: Sequence[LoopRow]) -> Table:
    """A line for each contender."""
    result = Table(title="whole twin in the loop, worn machines", title_justify="left", box=None, pad_edge=False)
    for heading in ("block", "contender"):
        result.add_column(heading)
    numbers = ("machines", "settled\n%", "cost med\ns", "cost p95\ns", "later p95\ns", "tail p95\num")
    for heading in (*numbers, "updates", "gap off\n> 0.05 deg", "outside", "worst\ndeg", "fallbacks"):
        result.add_column(heading, justify="right")
    for row in rows:
        result.add_row(
            row.block,
            row.name,
            str(len(row.scores)),
            f"{100.0 * row.total('settled') / len(row.scores):.1f}",
            f"{row.at('cost', 50.0):.3f}",
            f"{row.at('cost', 95.0):.3f}",
            f"{row.at('later', 95.0):.3f}",
            f"{1e6 * row.at('tail', 95.0):.1f}",
            *(f"{row.total(name):.0f}" for name in ("updates", "off", "outside")),
            f"{math.degrees(row.at('worst', 100.0)):.3f}",
            f"{row.total('fallbacks'):.0f}",
        )
    return result
