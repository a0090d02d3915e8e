"""Every axis preset with its twin in the loop, while its gap grows from nothing to ten times the healthy one.

The gap grows in levels, between windows where they leave room: a machine that wears in years has one gap in a window.

``python -m benchmarks.batch axes --seed 5 --count 45 FILE`` measures the twin's estimates while the preset's own
controller runs; ``axes-certified`` instead of ``axes`` lets the twin send verified settings to machines worn
by any amount. The blocks are the presets, and `two-mass-cascade`, the two-mass drive with a cascade.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.batch import Batch
from servotwin.commissioning.edge_settings import Recording
from servotwin.control.cascade import Cascade
from servotwin.cosim import Cosimulation, Loop, SimulatedMachine
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.probe import ProbeLimits
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.simulation import Run, Simulation
from servotwin.twin.settings import TwinSettings

NAME, CERTIFIED = "axes", "axes-certified"
WORN = 10.0
"""Largest gap over the healthy one."""
LEVELS, CERTIFIED_STEPS = 12, 4


class Duty(NamedTuple):
    """What a preset does.

    Attributes
    ----------
    gap : float
        Healthy gap at the load, m or rad, as the preset's file states it.
    half_period : float
        s, between two steps.
    before, window : float
        Of the half period: part of a window before a step, and length of a window. A motor that comes to rest without
        overshoot touches one flank in each step, so that a window must hold two of them.
    hold : int
        Half periods of each level of the gap. Windows longer than a half period overlap: one of them sees each move.
    lead : float
        Largest error of the screw's lead, relative. Where it is stated, steps do not tell it from the gap.
    probe : float
        Largest probing move that the twin may request, m or rad; 0: none.
    moves : (float, float)
        Part of a half period in which the gap moves to its next level: after the windows that end 0.55 past a step, and
        after a probing move that follows from one of these.
    """

    gap: float
    half_period: float
    before: float = 0.05
    window: float = 0.5
    hold: int = 1
    lead: float = 0.0
    probe: float = 0.0
    moves: tuple[float, float] = (0.6, 0.9)


CASCADED = "two-mass-cascade"
_CASCADE = Cascade(2.0, 1.0, velocity_gain=30.0, integral_time=0.5, voltage_limit=60.0, sample_rate=2000.0)


def machine_of(name: str) -> Axis:
    """A preset, or the two-mass drive with a cascade in place of its filtered PID."""
    axis = Axis.preset(_preset(name))
    return axis.replace(controller=_CASCADE) if name == CASCADED else axis


def _preset(name: str) -> str:
    return "two-mass-drive" if name == CASCADED else name


_ARC_SECOND = math.radians(1.0 / 3600.0)
DUTIES: Mapping[str, Duty] = {
    "two-mass-drive": Duty(2e-3, 10.0),
    "ball-screw": Duty(5e-6, 0.4),
    "robot-joint": Duty(math.radians(0.05), 4.0),
    "telescope": Duty(10.0 * _ARC_SECOND, 40.0),
    "stepper-stage": Duty(2e-6, 5.0, 0.95, 1.5, 3, lead=6e-3, probe=2e-4, moves=(0.86, 0.98)),
    "micro-positioner": Duty(200e-9, 3.0, 0.95, 1.5, 3),
    "gantry": Duty(5e-5, 5.0),
    "emps": Duty(1e-5, 1.0),
}
MACHINES = (*DUTIES, CASCADED)
# Model's errors, relative; amplitudes of the reference in healthy gaps.
_ERRORS = {"k": 0.05, "c": 0.3, "k_T": 0.1, "k_B": 0.1}
_AMPLITUDES = (30.0, 100.0)
# A step has settled where the error's half peak-to-peak over the last third of its time is below this share of it, and
# two counts of the sensor.
_STILL, _COUNTS = 0.01, 2.0
# Of the gap: largest error of an accepted estimate.
_EXACT = 0.01


@dataclass(frozen=True)
class PresetMachine:
    """One machine of a preset.

    Attributes
    ----------
    name : str
        Of the preset.
    plant : Axis
        As it is; twin and edge know the preset.
    amplitude : float
        m or rad, of the reference.
    worn : (float, float)
        First and last gap over the healthy one.
    steps : int
        0: as many as the levels take.
    certified : bool
        True where the twin sends verified settings; otherwise the preset's own controller runs on.
    """

    name: str
    plant: Axis
    amplitude: float
    worn: tuple[float, float] = (0.0, WORN)
    steps: int = 0
    certified: bool = False

    def __post_init__(self) -> None:
        if not self.steps:
            object.__setattr__(self, "steps", LEVELS * DUTIES[_preset(self.name)].hold)

    @property
    def model(self) -> Axis:
        """The preset."""
        return machine_of(self.name)

    @property
    def duration(self) -> float:
        """Length of the run, s."""
        return self.steps * DUTIES[_preset(self.name)].half_period

    @property
    def gap(self) -> PiecewiseCubic:
        """Total gap, rad at the motor, level after level."""
        duty, healthy = DUTIES[_preset(self.name)], DUTIES[_preset(self.name)].gap / self.model.p
        count = -(-self.steps // duty.hold)
        levels = healthy * np.linspace(*self.worn, count)
        times, pieces = [0.0], [[levels[0], 0.0, 0.0, 0.0]]
        for place in range(1, count) if self.worn[0] != self.worn[1] else ():
            begin, end = (duty.half_period * (place * duty.hold - 1.0 + part) for part in duty.moves)
            rise, length = levels[place] - levels[place - 1], end - begin
            times += [begin, end]
            pieces += [[levels[place - 1], 0.0, 3.0 * rise / length**2, -2.0 * rise / length**3]]
            pieces += [[levels[place], 0.0, 0.0, 0.0]]
        return PiecewiseCubic(np.array(times), np.array(pieces))

    @property
    def reference(self) -> SquareWave:
        """To and fro."""
        return SquareWave(self.amplitude, 2.0 * DUTIES[_preset(self.name)].half_period)

    @property
    def count(self) -> float:
        """One count of the coarser encoder, rad at the motor."""
        sensors = self.model.sensors
        return max(sensors.encoder_resolution, sensors.position_resolution / self.model.p)

    @property
    def rate(self) -> float:
        """Sample rate of the controller, Hz."""
        rate = self.model.controller.sample_rate
        assert rate is not None
        return rate

    def scenario(self) -> Scenario:
        """The machine with its twin.

        Raises
        ------
        InvalidInput
            A twin cannot be had.
        """
        model, duty = self.model, DUTIES[_preset(self.name)]
        most = _AMPLITUDES[1] * duty.gap
        ranges = Uncertainty(gap=(0.0, 1.5 * WORN * duty.gap / model.p), step=(_AMPLITUDES[0] * duty.gap, 2.0 * most))
        rate, probe = self.rate, duty.probe
        excitation = ExcitationSettings(probe=probe) if probe else None
        own = TwinSettings(policy="paper", k_dz=0.0, excitation=excitation)
        return Scenario(
            servo=model,
            duration=self.duration,
            reference=self.reference,
            gap=self.gap,
            recording=Recording(
                sample_rate=rate,
                window=_whole(duty.window * duty.half_period, rate),
                pre_trigger=_whole(duty.before * duty.half_period, rate),
                probe=ProbeLimits(probe) if probe else None,
            ),
            twin=TwinSettings(uncertainty=ranges, excitation=excitation) if self.certified else own,
        )

    def alone(self) -> Run:
        """Run under the preset's own controller."""
        simulation = Simulation(
            self.plant,
            self.duration,
            reference=self.reference,
            gap=self.gap,
            sample_rate=self.rate,
        )
        simulation.advance(simulation.samples - 1)
        return simulation.run()


def _whole(seconds: float, rate: float) -> float:
    return round(seconds * rate) / rate


def preset_machines(name: str, count: int, seed: int) -> list[PresetMachine]:
    """Draw machines of a preset whose gap grows."""
    random, model = np.random.default_rng([seed, AXES.index(_preset(name))]), machine_of(name)
    return [_drawn(name, model, random) for _ in range(count)]


def certified_machines(name: str, count: int, seed: int) -> list[PresetMachine]:
    """Draw machines of a preset with any gap up to the largest, to which the twin sends verified settings."""
    random = np.random.default_rng([seed, AXES.index(_preset(name)), 1])
    worn = [float(random.uniform(0.0, WORN)) for _ in range(count)]
    return [
        replace(machine, worn=(gap, gap), steps=CERTIFIED_STEPS, certified=True)
        for machine, gap in zip(preset_machines(name, count, seed), worn, strict=True)
    ]


def _drawn(name: str, model: Axis, random: np.random.Generator) -> PresetMachine:
    errors, duty = (
        {each: 1.0 + width * random.uniform(-1.0, 1.0) for each, width in _ERRORS.items()},
        DUTIES[_preset(name)],
    )
    amplitude = duty.gap * math.exp(random.uniform(*np.log(_AMPLITUDES)))
    if duty.lead:
        errors["p"] = 1.0 + duty.lead * random.uniform(-1.0, 1.0)
    return PresetMachine(name, model.scaled(errors), amplitude)


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
        "cost": (np.abs(error).mean(axis=1) * DUTIES[_preset(machine.name)].half_period / sizes).tolist(),
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
    for name in MACHINES:
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
    NAME: Batch(partial(_units, preset_machines), measured, _show, MACHINES),
    CERTIFIED: Batch(partial(_units, certified_machines), measured, _show, MACHINES),
}
"""For `benchmarks.batch`."""
