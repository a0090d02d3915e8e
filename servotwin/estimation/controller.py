"""Comparison of a recorded voltage with the voltage that a stated controller would have given.

The law is run over the recorded reference and position. A window does not show the law's state at its beginning: that
part of the voltage is fitted. What is left unexplained says that another controller turned the motor.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from servotwin.control import law
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.law import LawParameters, LawState
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.estimation.first_states import command_from_best_states, least_squares, rms
from servotwin.estimation.linear_controller import (
    at_rate,
    at_ticks,
    command_from_best_start,
    inputs_of,
    noise_in_command,
    other_gains,
)
from servotwin.estimation.window import Window
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import compiled, verbatim

tick = verbatim(law.tick)

_BLOCKS = 250  # means of voltages that are compared: noise, delays and jitter of a few samples average out
_FEWEST_BLOCKS = 100  # of two samples
TOLERATED = 0.1  # share of the voltage's swing: a discretisation or a rate that differs leaves less
_ROUNDING, _NOISE = 4.0, 10.0  # standard deviations of rounding and of noise, as volts, that are tolerated
_NOISES = 2.0  # the same of noise as a linear law shows it in the means, from what it read and from what was recorded
_HARDLY = 0.03  # share of the stated controller's swing: less is no voltage that turns the motor
_LARGEST = 0.5  # share of the voltage's swing: a window whose noise needs more tolerance shows nothing
_FILTERED = 5.0  # time constants of the loop filter after which the measurement before the window is forgotten
_VAST = 1e-20 * math.sqrt(sys.float_info.max)  # V: sums of squares of such integrals are beyond the range of floats
_DELAYS = 4  # samples, from none on, by which the voltage may be recorded later than it was computed


@dataclass(frozen=True)
class ControllerComparison:
    """Comparison of a window's voltage with that of a stated controller.

    Attributes
    ----------
    unexplained : float
        Root mean square of the part of the voltage that the stated controller does not give, V.
    swing : float
        Root mean square of the recorded voltage about its mean, V.
    tolerated : float
        Largest `unexplained` (V) that noise, rounding and discretisation account for.
    factors : dict of str to float
        Gains that explain the voltage, in stated ones; empty where the stated controller does, or where no gains do.
    expected : float
        Root mean square of the stated controller's voltage about its mean, V.
    """

    unexplained: float
    swing: float
    tolerated: float
    factors: dict[str, float]
    expected: float

    @property
    def agrees(self) -> bool:
        """True where the stated controller explains the voltage."""
        return self.unexplained <= self.tolerated

    @property
    def misread(self) -> bool:
        """True where the voltage hardly moves, or moves the other way: then it is not the one that turned the motor."""
        return not self.agrees and (self._still or self.factors.get("Kp", 0.0) < 0.0)

    @property
    def _still(self) -> bool:
        return self.swing < _HARDLY * self.expected

    @property
    def sentence(self) -> str:
        """Sentence for the operator; empty where the controllers agree."""
        if self.agrees:
            return ""
        if self._still:
            return (
                f"the voltage moves by {self.swing:.2g} V rms where the stated controller would move it by "
                f"{self.expected:.2g} V: is its channel dead, or in another unit?"
            )
        share = f"{100.0 * self.unexplained / self.swing:.0f} % of the voltage's swing"
        fitting = ", ".join(f"{name} {factor:.2g}" for name, factor in self.factors.items())
        like = f"; it fits {fitting} times the stated" if fitting else ", and so do other gains"
        return f"the voltage is not that of the stated controller, which leaves {share} unexplained{like}"


class _Terms(NamedTuple):
    """Parts of a law's voltage over a window, each (n,): 0 or 1 where it acts, and those of its gains, V."""

    acting: Array
    gains: dict[str, Array]


def compare_controller(window: Window, controller: AnyController, tolerance: float) -> ControllerComparison | None:
    """Compare the voltage of a window with that of a controller at the window's rate.

    Parameters
    ----------
    window : Window
    controller : Controller, Cascade or LinearLaw
        As stated; it may be continuous.
    tolerance : float
        Half-width of its dead zone, m; 0: none.

    Returns
    -------
    ControllerComparison or None
        None: voltage or reference were not recorded, neither the voltage nor that of the controller moves much beside
        noise and rounding, or the squares of such numbers are beyond the range of floats.
    """
    if window.voltage is None or window.reference is None:
        return None
    if not isinstance(controller, Controller):
        return _compared_linear(window, controller, tolerance)
    parameters = controller.replace(sample_rate=window.sample_rate).law(tolerance)
    if _largest(parameters, window.voltage, window.reference, window.position) > _VAST:
        return None
    steps = np.array([[parameters.release_step], [parameters.filter_step], [parameters.velocity_step]])
    fading, made = (1.0 - steps) ** np.arange(window.voltage.size + 1), None
    for delay in range(_DELAYS):
        voltage, rest = window.voltage[delay:], window.voltage.size - delay
        asked = made is None or not made.factors
        later = _compared(parameters, fading, voltage, window.reference[:rest], window.position[:rest], asked)
        if later is None or later.agrees:
            return later
        made = later if made is None or (later.factors and not made.factors) else made
    return made


def _compared_linear(window: Window, law: Cascade | LinearLaw, tolerance: float) -> ControllerComparison | None:
    """Compare as `compare_controller`, with a law that reads the motor's angle too."""
    window = at_ticks(window, law)
    running, made = at_rate(law, window.sample_rate), None
    inputs = None if running is None else inputs_of(window, running)
    if inputs is None or running is None or window.voltage is None or len(inputs) < 2 * _FEWEST_BLOCKS + _DELAYS:
        return None
    spreads = np.array([0.0, *(_noise(each) + _rounding(each) for each in inputs.T[1:])])
    for delay in range(_DELAYS):
        voltage, rest = window.voltage[delay:], inputs[: len(inputs) - delay]
        swing = _swing(_means(voltage, 0))
        noise = rms(_means(noise_in_command(running, tolerance, rest, spreads), 0))
        tolerated = TOLERATED * swing + _ROUNDING * _rounding(voltage) + _NOISES * noise
        given = command_from_best_start(running, tolerance, voltage, rest)
        expected = _swing(_means(given, 0))
        if tolerated >= _LARGEST * max(swing, expected):
            return None
        unexplained = rms(_means(voltage - given, 0))
        factors: dict[str, float] = {}
        if unexplained > tolerated and (made is None or not made.factors):
            fitting, left = other_gains(law, tolerance, voltage, rest, window.sample_rate)
            factors = fitting if rms(_means(left, 0)) <= tolerated else {}
        later = ControllerComparison(unexplained, swing, tolerated, factors, expected)
        if later.agrees:
            return later
        made = later if made is None or (later.factors and not made.factors) else made
    return made


def _compared(
    parameters: LawParameters, fading: Array, voltage: Array, reference: Array, position: Array, asked: bool
) -> ControllerComparison | None:
    """Compare a voltage with that of a law, sample by sample.

    Parameters
    ----------
    parameters : LawParameters
    fading : (3, n + 1 or more) array
        What is left sample by sample of the offset, of the filtered error and of the filtered reference's speed.
    voltage, reference, position : (n,) arrays
        V, m, m.
    asked : bool
        False: the factors are not computed.
    """
    first = _forgotten(parameters)
    if position.size - first < 2 * _FEWEST_BLOCKS:
        return None
    swing, stiff = _swing(_means(voltage, first)), _stiffness(parameters)
    rounding = _rounding(voltage) + stiff * _rounding(position)
    tolerated = TOLERATED * swing + _ROUNDING * rounding + _NOISE * stiff * _noise(position)
    given = _voltage_from_best_start(parameters, voltage, reference, position)
    expected = _swing(_means(given, first))
    if tolerated >= _LARGEST * max(swing, expected):
        return None
    unexplained = rms(_means(voltage - given, first))
    factors: dict[str, float] = {}
    if asked and not unexplained <= tolerated:
        factors = _factors(parameters, fading, voltage, reference, position, first, tolerated)
    return ControllerComparison(unexplained, swing, tolerated, factors, expected)


def _voltage_from_best_start(parameters: LawParameters, voltage: Array, reference: Array, position: Array) -> Array:
    """Voltage (n,) of the law from the initial state that fits the recorded one best."""
    start = law.start(float(position[0]))._replace(reference=float(reference[0]), voltage=float(voltage[0]))
    states, best, least = _hidden(parameters), np.zeros(0), math.inf
    units = np.array([*states.values()])
    for active in (1.0, 0.0) if parameters.enter < parameters.leave else (1.0,):
        first = start._replace(active=active)

        def run(values: Array, parameters: LawParameters = parameters, first: LawState = first) -> Array:
            moved = {name: getattr(first, name) + float(value) for name, value in zip(states, values, strict=True)}
            return run_law(parameters, first._replace(**moved), reference, position)[0]

        free = partial(run, parameters=parameters._replace(voltage_limit=math.inf, rate_step=math.inf))
        given = command_from_best_states(run, free, units, voltage, parameters.voltage_limit)
        if (error := rms(voltage - given)) < least:
            best, least = given, error
    return best


def _hidden(parameters: LawParameters) -> dict[str, float]:
    """Parts of the law's state that a window does not show, of each what moves the voltage by about 1 V."""
    units = {"offset": 1.0}
    if parameters.integral_step != 0.0:
        units["integral"] = 1.0
    if parameters.derivative_gain != 0.0:
        units["derivative"] = 1.0 / parameters.derivative_gain
    if parameters.velocity_gain != 0.0:
        units["ahead"] = 1.0 / parameters.velocity_gain
    if parameters.friction != 0.0:
        # Which way the reference moved before the window holds until it moves in it.
        units["direction"] = 1.0 / parameters.friction
    if parameters.notch_gain != 0.0:
        units |= {"notch_band": 1.0 / parameters.notch_gain, "notch_low": 1.0 / parameters.notch_gain}
    return units


def _factors(
    parameters: LawParameters,
    fading: Array,
    voltage: Array,
    reference: Array,
    position: Array,
    first: int,
    tolerated: float,
) -> dict[str, float]:
    """Gains in stated ones with which the law without limits explains the voltage; empty: none do."""
    terms = _law_terms(parameters, reference, position)
    stated = {name: term for name, term in terms.gains.items() if np.any(term != 0.0)}
    # What the law's state before the window leaves in it.
    fading = fading[:, : voltage.size]
    initial = [terms.acting, *fading]
    if parameters.notch_gain != 0.0:
        initial = [behind_notch(parameters, terms.acting, 0.0, 0.0), fading[0], fading[2]]
        initial += [behind_notch(parameters, fading[1], 0.0, 0.0), *_notch_columns(parameters, voltage.size).values()]
    if parameters.friction != 0.0:
        initial += [np.where(np.cumsum(reference != reference[0]) == 0, 1.0, 0.0)]
    columns = np.stack([_means(term, first) for term in (*stated.values(), *initial)], axis=1)
    measured = _means(voltage - parameters.feedforward, first)
    values = least_squares(columns, measured)
    if rms(measured - columns @ values) > tolerated:
        return {}
    return {name: float(value) for name, value in zip(stated, values, strict=False)}


def _notch_columns(parameters: LawParameters, count: int) -> dict[str, Array]:
    """Voltages (count,) that unit states of the notch before a window leave in it."""
    nothing = np.zeros(count)
    starts = {"notch_band": (1.0, 0.0), "notch_low": (0.0, 1.0)}
    return {name: behind_notch(parameters, nothing, *start) for name, start in starts.items()}


@compiled
def behind_notch(parameters: LawParameters, values: Array, band: float, low: float) -> Array:
    """Filter voltages (n,) by the notch, from its states before them on."""
    result = np.empty(values.size)
    for k in range(values.size):
        result[k] = values[k] - parameters.notch_gain * band
        behind = values[k] - low
        low += parameters.notch_turn * band + parameters.notch_rise * behind
        band += parameters.notch_turn * behind - parameters.notch_fall * band
    return result


@compiled
def run_law(parameters: LawParameters, start: LawState, reference: Array, position: Array) -> tuple[Array, Array]:
    """Run the law over recorded inputs.

    Parameters
    ----------
    parameters, start : LawParameters, LawState
    reference, position : (n,) ndarray
        m.

    Returns
    -------
    voltage, acting : (n,) ndarray
        V, and 1.0 where proportional and integral action reach the voltage, 0.0 where they do not.
    """
    voltage, acting = np.empty(position.size), np.empty(position.size)
    state = start
    for k in range(position.size):
        state = tick(parameters, state, reference[k], position[k])
        voltage[k] = state.voltage
        acting[k] = max(state.active, parameters.acting_inside)
    return voltage, acting


def _law_terms(parameters: LawParameters, reference: Array, position: Array) -> _Terms:
    """Parts of the voltage without limits: the law is linear in its gains beside its dead zone."""
    start = law.start(float(position[0]))._replace(reference=float(reference[0]))
    stated = {
        "Kp": {"Kp": parameters.Kp},
        "Ki": {"integral_step": parameters.integral_step},
        "Kd": {"derivative_gain": parameters.derivative_gain},
        "velocity feedforward": {"velocity_gain": parameters.velocity_gain},
        "friction feedforward": {"friction": parameters.friction},
    }
    nothing = parameters._replace(
        voltage_limit=math.inf, rate_step=math.inf, tracking_step=0.0, feedforward=0.0,
        Kp=0.0, integral_step=0.0, derivative_gain=0.0, velocity_gain=0.0, friction=0.0,
    )  # fmt: skip
    _, acting = run_law(nothing, start, reference, position)
    runs = {
        name: run_law(nothing._replace(**gain), start, reference, position)[0]
        for name, gain in stated.items()
        if any(gain.values())
    }
    return _Terms(acting, runs)


def _stiffness(parameters: LawParameters) -> float:
    """Voltage per metre at once, V/m."""
    return abs(parameters.Kp) + abs(parameters.derivative_gain)


def _largest(parameters: LawParameters, voltage: Array, reference: Array, position: Array) -> float:
    """Largest size of a voltage recorded or computed at once, V."""
    moved = max(float(np.max(np.abs(position))), float(np.max(np.abs(reference))))
    return max(float(np.max(np.abs(voltage))), _stiffness(parameters) * moved)


def _forgotten(parameters: LawParameters) -> int:
    """Samples after which the loop filter has forgotten its state before the window."""
    if parameters.loop_step >= 1.0:
        return 0
    return math.ceil(_FILTERED / -math.log1p(-parameters.loop_step))


def _means(values: Array, first: int) -> Array:
    """Means over equal blocks from a sample on."""
    length = max(2, (values.size - first) // _BLOCKS)
    count = min(_BLOCKS, (values.size - first) // length)
    return values[first : first + count * length].reshape(count, length).mean(axis=1)


def _swing(means: Array) -> float:
    """Root mean square about the mean."""
    return rms(means - means.mean())


def _rounding(values: Array) -> float:
    """Standard deviation of the rounding of a channel to 16 bits."""
    return float(np.ptp(values)) / 65535.0 / math.sqrt(12.0)


def _noise(values: Array) -> float:
    """Standard deviation of white noise, from second differences, which a slow motion hardly has."""
    return rms(np.diff(values, 2)) / math.sqrt(6.0)
