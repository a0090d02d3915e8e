"""The exact limit cycle near one that the describing function predicts: unstable ones too, which no run shows."""

from __future__ import annotations

import math

import numpy as np

from servotwin.analysis.limit_cycles.cycle import CycleResult, CycleStatus
from servotwin.analysis.limit_cycles.describing import Prediction, play_function
from servotwin.analysis.limit_cycles.poincare import Firing, LostOrbit, Section
from servotwin.analysis.limit_cycles.scaled import ScaledLoop, scaled_loop
from servotwin.analysis.limit_cycles.shooting import closed_orbit
from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.linear import Complex
from servotwin.plant.servo import Servo

# The motor turns round against the screw's positive flank: the mode and guard at the crest of the motor's angle.
_CREST = ("+/on", "release", 1)


def limit_cycle_near(
    servo: Servo, gap: float, prediction: Prediction, controller: Controller | None = None
) -> CycleResult:
    """The symmetric orbit to which Newton's method goes from a prediction; the loop has no dead zone.

    Parameters
    ----------
    servo : Servo
    gap : float
        rad, total gap.
    prediction : Prediction
        From `predictions`, of the same loop.
    controller : Controller, optional
        Continuous; the servo's own by default.

    Returns
    -------
    CycleResult
        Status CYCLE or, when the prediction leads to no orbit, IRREGULAR with the reason.
    """
    law = servo.controller if controller is None else controller
    # At rest about a zero reference; what this step would do is never run.
    loop = scaled_loop(servo, gap, None, law, step=gap * servo.p)
    start = crest(servo, loop, prediction, law) / loop.unit
    section = _section(loop, prediction)
    swings = np.abs(phasors(servo, loop, prediction, law)) / loop.unit
    swings[swings == 0.0] = 1.0
    try:
        found = closed_orbit(loop, section, start, swings, True)
    except (LostOrbit, ZenoError) as error:
        return CycleResult(CycleStatus.IRREGULAR, None, f"Newton's method from the prediction: {error}")
    return CycleResult(CycleStatus.CYCLE, found.orbit, "")


def crest(servo: Servo, loop: ScaledLoop, prediction: Prediction, law: Controller) -> Array:
    """(n,) predicted state, SI units and zero reference, when the motor's angle is largest."""
    state = phasors(servo, loop, prediction, law).real
    at = loop.loop.automaton.index
    gap = loop.unit * loop.state[at("gap")]
    state[at("gap")], state[at("speed")] = gap, 0.0
    # Not the harmonic but the clamp itself: the screw lies on its flank.
    state[at("theta_d")] = prediction.motor_amplitude - 0.5 * gap
    return np.asarray(state)


def phasors(servo: Servo, loop: ScaledLoop, prediction: Prediction, law: Controller) -> Complex:
    """(n,) first harmonics of all states, that of the motor's angle real."""
    at, result = loop.loop.automaton.index, np.zeros(len(loop.state), dtype=complex)
    s = 2j * math.pi * prediction.frequency
    gap = loop.unit * loop.state[at("gap")]
    motor = prediction.motor_amplitude
    screw = motor * play_function(motor, gap)
    chain = servo.chain()
    drive = servo.p * (chain.B_position + s * chain.B_velocity)
    masses = np.linalg.solve(s * np.eye(chain.A.shape[0]) - chain.A, drive) * screw
    first = at("chain0")
    result[first : first + masses.size] = masses
    position = chain.C_last @ masses
    result[at("theta_m")], result[at("speed")], result[at("theta_d")] = motor, s * motor, screw
    result[at("current")] = servo.J * s * s * motor / servo.k_T
    measured = position
    if law.loop_filter_hz is not None:
        measured = result[at("filtered")] = position / (1.0 + s / (2.0 * math.pi * law.loop_filter_hz))
    result[at("integral")] = -law.Ki * measured / s
    result[at("derivative")] = -measured / (law.Tf * s + 1.0)
    return np.asarray(result)


def _section(loop: ScaledLoop, prediction: Prediction) -> Section:
    automaton = loop.loop.automaton
    name, label, side = _CREST
    mode = [candidate.name for candidate in automaton.modes].index(name)
    labels = [(guard.label, guard.side) for guard in automaton.modes[mode].guards]
    event = Firing(mode, labels.index((label, side)))
    return Section(automaton, event, event, 1, loop.sample_step, 3.0 / prediction.frequency)
