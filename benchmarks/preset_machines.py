"""Machines of the axis presets: their duty, a gap that grows in levels, and how they differ from their model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from servotwin.commissioning.edge_settings import Recording
from servotwin.cosim.scenario import Scenario
from servotwin.edge.probe import ProbeLimits
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.simulation import Run, Simulation
from servotwin.twin.settings import TwinSettings

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
        s, between two steps. A load that coasts comes to rest within it.
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


_ARC_SECOND = math.radians(1.0 / 3600.0)
DUTIES: Mapping[str, Duty] = {
    "two-mass-drive": Duty(2e-3, 30.0, 1.0 / 60.0, 1.0 / 6.0),
    "ball-screw": Duty(5e-6, 0.4),
    "robot-joint": Duty(math.radians(0.05), 16.0, 1.0 / 80.0, 1.0 / 8.0),
    "telescope": Duty(10.0 * _ARC_SECOND, 40.0),
    "stepper-stage": Duty(2e-6, 5.0, 0.95, 1.5, 3, lead=6e-3, probe=2e-4, moves=(0.86, 0.98)),
    "micro-positioner": Duty(200e-9, 3.0, 1.05, 1.6, 3),
    "gantry": Duty(5e-5, 5.0),
    "emps": Duty(1e-5, 1.0),
}


def stated_ranges(name: str) -> Uncertainty:
    """What a machine's file states: gaps up to one and a half times the largest, and steps as they come."""
    gap, (least, most) = DUTIES[name].gap, _AMPLITUDES
    return Uncertainty(gap=(0.0, 1.5 * WORN * gap / Axis.preset(name).p), step=(least * gap, 2.0 * most * gap))


# Model's errors, relative; amplitudes of the reference in healthy gaps.
_ERRORS = {"k": 0.05, "c": 0.3, "k_T": 0.1, "k_B": 0.1}
_AMPLITUDES = (30.0, 100.0)


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
            object.__setattr__(self, "steps", LEVELS * DUTIES[self.name].hold)

    @property
    def model(self) -> Axis:
        """The preset."""
        return Axis.preset(self.name)

    @property
    def duration(self) -> float:
        """Length of the run, s."""
        return self.steps * DUTIES[self.name].half_period

    @property
    def gap(self) -> PiecewiseCubic:
        """Total gap, rad at the motor, level after level."""
        duty, healthy = DUTIES[self.name], DUTIES[self.name].gap / self.model.p
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
        return SquareWave(self.amplitude, 2.0 * DUTIES[self.name].half_period)

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
        model, duty, ranges = self.model, DUTIES[self.name], stated_ranges(self.name)
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
            # A gap that grows tenfold within the run: a setting is to hold until the next one.
            twin=TwinSettings(uncertainty=ranges, excitation=excitation, horizon=duty.hold * duty.half_period)
            if self.certified
            else own,
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
    random, model = np.random.default_rng([seed, AXES.index(name)]), Axis.preset(name)
    return [_drawn(name, model, random) for _ in range(count)]


def growing_machines(name: str, count: int, seed: int) -> list[PresetMachine]:
    """Draw machines of a preset whose gap grows, to which the twin sends verified settings."""
    return [replace(machine, certified=True) for machine in preset_machines(name, count, seed)]


def certified_machines(name: str, count: int, seed: int) -> list[PresetMachine]:
    """Draw machines of a preset with any gap up to the largest, to which the twin sends verified settings."""
    random = np.random.default_rng([seed, AXES.index(name), 1])
    worn = [float(random.uniform(0.0, WORN)) for _ in range(count)]
    return [
        replace(machine, worn=(gap, gap), steps=CERTIFIED_STEPS, certified=True)
        for machine, gap in zip(preset_machines(name, count, seed), worn, strict=True)
    ]


def _drawn(name: str, model: Axis, random: np.random.Generator) -> PresetMachine:
    errors, duty = (
        {each: 1.0 + width * random.uniform(-1.0, 1.0) for each, width in _ERRORS.items()},
        DUTIES[name],
    )
    amplitude = duty.gap * math.exp(random.uniform(*np.log(_AMPLITUDES)))
    if duty.lead:
        errors["p"] = 1.0 + duty.lead * random.uniform(-1.0, 1.0)
    return PresetMachine(name, model.scaled(errors), amplitude)
