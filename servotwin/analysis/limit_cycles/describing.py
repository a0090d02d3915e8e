"""Describing function of the backlash, the limit cycles that it predicts, and the exact cycle near a predicted one."""

from __future__ import annotations

import cmath
import math
from itertools import pairwise

import numpy as np
from numpy.polynomial import polynomial as poly

from servotwin.analysis.limit_cycles.cycle import CycleResult, CycleStatus, limit_cycle
from servotwin.analysis.limit_cycles.orbit import closed_orbit
from servotwin.analysis.limit_cycles.poincare import GuardId, LostOrbit, Section
from servotwin.analysis.limit_cycles.scaled import ScaledLoop, scaled_loop
from servotwin.analysis.limit_cycles.shaft import Prediction, shaft_predictions
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, Law, filtered_pid, law_of
from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import ZenoError
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.display_units import command_unit
from servotwin.plant.linear import Complex, LinearSystem
from servotwin.plant.margins import crossings, direction, gain_crossovers, search_frequencies
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant
from servotwin.plant.sensors import check_encoders

# Grid intervals within each band of frequencies in which a prediction is possible.
_GRID = 500
# From an amplitude of 1e12 gaps to one that exceeds half the gap by 2.5e-9 of it, where N is 3e-9.
_ANGLES = (1e-6, math.pi - 1e-4)


def play_function(amplitude: float, gap: float) -> complex:
    """N(A) of the play operator: first harmonic of theta_d per that of theta_m.

    Parameters
    ----------
    amplitude : float
        rad, A.
    gap : float
        rad, TOTAL gap; up to half of it (A <= gap / 2) nothing moves and N = 0.
    """
    if 2.0 * amplitude <= gap:
        return 0j
    return _play(math.acos(1.0 - gap / amplitude))


def predictions(servo: Plant, gap: float, controller: AnyController | None = None) -> tuple[Prediction, ...]:
    """All limit cycles that the describing function predicts for a constant gap, by frequency.

    Solutions lie where abs(L) >= 1 and the phase of L is between -180 and -90 deg, since N shrinks and lags by up to
    90 deg; the ends of these bands are roots of polynomials. In them the phase gives gap / A, and the modulus one
    equation.

    Raises
    ------
    InvalidInput
        The screw is elastic and held in the gap (its load makes the motor rest on a flank), there is friction or a
        constant force, the controller is sampled or saturates or, with rigid parts, is no filtered PID, or the gap is
        not a number above 0.
    """
    law = law_of(servo.controller if controller is None else controller)
    _check(servo, law, gap)
    if servo.backlash_kind is BacklashKind.FREE:
        return shaft_predictions(servo, gap, law)
    law = filtered_pid(law)
    loop = servo.loop(law)
    solutions = [omega for low, high in _bands(loop) for omega in _solutions(loop, low, high)]
    return tuple(_prediction(servo, loop, gap, omega) for omega in solutions)


def _solutions(loop: LinearSystem, low: float, high: float) -> list[float]:
    """Solutions within one band, rad/s, ascending, from a grid that is dense at its ends, in every decade from 0."""
    # Here and below, because scipy.optimize takes long to import and most commands need none of it.
    from scipy.optimize import brentq

    ends = [low, high] if low > 0.0 else [0.0, *(high * 10.0**k for k in range(-5, 1))]
    part = 0.5 * (1.0 - np.cos(np.pi * np.arange(_GRID + 1) / _GRID))
    grid = np.unique([a + (b - a) * part for a, b in pairwise(ends)])[1:-1].tolist()
    values = [_mismatch(loop, w) for w in grid]
    places = [i for i in range(len(grid) - 1) if values[i] * values[i + 1] < 0.0]
    return [float(brentq(lambda w: _mismatch(loop, w), grid[i], grid[i + 1], xtol=1e-14 * grid[i])) for i in places]


def _check(servo: Plant, law: Law, gap: float) -> None:
    check_encoders(servo, law)
    if servo.backlash_kind is BacklashKind.HELD:
        elastic = "the stiffness of the transmission" if isinstance(servo, Axis) else "servo k_d"
        raise InvalidInput(
            f"{elastic} is finite: the describing function needs a rigid screw (inf), or a shaft that is free in the "
            "gap, since behind a held elastic screw the motor rests on its flank, which is no harmonic motion"
        )
    if servo.at_motor and servo.rigid:
        raise InvalidInput(
            'sensors feedback = "motor": the gap is outside of a loop on the motor\'s encoder, behind a rigid screw'
        )
    if servo.motor_friction or servo.guide.friction or servo.guide.force:
        raise InvalidInput("the describing function is that of the gap alone; the axis has friction or a force too")
    if servo.command_limit is not None:
        raise InvalidInput(f"{_limit('actuator', servo, servo.command_limit)}: the describing function knows no limit")
    if law.voltage_limit is not None:
        raise InvalidInput(f"{_limit('controller', servo, law.voltage_limit)}: the describing function knows no limit")
    if law.sample_rate is not None:
        raise InvalidInput(
            f"controller sample_rate = {law.sample_rate:g} Hz: the describing function is that of the law"
            " in continuous time; give sample_rate = None"
        )
    if not (math.isfinite(gap) and gap > 0.0):
        raise InvalidInput(f"gap = {gap!r} rad: must be finite and greater than 0")


def _limit(part: str, servo: Plant, value: float) -> str:
    return f"{part} {own_units(servo).key('voltage_limit_v')} = {value:g} {command_unit(servo)}"


def _play(angle: float) -> complex:
    """N where 1 - gap / A = cos(angle), angle within (0, pi)."""
    return complex(1.0 - (angle - math.sin(angle) * math.cos(angle)) / math.pi, -(math.sin(angle) ** 2) / math.pi)


def _angle(phase: float) -> float:
    """The angle at which N has a phase (rad) of its range; the phase falls all the way."""
    from scipy.optimize import brentq

    return float(brentq(lambda angle: _play_phase(angle) - phase, *_ANGLES, xtol=1e-15))


def _mismatch(loop: LinearSystem, omega: float) -> float:
    """log abs(-1 / L) - log abs(N) at the amplitude whose N has the phase of -1 / L; NaN where none has."""
    required = -1.0 / complex(loop.response(omega))
    if not _play_phase(_ANGLES[1]) < cmath.phase(required) < _play_phase(_ANGLES[0]):
        return math.nan
    return math.log(abs(required) / abs(_play(_angle(cmath.phase(required)))))


def _play_phase(angle: float) -> float:
    return cmath.phase(_play(angle))


def _bands(loop: LinearSystem) -> list[tuple[float, float]]:
    """Bands of rad/s in which abs(L) >= 1, Re L < 0 and Im L < 0."""
    omega = search_frequencies(loop)
    edges = [one.omega for one in gain_crossovers(loop)]
    edges += crossings(lambda w: direction(loop.response(w)).real, omega)
    edges += crossings(lambda w: direction(loop.response(w)).imag, omega)
    bounds = np.array([0.0, *sorted(edges)])
    middles = 0.5 * (bounds[:-1] + bounds[1:])
    values = loop.response(middles)
    inside = (np.abs(values) >= 1.0) & (values.real < 0.0) & (values.imag < 0.0)
    return [(float(a), float(b)) for a, b, good in zip(bounds[:-1], bounds[1:], inside, strict=True) if good]


def _prediction(servo: Plant, loop: LinearSystem, gap: float, omega: float) -> Prediction:
    value = complex(loop.response(omega))
    angle = _angle(cmath.phase(-1.0 / value))
    # 1 - cos(angle), without cancellation.
    amplitude = gap / (2.0 * math.sin(0.5 * angle) ** 2)
    position = amplitude * abs(_play(angle) * complex(servo.G2().response(omega)))
    return Prediction(omega / (2.0 * math.pi), amplitude, position, _attracts(loop, omega, angle))


def _attracts(loop: LinearSystem, omega: float, angle: float) -> bool:
    """True when a larger amplitude decays: it moves s = j omega by -(N_A / N) (L / L_s) dA, to the left."""
    sine, cosine = math.sin(angle), math.cos(angle)
    # The angle falls as A grows, hence the sign of the test.
    by_angle = complex(-2.0 * sine**2, -2.0 * sine * cosine) / (math.pi * _play(angle))
    s = 1j * omega
    slope = _relative_slope(loop.numerator, s) - _relative_slope(loop.denominator, s)
    return bool((by_angle / slope).real < 0.0)


def _relative_slope(p: Array, s: complex) -> complex:
    return complex(poly.polyval(s, poly.polyder(p)) / poly.polyval(s, p))


# The motor turns round against the screw's positive flank: the mode and guard at the crest of the motor's angle.
_CREST = ("+/on", "release", 1)


def limit_cycle_near(
    servo: Plant, gap: float, prediction: Prediction, controller: AnyController | None = None
) -> CycleResult:
    """Find the symmetric orbit to which Newton's method converges from a prediction; the loop has no dead zone.

    Parameters
    ----------
    servo : Servo or Axis
    gap : float
        rad, total gap.
    prediction : Prediction
        From `predictions`, of the same loop.
    controller : Controller, Cascade or LinearLaw, optional
        Continuous; the servo's own by default.

    Returns
    -------
    CycleResult
        Status CYCLE or, when the prediction leads to no orbit, IRREGULAR with the reason.
    """
    given = servo.controller if controller is None else controller
    if servo.backlash_kind is BacklashKind.FREE:
        # What follows a contact of a shaft is no harmonic: the run from a larger swing leads to the orbit.
        return limit_cycle(servo, gap, None, controller=given, step=2.0 * prediction.amplitude)
    law = filtered_pid(given)
    # Only the scaling is used: this step is never simulated.
    loop = scaled_loop(servo, gap, None, law, step=gap * servo.p)
    start = crest(servo, loop, prediction, law) / loop.unit
    section = _section(loop, prediction)
    swings = np.abs(phasors(servo, loop, prediction, law)) / loop.unit
    swings[swings == 0.0] = 1.0
    try:
        closed = closed_orbit(loop, section, start, swings, True)
    except (LostOrbit, ZenoError) as error:
        return CycleResult(CycleStatus.IRREGULAR, None, f"Newton's method from the prediction: {error}")
    return CycleResult(CycleStatus.CYCLE, closed.orbit, "")


def crest(servo: Plant, loop: ScaledLoop, prediction: Prediction, law: Controller) -> Array:
    """(n,) predicted state, SI units and zero reference, when the motor's angle is largest."""
    state = phasors(servo, loop, prediction, law).real
    at = loop.loop.automaton.index
    gap = loop.unit * loop.state[at("gap")]
    state[at("gap")], state[at("speed")] = gap, 0.0
    # Not the harmonic but the clamp itself: the screw lies on its flank.
    state[at("theta_d")] = prediction.motor_amplitude - 0.5 * gap
    return np.asarray(state)


def driven_states(servo: Plant, s: complex) -> Complex:
    """(d,) first harmonics of the states of actuator and motor per that of the motor's angle, without a load."""
    shaft = servo.shaft()
    states = np.linalg.solve(s * np.eye(len(shaft.names)) - shaft.A, shaft.B)
    return np.asarray(states / states[-1])


def phasors(servo: Plant, loop: ScaledLoop, prediction: Prediction, law: Controller) -> Complex:
    """(n,) first harmonics of all states, that of the motor's angle real."""
    at, result = loop.loop.automaton.index, np.zeros(len(loop.state), dtype=complex)
    s = 2j * math.pi * prediction.frequency
    gap = loop.unit * loop.state[at("gap")]
    motor = prediction.motor_amplitude
    screw = motor * play_function(motor, gap)
    chain = servo.chain()
    drive = servo.p * (chain.B_position + s * chain.B_velocity)
    masses = np.linalg.solve(s * np.eye(chain.A.shape[0]) - chain.A, drive) * screw
    first = at("theta_d") + 1
    result[first : first + masses.size] = masses
    position = chain.C_last @ masses + servo.p * float(chain.D[-1]) * screw
    result[: at("theta_d")], result[at("theta_d")] = driven_states(servo, s) * motor, screw
    measured = position
    if law.loop_filter_hz is not None:
        measured = result[at("filtered")] = position / (1.0 + s / (2.0 * math.pi * law.loop_filter_hz))
    result[at("integral")] = -law.Ki * measured / s
    result[at("derivative")] = slow = -measured / (law.Tf * s + 1.0)
    if law.notch_hz:
        voltage = -law.Kp * measured + result[at("integral")] - law.Kd / law.Tf * (measured + slow)
        relative = s / (2.0 * math.pi * law.notch_hz)
        result[at("notch low")] = low = voltage / (relative**2 + 2.0 * law.notch_damping * relative + 1.0)
        result[at("notch band")] = relative * low
    return np.asarray(result)


def _section(loop: ScaledLoop, prediction: Prediction) -> Section:
    automaton = loop.loop.automaton
    name, label, side = _CREST
    mode = [candidate.name for candidate in automaton.modes].index(name)
    labels = [(guard.label, guard.side) for guard in automaton.modes[mode].guards]
    event = GuardId(mode, labels.index((label, side)))
    return Section(automaton, event, event, 1, loop.sample_step, 3.0 / prediction.frequency)
