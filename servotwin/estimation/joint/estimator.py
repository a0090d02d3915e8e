"""The gap together with the model's own numbers, for a machine that is not quite what its description says.

Of the structure only k/m, c/m and the pitch show in its motion, of the motor, when its angle is not measured, only k_B
(docs/motor-identifiability.md). A delay between the channels is always estimated too. Several windows of one machine
share its numbers; gap, delay and initial states are each window's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from servotwin.errors import InvalidInput
from servotwin.estimation.axis_model import has_servo, servo_of
from servotwin.estimation.commanded_angle import has_commanded_angle
from servotwin.estimation.core.decimation import shortest_for
from servotwin.estimation.core.family import InputHold
from servotwin.estimation.joint.axis import WIDE, estimate_axis
from servotwin.estimation.joint.fit import (
    APART,
    RIVAL,
    AnyPrior,
    FitPoint,
    ParameterPrior,
    WindowMinima,
    decimation_factor,
    descend,
    gap_of,
    searched,
    spread_by_rounding,
    tolerance_of,
    unsearched,
)
from servotwin.estimation.joint.held_axis import check_channels, in_counts, of_servos_axis
from servotwin.estimation.joint.model import JUMP, MOTOR_START, JointModel, between_its_counts, jumps, margin_for
from servotwin.estimation.joint.settings import SPREADS, JointSettings
from servotwin.estimation.joint.verdict import (
    JointEstimate,
    JointFit,
    at_bound,
    estimate_of,
    mismatched,
    window_estimate,
)
from servotwin.estimation.late_window import on_time, prompt_window
from servotwin.estimation.learning.trend import Prior
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.whitened.channels import faults, motor_angle
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.estimation.window import MINIMUM_SAMPLES, Window
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

__all__ = ["JointEstimate", "JointSettings", "SharedFit", "estimate_jointly"]

Settings = TypeVar("Settings", JointSettings, OutputErrorSettings)
_SHARED = ("k/m", "c/m", "pitch", "k_d", "k_B")


@dataclass(frozen=True, eq=False)
class SharedFit:
    """The windows as one problem, whose point has the shared parameters first and then each window's own.

    Attributes
    ----------
    fits : tuple of WindowMinima
        All with the same shared parameters.
    places : tuple of (P,) arrays of int
        Where each window's parameters are in the whole point.
    """

    fits: tuple[WindowMinima, ...]
    places: tuple[NDArray[np.intp], ...]

    @classmethod
    def of(cls, fits: Sequence[WindowMinima]) -> SharedFit:
        """Lay out the parameters of all windows."""
        names = fits[0].model.names
        shared = {name: i for i, name in enumerate(name for name in names if name in _SHARED)}
        places, end = [], len(shared)
        for fit in fits:
            own = [name for name in fit.model.names if name not in shared]
            where = {**shared, **{name: end + i for i, name in enumerate(own)}}
            places.append(np.array([where[name] for name in fit.model.names], dtype=np.intp))
            end += len(own)
        return cls(tuple(fits), tuple(places))

    @property
    def size(self) -> int:
        """Parameters in all."""
        return 1 + max(int(place.max()) for place in self.places)

    def joined(self, parts: Sequence[Array]) -> Array:
        """(size,) of one (P,) for each window; where they share, the first's counts."""
        whole = np.empty(self.size)
        for place, part in reversed(list(zip(self.places, parts, strict=True))):
            whole[place] = part
        return whole

    def known(self) -> ParameterPrior:
        """Bounds and priors of the whole."""
        each = [fit.known for fit in self.fits]
        columns = ([getattr(one, name) for one in each] for name in ("lowest", "highest", "mean", "spread"))
        return ParameterPrior(*(self.joined(column) for column in columns))

    def evaluate(self, point: Array) -> FitPoint:
        """Residuals and derivatives of all windows; what is known of the shared parameters counts once."""
        known, residuals, blocks = self.known(), [], []
        for fit, place in zip(self.fits, self.places, strict=True):
            count = len(place)
            evaluation = fit.evaluated(fit.known.without_prior(np.ones(count, dtype=bool)))(point[place])
            block = np.zeros((self.size, evaluation.residual.size - count))
            block[place] = evaluation.jacobian[:, :-count]
            residuals.append(evaluation.residual[:-count])
            blocks.append(block)
        prior, slope = (point - known.mean) / known.spread, np.diag(1.0 / known.spread)
        return FitPoint(point, np.concatenate([*residuals, prior]), np.hstack([*blocks, slope]))

    def shaken(self, random: np.random.Generator) -> SharedFit:
        """The windows with other errors of rounding."""
        return replace(self, fits=tuple(fit.shaken(random) for fit in self.fits))

    def solved(self) -> tuple[FitPoint, tuple[tuple[float, ...], ...]]:
        """Find the best minimum, and for each window the other gaps (rad) that explain all windows nearly as well."""
        tolerance = self.joined([tolerance_of(fit.model) for fit in self.fits])
        starts = [self._start([fit.best for fit in self.fits])]
        for index, fit in enumerate(self.fits):
            others = [one.best for one in self.fits]
            starts += [self._start([*others[:index], rival, *others[index + 1 :]]) for rival in fit.minima[1:]]
        minima = [descend(self.evaluate, start, self.known(), tolerance) for start in starts]
        best = min(minima, key=lambda one: one.cost)
        near = [one for one in minima if one.cost < best.cost + RIVAL]
        gaps = [place[0] for place in self.places]
        rivals = tuple(tuple(float(one.point[i]) for one in near if _apart(one.point[i], best.point[i])) for i in gaps)
        return replace(best, evaluations=sum(one.evaluations for one in minima)), rivals

    def _start(self, minima: Sequence[FitPoint]) -> Array:
        """Start at each window's own minimum, with the shared parameters of the window whose gap is known best."""
        leader = min(range(len(minima)), key=lambda i: float(minima[i].deviations()[0]))
        whole = self.joined([one.point for one in minima])
        whole[self.places[leader]] = minima[leader].point
        return whole


def _apart(gap: float, other: float) -> bool:
    return abs(gap - other) > APART


_WITH_ANGLE, _FROM_VOLTAGE = ("k/m", "c/m", "pitch"), ("k/m", "c/m", "k_B")
SHORTEST = 200  # samples beside the margins, as before the decimation; after it a window has MINIMUM_SAMPLES at least
_SIGMAS = 4.0  # by how many standard deviations a gap may move when its window is fitted with others


def estimate_jointly(
    window: Window | Sequence[Window],
    servo: Plant,
    free: tuple[str, ...] | None = None,
    prior: AnyPrior = None,
    settings: JointSettings | OutputErrorSettings | None = None,
) -> JointEstimate:
    """Estimate the total gap with the model's numbers, from windows with or without the motor's angle.

    Parameters
    ----------
    window : Window, or several
        Position and theta_m, or position and voltage: the angle is then computed from the voltage. Several windows are
        fitted together: each has its own gap and delay, k/m, c/m, pitch, k_d and k_B are the same in all.
    servo : Servo or Axis
        The model to start from.
    free : tuple of str, optional
        Of "k/m", "c/m", "pitch", "k_d", "k_B", "gap rate". By default k/m, c/m and the pitch, and k_d of an elastic
        screw; without the motor's angle k_B in place of the pitch, because the position shows only their ratio. An axis
        whose gap `estimate_gap` finds by "output_error" has all of its numbers free.
    prior : number, GapEstimate or Prior, optional
        A gap (rad) to search from as well; a `Prior`'s spread counts as information, on the first window of a servo.
    settings : JointSettings or OutputErrorSettings, optional
        The latter of such an axis, by default `servotwin.estimation.joint.axis.WIDE`.

    Raises
    ------
    InvalidInput
        Unknown, inseparable or unseen parameters; neither angle nor voltage; a window too short; an elastic screw
        without the motor's angle; no window at all, or some with theta_m and some without; settings of another fit; an
        axis whose angle cannot be computed from the command; several windows of a load with friction that the gap
        holds.
    """
    # A DC motor's angle is then part of the fit.
    ready = prompt_window if servo.sensors.motor_encoder or has_commanded_angle(servo) else on_time
    windows = tuple(ready(each, servo) for each in _windows(window))
    if isinstance(servo, Axis):
        return _of_axis(windows, servo, free, prior, settings)
    return _of_servo(windows, servo, free, prior, _checked_settings(settings, JointSettings) or JointSettings())


def _of_axis(
    windows: Sequence[Window],
    axis: Axis,
    free: tuple[str, ...] | None,
    prior: AnyPrior,
    settings: JointSettings | OutputErrorSettings | None,
) -> JointEstimate:
    """Fit an axis as the servo that stands for it, or by its output error."""
    for window in windows:
        check_channels(window, axis)
    if not has_servo(axis):
        if free is not None:
            raise InvalidInput(f"free = {free!r}: the fit of this axis has all of its numbers free; leave it out")
        wide = _checked_settings(settings, OutputErrorSettings) or WIDE
        return estimate_axis(windows, axis, gap_of(prior), wide)
    chosen = _checked_settings(settings, JointSettings) or in_counts(windows, axis)
    hold = InputHold.LINEAR if axis.controller.sample_rate is None else InputHold.CONSTANT
    driven = [window.driven(axis.command_limit) for window in windows]
    found = _of_servo(driven, servo_of(axis), free, prior, replace(chosen, hold=chosen.hold or hold))
    return of_servos_axis(found, axis, windows[0].sample_rate)


def _checked_settings(settings: JointSettings | OutputErrorSettings | None, kind: type[Settings]) -> Settings | None:
    """The settings, of the kind that the fit takes."""
    if settings is None or isinstance(settings, kind):
        return settings
    raise InvalidInput(f"settings {settings!r} do not belong to the fit of this machine: give {kind.__name__}")


def _of_servo(
    windows: Sequence[Window], servo: Servo, free: tuple[str, ...] | None, prior: AnyPrior, settings: JointSettings
) -> JointEstimate:
    """Fit a servo."""
    given = settings.on(scales(servo).time)
    names = _free(windows[0], servo, free)
    fits = [_fit(one, servo, names, prior if one is windows[0] else _start_of(prior), given) for one in windows]
    results = [_alone(fit) for fit in fits]
    counted = [
        i for i, one in enumerate(results) if not (fits[i].blocked or mismatched(one, given) or at_bound(one, given))
    ]
    if len(counted) > 1:
        joined = _joined([fits[i] for i in counted], [results[i] for i in counted], given)
        results = [dict(zip(counted, joined, strict=True)).get(i, one) for i, one in enumerate(results)]
    leading = results[counted[-1] if counted else -1]
    return estimate_of(tuple(window_estimate(one, given) for one in results), leading, given)


def _windows(given: Window | Sequence[Window]) -> tuple[Window, ...]:
    """List the windows: at least one, and all with the same channels."""
    windows = (given,) if isinstance(given, Window) else tuple(given)
    if not windows:
        raise InvalidInput("there is no window: the joint estimator needs at least one")
    if len({one.theta_m is None for one in windows}) > 1:
        raise InvalidInput("some windows have theta_m (rad) and some have not: fitted together they must be alike")
    return windows


def _start_of(prior: AnyPrior) -> AnyPrior:
    """Reduce a prior, for windows that it was not made for, to a gap to search from."""
    return prior.gap if isinstance(prior, Prior) else prior


def _free(window: Window, servo: Servo, free: tuple[str, ...] | None) -> tuple[str, ...]:
    """Names of the free parameters, checked."""
    measured = window.theta_m is not None
    usual = _WITH_ANGLE if measured else _FROM_VOLTAGE
    names = (usual if servo.rigid else (*usual, "k_d")) if free is None else tuple(free)
    for name in names:
        if name not in SPREADS:
            raise InvalidInput(f"free parameter {name!r} does not exist: allowed are {', '.join(SPREADS)}")
    if measured and "k_B" in names:
        raise InvalidInput(
            "k_B cannot be free where theta_m is measured: the position depends on it through theta_m only"
        )
    if servo.rigid and "k_d" in names:
        raise InvalidInput("k_d cannot be free: the servo's screw is rigid (k_d = inf); give it a finite stiffness")
    if not measured and {"k_B", "pitch"} <= set(names):
        raise InvalidInput("k_B and pitch cannot both be free without theta_m: the position shows p/k_B only")
    return tuple(dict.fromkeys(names))


def _model(window: Window, servo: Servo, free: tuple[str, ...], settings: JointSettings) -> JointModel:
    if window.theta_m is None and window.voltage is None:
        raise InvalidInput(f"{window.where}the window has neither theta_m (rad) nor voltage (V): one of them is needed")
    if window.theta_m is None and not servo.rigid:
        raise InvalidInput(
            f"{window.where}the window has no theta_m, and servo k_d = {servo.k_d} N/m: from the voltage the joint "
            "estimator needs a rigid screw (k_d = inf), whose load does not act back on the motor"
        )
    delay = ("delay",) if settings.delay_limit > 0.0 else ()
    motor = MOTOR_START if window.theta_m is None else ()
    margin, factor = margin_for(settings.delay_limit, window.sample_rate), decimation_factor(servo, window.sample_rate)
    fewest = max(SHORTEST, shortest_for(factor, MINIMUM_SAMPLES)) + 2 * margin
    if window.position.size < fewest:
        raise InvalidInput(
            f"{window.where}the window has {window.position.size} samples: the joint estimator needs at least {fewest} "
            f"at {window.sample_rate:.6g} Hz"
        )
    hold = settings.hold or (InputHold.LINEAR if servo.controller.sample_rate is None else InputHold.CONSTANT)
    unsure = jumps(window.voltage) if motor and hold is InputHold.LINEAR and window.voltage is not None else ()
    names = ("gap", "place", *delay, *free, *motor, *(f"{JUMP}{index}" for index in unsure))
    return JointModel(window, servo, names, hold, margin, unsure)


def _faults(window: Window) -> tuple[str, ...]:
    """List the faults of the channels that are used."""
    angle = window.position if window.theta_m is None else window.theta_m
    sentences = faults(Window(window.position, angle, sample_rate=window.sample_rate))
    return tuple(one for one in sentences if window.theta_m is not None or not one.startswith("theta_m"))


def _still(window: Window) -> bool:
    """Tell whether there is no angle and the voltage is constant."""
    return window.theta_m is None and window.voltage is not None and float(np.ptp(window.voltage)) == 0.0


def _fit(
    window: Window, servo: Servo, names: tuple[str, ...], prior: AnyPrior, settings: JointSettings
) -> WindowMinima:
    """Fit one window by itself; it is not searched when its channels are useless."""
    model = _model(window, servo, names, settings)
    broken = "; ".join(_faults(window))
    if window.theta_m is not None and not broken:
        if servo.encoder_resolution > 0.0:
            model = between_its_counts(model)
        angle = motor_angle(model.window, servo.encoder_resolution, WhitenedSettings(), scales(servo).time)
        model = replace(model, window=model.window.replace(theta_m=angle))
    silence = "the voltage is constant: nothing shows how the motor moved" if _still(window) else ""
    if broken or silence:
        return unsearched(model, prior, settings, blocked=broken or silence)
    return searched(model, prior, settings)


def _alone(fit: WindowMinima) -> JointFit:
    """Take the best minimum of one window, with an objection where others explain the window nearly as well."""
    best = fit.best
    rivals = tuple(float(one.point[0]) for one in fit.minima[1:] if one.cost < best.cost + RIVAL)
    objection = fit.blocked or _doubt(best.converged, float(best.point[0]), rivals)
    rounding = spread_by_rounding(
        fit.model.servo, best, lambda random: fit.shaken(random).evaluated(fit.known)(best.point)
    )
    covariance = best.covariance() + rounding
    return JointFit(fit.model, best.point, covariance, fit.evaluations, objection)


def _joined(fits: Sequence[WindowMinima], alone: Sequence[JointFit], settings: JointSettings) -> list[JointFit]:
    """Fit the windows together; one whose gap moves by more than its spread contradicts the others."""
    whole = SharedFit.of(fits)
    best, rivals = whole.solved()
    servo = fits[0].model.servo
    rounding = spread_by_rounding(servo, best, lambda random: whole.shaken(random).evaluate(best.point))
    # Rounding repeats with the motion: windows alike may err alike, so that they tell no more than one of them.
    covariance, results = best.covariance() + len(fits) * rounding, []
    for before, place, others in zip(alone, whole.places, rivals, strict=True):
        point = best.point[place]
        objection = _doubt(best.converged, float(point[0]), others)
        one = JointFit(before.model, point, covariance[np.ix_(place, place)], best.evaluations, objection)
        results.append(replace(one, contradiction=_contradiction(before, one, settings)))
    return results


def _contradiction(before: JointFit, after: JointFit, settings: JointSettings) -> str:
    """Reason for which a window cannot be of the same machine as the others; empty when it can."""
    moved, spread = after.point[0] - before.point[0], math.hypot(before.std(settings), settings.model_error_rad)
    if before.objection or not abs(moved) > _SIGMAS * spread:
        return ""
    return f"fitted with the other windows the gap moves by {math.degrees(moved):.3g} deg: the machine is not the same"


def _doubt(converged: bool, gap: float, rivals: tuple[float, ...]) -> str:
    """Reason why a minimum may not be the right one; empty when there is none."""
    if not converged:
        return "the search did not converge"
    gaps = ", ".join(f"{math.degrees(one):.3g} deg" for one in (gap, *rivals))
    return f"several gaps explain the window: {gaps}" if rivals else ""
