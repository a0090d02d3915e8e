"""Random axes, and the estimates of their twins: no preset, but what a stranger has.

``python -m benchmarks.batch axes-random --seed 5 --count 40 FILE``: torque drives, DC motors and velocity drives, one
to three masses, with and without friction, encoders of any fineness, a controller by `tune`, 7.5 to 30 samples in a
period of the motor against its load; stiffness 5 %, damping 30 %, motor 10 %, friction 40 % off the model. Axes for
which no controller is found are drawn anew. `BLOCKS` are shafts that are free in the gap, by their actuators, and
`HELD_BLOCKS` screws that the gap holds, half of them under a constant force: ``--blocks "held,held cascade"``.

``windows-random`` estimates from windows of their second to fourth step without a twin, below 6000 samples: faster.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.axis_presets import judged
from benchmarks.batch import Batch
from servotwin.commissioning.edge_settings import Recording
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.cosim import Cosimulation, SimulatedMachine
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.design import tune
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.actuator import Actuator, DcMotor, TorqueDrive, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate
from servotwin.twin.settings import TwinSettings

NAME, WINDOWS = "axes-random", "windows-random"
BLOCKS = ("torque", "dc motor", "velocity")
"""Actuators of free shafts."""
HELD_BLOCKS = ("held", "held cascade", "held velocity", "rigid")
"""Elastic screws behind DC motors, under controllers by `tune` and under cascades whose velocity loops are 4 to 16
times as fast as their position loops; behind velocity drives; rigid screws behind DC motors."""
_ERRORS = {"k": 0.05, "c": 0.3, "k_T": 0.1, "k_B": 0.1, "motor_friction": 0.4, "load_friction": 0.4}
_STEPS, _KINDS = 8, ("PD", "PIDF", "P", "PI")
_LATER, _MOST_SAMPLES = (1, 2, 3), 6000  # steps whose windows are estimated without a twin
_LENGTH, _BEFORE = 0.5, 0.05  # of a step: window, and its part before the step


class RandomAxis(NamedTuple):
    """An axis, its machine, amplitude (m or rad), time of a step (s) and total gap (rad)."""

    model: Axis
    plant: Axis
    amplitude: float
    half_period: float
    gap: float


class AxisTask(NamedTuple):
    """What `random_axis` draws from."""

    block: str
    seed: int
    place: int


def random_axis(block: str, seed: int, place: int) -> RandomAxis:
    """Draw an axis for which there is a controller."""
    random = np.random.default_rng([seed, (*BLOCKS, *HELD_BLOCKS).index(block), place])
    while True:
        try:
            return _drawn(block, random)
        except InvalidInput:
            continue


def _drawn(block: str, random: np.random.Generator) -> RandomAxis:
    def log(low: float, high: float) -> float:
        return float(10.0 ** random.uniform(low, high))

    mass, pitch, shaft = log(-3, 3), log(-4, 0), 2.0 * math.pi * log(0.3, 2.2)
    crossover, inertia = shaft * log(-1.6, -0.9), mass * pitch**2 / log(-0.7, 1)
    amplitude, damped = pitch * log(0.3, 1.2), log(-2.3, -0.9)
    torque = (inertia + mass * pitch**2) * crossover**2 * amplitude / pitch
    rubs = [torque * log(-2.5, -1) if random.random() < 0.45 else 0.0 for _ in range(2)]
    speed = block.endswith("velocity")
    motor = _motor("velocity" if speed else block, inertia, crossover, 0.0 if speed else rubs[0], log)
    masses, stiffness = int(random.choice([1, 1, 1, 2, 3])), mass * shaft**2
    held = block in HELD_BLOCKS
    weight = torque / pitch * random.uniform(-0.3, 0.3) if held and random.random() < 0.5 else 0.0
    load = Load(
        (mass / masses,) * masses,
        (0.0, *(stiffness * random.uniform(0.5, 2.0) for _ in range(masses - 1))),
        (mass * crossover * random.uniform(0.5, 3.0) * 2.0 * damped, *[2.0 * damped * mass * shaft] * (masses - 1)),
        friction=rubs[1] / pitch,
        force=weight,
    )
    damping = 2.0 * damped * mass * shaft if random.random() < 0.8 else 0.0
    if block == "rigid":
        stiffness, damping = math.inf, 0.0
    screw = Transmission(pitch, stiffness, damping, "held" if held else "free")
    sensors = Sensors(log(-4.5, -2.5), amplitude * log(-5.5, -3.5))
    axis = Axis(motor, screw, load, Controller(1.0, 0.0, 0.0, 1.0 / crossover), sensors)
    kind, margin = str(random.choice(_KINDS)), math.radians(random.uniform(45.0, 65.0))
    law: AnyController
    if block == "held cascade":
        law = _cascade(pitch, inertia + mass * pitch**2, crossover, log)
    else:
        tuned = tune(axis, crossover, margin, kind=kind).controller
        law = tuned.replace(Tf=max(tuned.Tf, 0.05 / crossover))
    yields = 0.0 if speed else mass * pitch**2 / inertia
    rate = shaft / (2.0 * math.pi) * math.sqrt(1.0 + yields) * log(math.log10(7.5), math.log10(30.0))
    axis = axis.replace(controller=law.replace(sample_rate=rate))
    if block == "held cascade" and not axis.margins().stable:
        raise InvalidInput("the cascade is unstable at its sample rate")
    errors = {name: 1.0 + width * random.uniform(-1.0, 1.0) for name, width in _ERRORS.items()}
    half_period = round(max(24.0 * math.pi / crossover * random.uniform(0.5, 1.2), 1000.0 / rate) * rate) / rate
    gap = min(log(-1.7, -0.3), 0.25 * amplitude / pitch)
    return RandomAxis(axis, axis.scaled(errors), amplitude, half_period, gap)


def _motor(block: str, inertia: float, crossover: float, friction: float, log: Any) -> Actuator:
    if block == "velocity":
        return VelocityDrive(log(-1.5, -0.7) / crossover)
    if block == "torque":
        return TorqueDrive(inertia, friction=inertia * crossover * log(-1, 0.5), coulomb=friction)
    resistance = log(-1, 1)
    gain = math.sqrt(resistance * inertia * crossover * log(-1, 1.5))
    return DcMotor(inertia, resistance, gain, gain, friction=0.1 * inertia * crossover, coulomb=friction)


def _cascade(pitch: float, inertia: float, crossover: float, log: Any) -> Cascade:
    """A cascade of a crossover (rad/s), for all that turns (kg m^2 at the motor)."""
    speed = crossover * log(math.log10(4.0), math.log10(16.0))
    return Cascade(crossover, pitch, inertia * speed, log(0.4, 1.2) / speed, 0.1 / speed)


def measured(task: AxisTask) -> dict[str, Any]:
    """Estimates of an axis under its own controller."""
    drawn = random_axis(*task)
    rate = drawn.model.controller.sample_rate
    assert rate is not None
    try:
        scenario = Scenario(
            servo=drawn.model,
            duration=_STEPS * drawn.half_period,
            reference=SquareWave(drawn.amplitude, 2.0 * drawn.half_period),
            gap=drawn.gap,
            recording=Recording(
                sample_rate=rate,
                window=round(_LENGTH * drawn.half_period * rate) / rate,
                pre_trigger=round(_BEFORE * drawn.half_period * rate) / rate,
            ),
            twin=TwinSettings(policy="paper", k_dz=0.0),
        )
        simulation = simulation_of(scenario, drawn.plant)
        cosimulation = Cosimulation(scenario, SimulatedMachine(scenario, simulation))
        while not cosimulation.done:
            cosimulation.advance()
        loop = cosimulation.loop(simulation.run())
    except InvalidInput as error:
        return {"refused": str(error)}
    return _judged(drawn, loop.estimates)


def step_window(drawn: RandomAxis, step: int) -> Window:
    """The window of a step of its machine under its own controller; the first step is 0."""
    rate, half_period = drawn.model.controller.sample_rate, drawn.half_period
    assert rate is not None
    reference = SquareWave(drawn.amplitude, 2.0 * half_period)
    run = simulate(drawn.plant, (step + 1) * half_period, reference=reference, gap=drawn.gap, sample_rate=rate)
    begin = round(step * half_period * rate) - round(_BEFORE * half_period * rate)
    return Window.from_run(run, begin / rate, round(_LENGTH * half_period * rate) / rate)


def measured_windows(task: AxisTask) -> dict[str, Any]:
    """Estimates from windows of an axis under its own controller."""
    drawn = random_axis(*task)
    windows = [step_window(drawn, step) for step in _LATER]
    windows = [window for window in windows if window.position.size <= _MOST_SAMPLES]
    return _judged(drawn, [estimate_gap(window, drawn.model) for window in windows])


def _judged(drawn: RandomAxis, estimates: Sequence[GapEstimate]) -> dict[str, Any]:
    sensors = drawn.model.sensors
    count = max(sensors.encoder_resolution, sensors.position_resolution / drawn.model.p)
    accepted = [judged(each, (drawn.gap,) * 3, count) for each in estimates if each.ok]
    bounds = [each.gap / drawn.gap for each in estimates if each.status is GapStatus.LOWER_BOUND]
    return {"windows": len(estimates), "estimates": accepted, "bounds": bounds}


def axis_tasks(blocks: Sequence[str], count: int, seed: int) -> Iterator[tuple[str, AxisTask]]:
    """Keys and tasks of so many axes of each block."""
    for place in range(count):
        yield from ((f"{seed}/{block}/{place}", AxisTask(block, seed, place)) for block in blocks)


def _show(found: Mapping[str, Any], console: Console) -> None:
    """A line for each block, and the axes with false estimates or bounds above the gap."""
    table = Table(title="random axes: estimates of a gap that stands still", title_justify="left", box=None)
    table.add_column("block")
    for heading in ("axes", "refused", "windows", "accepted", "inside", "near", "false", "bounds", "above"):
        table.add_column(heading, justify="right")
    for block in (*BLOCKS, *HELD_BLOCKS):
        axes = [numbers for key, numbers in found.items() if key.split("/")[1] == block]
        ran = [each for each in axes if "refused" not in each]
        estimates = [estimate for each in ran for estimate in each["estimates"]]
        counts = [len(axes), len(axes) - len(ran), sum(each["windows"] for each in ran), len(estimates)]
        counts += [int(sum(each[name] for each in estimates)) for name in ("inside", "near")]
        bounds = [bound for each in ran for bound in each.get("bounds", ())]
        counts += [sum(map(_is_false, estimates)), len(bounds), sum(bound > 1.0 for bound in bounds)]
        table.add_row(block, *map(str, counts))
    console.print(table)
    for key, numbers in found.items():
        wrong = sum(map(_is_false, numbers.get("estimates", ())))
        above = sum(bound > 1.0 for bound in numbers.get("bounds", ()))
        if wrong or above:
            console.print(f"{key}: {wrong} false, {above} bounds above the gap", highlight=False)


def _is_false(estimate: Mapping[str, float]) -> bool:
    return not estimate["near"] and not estimate["inside"]


BATCHES = {
    NAME: Batch(axis_tasks, measured, _show, (*BLOCKS, *HELD_BLOCKS)),
    WINDOWS: Batch(axis_tasks, measured_windows, _show, (*BLOCKS, *HELD_BLOCKS)),
}
"""For `benchmarks.batch`."""
