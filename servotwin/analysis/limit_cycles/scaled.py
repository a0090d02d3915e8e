"""The loop in units of its gap, its reference shifted to zero where that changes nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.analysis.limit_cycles.poincare import Flags
from servotwin.analysis.limit_cycles.symmetry import Mirror, mirror, moving, shift
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.margins import gain_crossovers
from servotwin.plant.servo import Servo
from servotwin.simulation.continuous import ContinuousEngine
from servotwin.simulation.simulate import Simulation

# Samples per characteristic time; the kernel searches for events on a step of its own.
LOOKS = 64


@dataclass(frozen=True, eq=False)
class ScaledLoop:
    """A loop at rest just after a reference step, divided by `unit`; the loop is homogeneous, so nothing else changes.

    Attributes
    ----------
    loop : ServoAutomaton
    state, mode : (n,) array, int
        At time 0.
    unit : float
        Multiplies every state of an orbit found here.
    displacement : (n,) array
        To be added afterwards: the reference that was shifted away.
    extent : float
        Scaled metres, of the gap at the screw (or of the tolerance, or of the step, where there is no gap).
    time : float
        s, one turn at the first gain crossover of the loop without a gap.
    free : (n,) boolean array
        States that move.
    mirror : Mirror or None
        The symmetry that the motions from this state have.
    """

    loop: ServoAutomaton
    state: Array
    mode: int
    unit: float
    displacement: Array
    extent: float
    time: float
    free: Flags
    mirror: Mirror | None

    @property
    def sample_step(self) -> float:
        """s."""
        return self.time / LOOKS

    def actual(self, state: Array) -> Array:
        """A state in SI units and with its reference."""
        return np.asarray(self.unit * state + self.displacement)


def scaled_loop(
    servo: Servo, gap: float, tolerance: float | None, controller: Controller | None, step: float
) -> ScaledLoop:
    """The loop at rest just after a reference step (m); see `limit_cycle`.

    Raises
    ------
    InvalidInput
        The controller is sampled or has a rate limit, or a number is outside its range.
    """
    law = servo.controller if controller is None else controller
    if law.sample_rate is not None:
        rate = f"sample_rate = {law.sample_rate:g} Hz"
        raise InvalidInput(f"controller {rate}: limit cycles are those of the continuous law; give sample_rate = None")
    if not (math.isfinite(gap) and gap >= 0.0):
        raise InvalidInput(f"gap = {gap!r} rad: must be finite and 0 or more")
    dead_zone = tolerance if tolerance else None
    time = characteristic_time(servo, law)
    engine = Simulation(servo, time, controller=law, reference=step, gap=gap, tolerance=dead_zone).engine
    assert isinstance(engine, ContinuousEngine)
    loop, state, mode = engine.loop, engine.trajectory.state, engine.trajectory.mode
    direction, free = shift(servo, loop), moving(loop)
    displacement = np.zeros(len(state)) if direction is None else step * direction
    unit = gap or (dead_zone or abs(step)) / servo.p
    scaled = (state - displacement) / unit
    reflection = mirror(loop)
    # A constant that the mirror would turn round must be zero for it to map motions to motions of the same loop.
    if reflection is not None and np.any(scaled[~free & (reflection.signs < 0.0)] != 0.0):
        reflection = None
    return ScaledLoop(loop, scaled, mode, unit, displacement, servo.p, time, free, reflection)


def characteristic_time(servo: Servo, controller: Controller) -> float:
    """s: one turn at the first gain crossover without a gap, or, where there is none, of the slowest lasting motion."""
    crossovers = gain_crossovers(servo.loop(controller))
    if crossovers:
        return 2.0 * math.pi / crossovers[0].omega
    sizes = np.abs(servo.closed_loop(controller).poles())
    return float(2.0 * math.pi / np.min(sizes[sizes > 0.0]))
