"""Every axis preset with its twin in the loop, while its gap grows from nothing to ten times the healthy one.

The gap grows in levels, between windows where they leave room: a machine that wears in years has one gap in a window.

``python -m benchmarks.batch axes --seed 5 --count 45 FILE`` measures the twin's estimates while the preset's own
controller runs; ``axes-growing`` instead of ``axes`` lets the twin send verified settings while the gap grows, and
``axes-certified`` to machines worn by any amount. The blocks are the presets.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.batch import Batch
from benchmarks.preset_machines import DUTIES, PresetMachine, certified_machines, growing_machines, preset_machines
from servotwin.cosim import Cosimulation, Loop, SimulatedMachine
from servotwin.cosim.machine import simulation_of
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate
from servotwin.simulation import Run

NAME, GROWING, CERTIFIED = "axes", "axes-growing", "axes-certified"
# A step has settled where the error's half peak-to-peak over the last third of its time is below this share of it, and
# two counts of the sensor.
_STILL, _COUNTS = 0.01, 2.0
# Of the gap: largest error of an accepted estimate.
_EXACT = 0.01


def with_twin(machine: PresetMachine) -> Loop:
    """Run a machine with edge, link and twin.

    Raises
    ------
    InvalidInput
        A twin cannot be had.
    """
    scenario = machine.scenario()
    scenario.agent_settings()
    simulation = simulation_of(scenario, machine.plant)
    cosimulation = Cosimulation(scenario, SimulatedMachine(scenario, simulation))
    while not cosimulation.done:
        cosimulation.advance()
    return cosimulation.loop(simulation.run())


def measured(machine: PresetMachine) -> dict[str, Any]:
    """Numbers of a machine with its twin, and under the preset's own controller."""
    found: dict[str, Any] = {"own": steps_of(machine, machine.alone())}
    try:
        loop = with_twin(machine)
    except InvalidInput as error:
        return found | {"refused": str(error)}
    ends = np.array(
        [
            [window.start, each.time, 2.0 * each.time - window.start]
            for window, each in zip(loop.windows, loop.estimates, strict=True)
        ]
    )
    true = np.interp(ends, loop.run.time, loop.run.gap)
    return found | {
        "twin": steps_of(machine, loop.run),
        "statuses": [each.status.value for each in loop.estimates],
        "reasons": ["; ".join(each.reasons) for each in loop.estimates],
        "estimates": [
            judged(each, (first, gap, last), machine.count)
            for each, (first, gap, last) in zip(loop.estimates, true.tolist(), strict=True)
            if each.ok
        ],
        "windows": [window.reason for window in loop.windows],
        "sent": len(loop.updates),
        "applied": len(loop.applied),
        "fallbacks": len(loop.fallbacks),
    }


def judged(estimate: GapEstimate, gaps: tuple[float, float, float], count: float) -> dict[str, float]:
    """An accepted estimate: gap (rad) in the middle of its window, error, and 1.0 where the interval contains that gap.

    It is near where it is off by at most 1 % or two counts from a gap that the machine had within the window, from the
    first to the last of `gaps`; steady where they are the same, as in all windows that see no move.
    """
    (first, gap, last), (low, high) = gaps, estimate.interval
    error = max(first - estimate.gap, estimate.gap - last, 0.0)
    near = error <= max(_EXACT * gap, _COUNTS * count)
    return {"gap": gap, "error": error, "inside": float(low <= gap <= high), "near": float(near)} | {
        "steady": float(first == last)
    }


def steps_of(machine: PresetMachine, run: Run) -> dict[str, list[float]]:
    """Of each step: 1.0 where it has settled, its cost (s), and the largest error in the end (of the step)."""
    error = (run.reference - run.position)[:-1].reshape(machine.steps, -1)
    sizes = np.full(machine.steps, 2.0 * machine.amplitude)
    sizes[0] = machine.amplitude
    last = error[:, -(error.shape[1] // 3) :]
    still = _STILL * sizes + _COUNTS * machine.model.position_resolution
    return {
        "settled": (0.5 * np.ptp(last, axis=1) <= still).astype(float).tolist(),
        "cost": (np.abs(error).mean(axis=1) * DUTIES[machine.name].half_period / sizes).tolist(),
        "tail": (np.abs(last).max(axis=1) / sizes).tolist(),
    }


def _units(
    draw: Callable[[str, int, int], list[PresetMachine]], names: Sequence[str], count: int, seed: int
) -> Iterator[tuple[str, PresetMachine]]:
    """Machines of all presets by turns."""
    drawn = {name: draw(name, count, seed) for name in names}
    for place in range(count):
        yield from ((f"{seed}/{name}/{place}", machines[place]) for name, machines in drawn.items())


def _show(found: Mapping[str, Any], console: Console) -> None:
    """A line for each preset, of all its machines of whatever seed, and what was refused."""
    result = Table(title="axes: gap from 0 to ten times the healthy one", title_justify="left", box=None)
    result.add_column("preset")
    for heading in (
        *("machines", "windows", "accepted", "inside\n%", "near\n%", "false", "worst\n% of gap"),
        *("settled\n%", "cost p95\ns", "own:\nsettled %", "own: cost\np95 s", "applied", "fallbacks"),
    ):
        result.add_column(heading, justify="right")
    notes = []
    for name in DUTIES:
        machines = [numbers for key, numbers in found.items() if key.split("/")[1] == name]
        refused = sorted({each["refused"] for each in machines if "refused" in each})
        ran = [each for each in machines if "twin" in each]
        notes += [f"{name}: {reason}" for reason in refused]
        if machines:
            result.add_row(name, str(len(machines)), *_line(ran, machines))
        notes += [f"{name}: {count} x {words}" for words, count in _doubts(ran).most_common(6)]
    console.print(result)
    for note in notes:
        console.print(note, markup=False, highlight=False)


def _share(ones: Iterable[float]) -> str:
    ones = list(ones)
    return f"{100.0 * sum(ones) / max(1, len(ones)):.1f}"


def _line(ran: Sequence[Mapping[str, Any]], machines: Sequence[Mapping[str, Any]]) -> list[str]:
    own = ["", ""] if not machines else [_settled(machines, "own"), _cost(machines, "own")]
    if not ran:
        return ["-"] * 8 + own + ["-"] * 2
    estimates = [each for machine in ran for each in machine["estimates"]]
    windows = sum(len(machine["statuses"]) for machine in ran)
    false = sum(not each["near"] and not each["inside"] for each in estimates)
    worst = max((each["error"] / each["gap"] for each in estimates if each["gap"] and not each["near"]), default=0.0)
    steady = [each for each in estimates if each["steady"]]
    return [
        str(windows),
        str(len(estimates)),
        *(_share(each[name] for each in part) for name, part in (("inside", steady), ("near", estimates))),
        str(false),
        f"{100.0 * worst:.2g}",
        _settled(ran, "twin"),
        _cost(ran, "twin"),
        *own,
        str(sum(machine["applied"] for machine in ran)),
        str(sum(machine["fallbacks"] for machine in ran)),
    ]


def _settled(machines: Sequence[Mapping[str, Any]], which: str) -> str:
    return f"{100.0 * np.mean([machine[which]['settled'][-1] for machine in machines]):.1f}"


def _cost(machines: Sequence[Mapping[str, Any]], which: str) -> str:
    return f"{np.percentile([np.mean(machine[which]['cost']) for machine in machines], 95.0):.4g}"


def _doubts(ran: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """Statuses other than OK, with the beginning of their reasons."""
    return Counter(
        f"{status}: {reason[:90]}"
        for machine in ran
        for status, reason in zip(machine["statuses"], machine["reasons"], strict=True)
        if status != "ok"
    )


BATCHES = {
    NAME: Batch(partial(_units, preset_machines), measured, _show, tuple(DUTIES)),
    GROWING: Batch(partial(_units, growing_machines), measured, _show, tuple(DUTIES)),
    CERTIFIED: Batch(partial(_units, certified_machines), measured, _show, tuple(DUTIES)),
}
"""For `benchmarks.batch`."""
