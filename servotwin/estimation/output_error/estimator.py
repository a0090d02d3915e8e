"""Gap of an axis whose shaft is free in the gap, of a load with friction, or of one mass, by an output-error fit.

The load's motion under the measured motion of the motor is simulated exactly, contacts included, and fitted to the
measured position with the axis's numbers free within what is known of them. docs/estimator-axes.md explains it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.axis_model import has_servo
from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.motor_angle import MotorAngle, noise_of, without_counts, without_noise
from servotwin.estimation.core.upsampling import upsampled
from servotwin.estimation.core.visible import counted
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus, LastContact, no_estimate
from servotwin.estimation.output_error.between_samples import parts_needed
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.flank import OneFlank
from servotwin.estimation.output_error.flank_pair import with_contact
from servotwin.estimation.output_error.held_chain import HeldChainModel, MovingChain, follows, lever
from servotwin.estimation.output_error.learnt_shaft import (
    ShaftReading,
    adapted_shaft,
    beside_what_was_learnt,
    is_learnt,
    shaft_reading,
)
from servotwin.estimation.output_error.models import FRICTION_PARTS, MotionModel, Priors, ShaftModel
from servotwin.estimation.output_error.offset import with_offset
from servotwin.estimation.output_error.one_way import moves_one_way
from servotwin.estimation.output_error.play_model import PlayModel
from servotwin.estimation.output_error.possible import PossibleHalf, possible_half
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.output_error.sampling import too_slow
from servotwin.estimation.output_error.search import search
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.output_error.taught import taught
from servotwin.estimation.output_error.unexplained import slow_error
from servotwin.estimation.output_error.verdict import JudgedFit, bounded_by_both, judge
from servotwin.estimation.paper.zero_phase import ZeroPhase
from servotwin.estimation.whitened.channels import corrected, faults, other_units, refused
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.actuator import Stepper
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.basis import BacklashKind
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

__all__ = ["METHOD", "FittedWindow", "OutputErrorSettings", "estimate", "fit", "fitted", "shortest_window"]

METHOD = "output_error"
SHORTEST = 400  # samples
_LATE = 0.1  # rad of the shaft's own frequency: usual delay between the channels
_SAMPLES_LATE = 3.0
_GAPS = np.linspace(0.0, 0.3, 16)  # of the motor's travel; with wider ones a gap looks like another ratio
_COASTS = 0.1  # of the position's motion: what play leaves of a load that coasts in the gap, and no wrong ratio does
_UNSURE = 3.0  # standard deviations of the motor's angle by which it may be beside what its encoder shows
_CUT = 8.0  # times the shaft's own frequency: cut-off of the low-pass on a motor's encoder that shows its counts


def shortest_window(_settings: OutputErrorSettings, _axis: object, sample_rate: float) -> tuple[float, str]:
    """Shortest window (s) at a sample rate (Hz), and the reason in words."""
    return SHORTEST / sample_rate, f"method {METHOD!r}, which needs {SHORTEST} samples"


def estimate(
    window: Window,
    axis: Axis | Servo,
    prior: float | GapEstimate | None,
    settings: OutputErrorSettings | None,
    machine: FactorPrior | None = None,
    before: LastContact | None = None,
) -> GapEstimate:
    """Estimate the total gap (rad at the motor) from a window with theta_m and position.

    Parameters
    ----------
    window : Window
    axis : Axis
        With a shaft that is free in the gap, or whose load has friction, hangs on nothing but an elastic screw, or is
        one mass.
    prior : float or GapEstimate, optional
        Total gap, rad: one of the starts.
    settings : OutputErrorSettings, optional
    machine : FactorPrior, optional
        What is known of the machine, in place of the settings' spreads; the estimate then has a reading. Of a rigid
        transmission its pitch counts alone, which is the ratio.
    before : LastContact, optional
        Of the last window that showed one flank of a free shaft.

    Raises
    ------
    InvalidInput
        Another kind of axis, no theta_m, a window too short.
    """
    made = fitted(window, axis, prior, settings or OutputErrorSettings(), machine)
    if made.search is None or made.one_flank is None:
        return made.estimate
    here = OneFlank.of(made.search, made.one_flank)
    return made.estimate if here is None else with_contact(made.estimate, here, before, window)


@dataclass(frozen=True, eq=False)
class FittedWindow:
    """A window's estimate with the fit behind it.

    Attributes
    ----------
    estimate : GapEstimate
    search : Search, optional
        None: the window was refused before any fit.
    possible : PossibleHalf, optional
        What the window leaves possible of a motion without dynamics.
    one_flank : OutputErrorSettings, optional
        Settings of the fit, with what is known of the machine, where one flank explains the window nearly as well as
        two; otherwise None.
    """

    estimate: GapEstimate
    search: Search | None = None
    possible: PossibleHalf | None = None
    one_flank: OutputErrorSettings | None = None


def fitted(
    window: Window,
    axis: Axis | Servo,
    prior: float | GapEstimate | None,
    settings: OutputErrorSettings,
    machine: FactorPrior | None = None,
) -> FittedWindow:
    """Estimate as `estimate` does, and keep the fit; raises InvalidInput as it does."""
    theta_m = _checked(window, axis)
    assert isinstance(axis, Axis)
    axis, settings = _known(axis, settings, machine)
    blank = no_estimate(window.mid_time, model_version=axis.version, method=METHOD)
    if slow := too_slow(axis, window.sample_rate):
        return FittedWindow(replace(blank, reasons=(slow,)))
    if broken := _broken(window, axis):
        return FittedWindow(refused(blank, broken))
    if window.follows_motor(axis.p):
        words = "position is the motor's angle times the ratio, exactly: there is no gap, or it is not the load's own"
        return FittedWindow(replace(blank, reasons=(words,)))
    found, noise = _fit(window, theta_m, axis, prior, settings, machine)
    freed = _freed(found, window, theta_m, axis, settings, machine)
    found, other = beside_what_was_learnt(found, freed)
    unit, possible = 2.0 / lever(axis), possible_half(found)
    verdict = judge(found, settings, unit, possible, axis.p * noise)
    if freed is not None and verdict.status is GapStatus.LOWER_BOUND:
        verdict = bounded_by_both(verdict, judge(freed, settings, unit, None, axis.p * noise))
    if verdict.status is not GapStatus.OK and (wrong := _wrong_channel(window, theta_m, axis)):
        verdict = JudgedFit(GapStatus.MODEL_MISMATCH, reasons=(*wrong, *verdict.reasons))
    if verdict.status is not GapStatus.MODEL_MISMATCH and other:
        verdict = JudgedFit(GapStatus.MODEL_MISMATCH, reasons=other)
    if verdict.status is GapStatus.OK and (alike := moves_one_way(axis, window.position)):
        verdict = JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(alike,))
    stated = with_offset(_stated(blank, found, verdict, unit), found, unit)
    told = _with_machine(stated, found, possible, settings, machine)
    return FittedWindow(told, found, possible, settings if verdict.one_flank else None)


def _with_machine(
    stated: GapEstimate,
    found: Search,
    possible: PossibleHalf | None,
    settings: OutputErrorSettings,
    machine: FactorPrior | None,
) -> GapEstimate:
    """The estimate with what the window tells of the machine."""
    if machine is None or not stated.ok:
        return stated
    if possible is None:
        reading = shaft_reading(found, machine, settings.calibration, settings.gap_rate)
        return _with_shaft(stated, reading, is_learnt(machine, settings))
    # A spread that is small beside the motor's travel only is too large to tell a ratio.
    if stated.std > settings.largest_share * stated.gap:
        return stated
    return replace(stated, machine=taught(machine, found, possible, settings.calibration))


def _freed(
    found: Search,
    window: Window,
    theta_m: Array,
    axis: Axis,
    settings: OutputErrorSettings,
    machine: FactorPrior | None,
) -> Search | None:
    """The fit with the usual freedom, where the one near what was learnt leaves slow motion; otherwise None."""
    if machine is None or slow_error(found) == 0.0 or not is_learnt(machine, settings):
        return None
    return _fit(window, theta_m, axis, None, settings, None)[0]


def _broken(window: Window, axis: Axis) -> tuple[str, ...]:
    """Faults of the channels; a load that is the screw stops as abruptly as they do: only dead and slow ones count."""
    found = faults(window, axis.load.motion)
    if follows(axis):
        dead = tuple(sentence for sentence in found if "constant" in sentence)
        # The counter of a stepper's steps changes with its command.
        counts = isinstance(axis.actuator, Stepper)
        found = dead or (() if counts else upsampled(window.channels["theta_m"], window.sample_rate))
    return found or other_units(window, axis.encoder_resolution, axis.sensors.position_resolution)


def _wrong_channel(window: Window, theta_m: Array, axis: Axis) -> tuple[str, ...]:
    """Sentence for channels that would be one motion, with any gap, in another unit or with another sign or ratio."""

    def left(angle: Array, position: Array, _rate: float = 0.0) -> float:
        tried = [(gap, place) for gap in np.ptp(angle) * _GAPS for place in (-0.5, 0.5)]
        errors = (position - axis.p * play(angle, gap, angle[0] + place * gap) for gap, place in tried)
        return min(float(np.std(error)) for error in errors) / float(np.std(position))

    return corrected(window, theta_m, left, left(theta_m, window.position), axis.load.motion, _COASTS)


def fit(
    window: Window,
    axis: Axis,
    prior: float | GapEstimate | None,
    settings: OutputErrorSettings,
    machine: FactorPrior | None = None,
) -> Search:
    """Fit a window as `estimate` does; raises InvalidInput as it does."""
    theta_m = _checked(window, axis)
    axis, settings = _known(axis, settings, machine)
    return _fit(window, theta_m, axis, prior, settings, machine)[0]


def problem_of(window: Window, axis: Axis, machine: FactorPrior | None) -> tuple[Problem, Axis]:
    """The window with its model, and the axis with what is known of it; raises InvalidInput as `estimate` does."""
    theta_m = _checked(window, axis)
    axis, settings = _known(axis, OutputErrorSettings(), machine)
    return _prepared(window, theta_m, axis, settings, machine)[0], axis


def _known(axis: Axis, settings: OutputErrorSettings, machine: FactorPrior | None) -> tuple[Axis, OutputErrorSettings]:
    """The axis with the numbers that are known of it, and the settings with the spread of a rigid one's ratio."""
    if machine is None:
        return axis, settings
    if axis.backlash_kind is BacklashKind.FREE:
        return adapted_shaft(axis, machine.mean), settings
    mean, std = machine.pitch
    return axis.scaled({"p": math.exp(mean)}), replace(settings, ratio=std)


def _with_shaft(stated: GapEstimate, reading: ShaftReading, learnt: bool) -> GapEstimate:
    """The estimate with the machine's numbers; refused where they contradict what was learnt of them.

    Before anything was learnt a damping may be off by any factor (`judge`).
    """
    if learnt and reading.contradicts:
        refused = no_estimate(stated.time, (reading.sentence,), stated.model_version, stated.method)
        return replace(refused, status=GapStatus.MODEL_MISMATCH, rms=stated.rms, evaluations=stated.evaluations)
    return replace(stated, machine=reading.machine)


def _fit(
    window: Window,
    theta_m: Array,
    axis: Axis,
    prior: float | GapEstimate | None,
    settings: OutputErrorSettings,
    machine: FactorPrior | None,
) -> tuple[Search, float]:
    """The fit of a window, and the noise (rad) of the motor's angle (n,) that was smoothed for it."""
    expected = prior.gap if isinstance(prior, GapEstimate) else prior
    problem, noise = _prepared(window, theta_m, axis, settings, machine)
    return search(problem, 0.5 * lever(axis) * (expected or 0.0)), noise


def _prepared(
    window: Window, theta_m: Array, axis: Axis, settings: OutputErrorSettings, machine: FactorPrior | None
) -> tuple[Problem, float]:
    """The window with its model, and the noise (rad) of the motor's angle (n,) that was smoothed for it."""
    motor = _seen_by_load(theta_m, _count_of_motor(axis, theta_m)) if follows(axis) else MotorAngle(theta_m, 0.0)
    learnt = None if machine is None else machine.covariance
    return _problem(window, motor.angle, axis, settings, learnt), motor.noise


def _seen_by_load(theta_m: Array, count: float) -> MotorAngle:
    """Angle (N,) of a motor without noise and counts (rad) of its encoder."""
    quiet = without_noise(theta_m, count)
    return quiet if quiet.angle is not theta_m else quiet._replace(angle=without_counts(theta_m, count))


def _checked(window: Window, axis: Axis | Servo) -> Array:
    """The motor's angle of a window that can be fitted."""
    if isinstance(axis, Servo) or has_servo(axis):
        raise InvalidInput(
            f"method {METHOD!r} is for a shaft that is free in the gap, a load with friction, or one mass: "
            'give method = "whitened"'
        )
    if window.theta_m is None:
        raise InvalidInput(f"{window.where}the window has no theta_m: method {METHOD!r} needs the motor's angle in rad")
    if window.position.size < SHORTEST:
        size = window.position.size
        raise InvalidInput(f"{window.where}the window has {size} samples: method {METHOD!r} needs at least {SHORTEST}")
    return window.theta_m


def _count_of_motor(axis: Axis, theta_m: Array) -> float:
    """Rad."""
    return max(axis.encoder_resolution, counted(theta_m))


def _problem(
    window: Window, theta_m: Array, axis: Axis, settings: OutputErrorSettings, learnt: Array | None = None
) -> Problem:
    """The window with its model; `learnt` (4, 4) is the covariance of what is known of a free shaft."""
    interval = 1.0 / window.sample_rate
    measured = theta_m if window.theta_m is None else window.theta_m
    at_motor = _count_of_motor(axis, measured)
    at_load = max(axis.sensors.position_resolution, counted(window.position))
    own, late = _own_rate(axis), _SAMPLES_LATE * interval
    if own > 0.0:
        late = max(late, _LATE / own)
        if at_motor > 0.0:
            theta_m = _smooth(theta_m, at_motor, _CUT * own / (2.0 * math.pi), window.sample_rate)
    priors = Priors(settings.stiffness, settings.damping, settings.mass_ratio, settings.ratio, settings.delay or late)
    model, travel = _model(axis, priors, learnt), lever(axis)
    count, drive, position = math.hypot(travel * at_motor, at_load), travel * theta_m, window.position
    if model.speed == 0.0:
        return Problem(model, drive, position, interval, count)
    lines = FRICTION_PARTS if axis.load.friction > 0.0 else 1
    if isinstance(model, HeldChainModel):
        drive, position, interval = _averaged(model, drive, position, interval, count)
    return Problem(model, drive, position, interval, count, parts_needed(drive, position, count, lines))


def _averaged(
    model: HeldChainModel, drive: Array, position: Array, interval: float, count: float
) -> tuple[Array, Array, float]:
    """Drive and position (n,) at an interval (s) that shows the chain, and no motor that starts within few samples
    where the ones given (N,) do not."""
    factor = model.decimation(interval, drive.size // SHORTEST)
    while True:
        reduce = decimation(factor)
        fewer, seen = reduce.rows(np.vstack([drive, position]))
        if factor == 1 or parts_needed(fewer, seen, count, 1) == 1:
            return fewer, seen, interval * reduce.factor
        factor //= 2


def _own_rate(axis: Axis) -> float:
    """Frequency (rad/s) of the shaft, or of the chain's slowest mode; 0 where the load has no motion of its own."""
    if axis.backlash_kind is BacklashKind.FREE:
        return math.sqrt(axis.transmission.k_d / axis.load.m[0])
    return 0.0 if follows(axis) else float(MovingChain.of(axis).frequencies().min())


def _model(axis: Axis, priors: Priors, learnt: Array | None) -> MotionModel:
    """The model of an axis's load."""
    if axis.backlash_kind is BacklashKind.FREE:
        return ShaftModel(axis, priors, learnt)
    return PlayModel(axis, priors) if follows(axis) else HeldChainModel(axis, priors)


def _smooth(theta_m: Array, count: float, cutoff: float, rate: float) -> Array:
    """(N,) angle without its counts (rad); as it is where the cut-off (Hz) is too high for the sample rate (Hz).

    It stays within what the encoder showed: a motor may start and stop more sharply than its load, and where it crosses
    the gap the load would see what the low-pass took away.
    """
    if cutoff >= 0.4 * rate:
        return theta_m
    smooth = ZeroPhase(cutoff, 3, rate, "odd", min(round(rate / cutoff), theta_m.size - 1)).respond(theta_m)
    unsure = max(0.5 * count, _UNSURE * noise_of(theta_m))
    return np.clip(smooth, theta_m - unsure, theta_m + unsure)


def _stated(blank: GapEstimate, found: Search, verdict: JudgedFit, unit: float) -> GapEstimate:
    """Fill a blank estimate."""
    rms = float(np.sqrt(np.mean(found.best.raw**2)))
    made = replace(
        blank,
        status=verdict.status,
        reasons=verdict.reasons,
        rms=rms,
        evaluations=found.best.evaluations,
        ratio=verdict.ratio,
    )
    gap, total = unit * verdict.half, unit * verdict.std_total
    if verdict.status is GapStatus.LOWER_BOUND:
        return replace(made, gap=gap, interval=(gap, math.inf))
    if verdict.status is not GapStatus.OK:
        return made
    interval = max(0.0, gap - NORMAL_95 * total), gap + NORMAL_95 * total
    return replace(made, gap=gap, std=unit * verdict.std, std_total=total, interval=interval)
