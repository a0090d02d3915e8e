"""The gap together with the model's own numbers, for a machine that is not quite what its description says.

Of the structure only k/m, c/m and the pitch show in its motion, of the motor, when its angle is not measured, only k_B
(docs/motor-identifiability.md). A delay between the channels is always estimated too.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.identify.core.decimation import Decimation, decimation
from servotwin.identify.core.family import Hold
from servotwin.identify.core.whitening import Autoregression
from servotwin.identify.estimate import GapEstimate
from servotwin.identify.joint.model import JUMP, MOTOR_START, JointModel, jumps, margin_for
from servotwin.identify.joint.noise import noise_left
from servotwin.identify.joint.search import Known, Stand, descend, scan, stand
from servotwin.identify.joint.settings import SPREADS, JointSettings
from servotwin.identify.joint.verdict import JointEstimate, Parameter, stated
from servotwin.identify.trend import Prior
from servotwin.identify.whitened.channels import faults, motor_angle
from servotwin.identify.whitened.settings import Settings as Whitened
from servotwin.identify.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

WITH_ANGLE, FROM_VOLTAGE = ("k/m", "c/m", "pitch"), ("k/m", "c/m", "k_B")
_GRID = np.radians([0.0, 1.0, 2.0, 4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0, 50.0])
_STARTS, _APART, _RIVAL = 3, math.radians(0.3), 12.0  # minima closer than this are one; a rival's cost is as near
_SAMPLES_HZ = 250.0  # what is kept: with fewer the noise model fits itself to the residual, spreads come out small


__all__ = ["JointEstimate", "JointSettings", "Parameter", "Prior", "estimate_jointly"]


def estimate_jointly(
    window: Window,
    servo: Servo,
    free: tuple[str, ...] | None = None,
    prior: float | GapEstimate | Prior | None = None,
    settings: JointSettings | None = None,
) -> JointEstimate:
    """The total gap with the model's numbers, from a window with or without the motor's angle.

    Parameters
    ----------
    window : Window
        Position and theta_m, or position and voltage: the angle is then computed from the voltage.
    servo : Servo
        The model to start from.
    free : tuple of str, optional
        Of "k/m", "c/m", "pitch", "k_B", "gap rate". By default k/m, c/m and the pitch; without the motor's angle k_B in
        place of the pitch, which it cannot be told from.
    prior : number, GapEstimate or Prior, optional
        A gap (rad) to search from as well; a `Prior`'s spread counts as information.
    settings : JointSettings, optional

    Raises
    ------
    InvalidInput
        Unknown, inseparable or unseen parameters; neither angle nor voltage; a window too short; an elastic screw.
    """
    given = settings or JointSettings()
    names, broken = _free(window, free), _faults(window)
    if window.theta_m is not None and not broken:
        window = window.replace(theta_m=motor_angle(window, servo.encoder_resolution, Whitened()))
    model = _model(window, servo, names, given)
    known, start = _known(model, prior, given), _start(model, prior)
    reduce = decimation(max(1, int(window.sample_rate / _SAMPLES_HZ)))
    if broken or _still(window):
        silence = "the voltage is constant: nothing shows how the motor moved"
        return stated(model, stand(model, start, known, reduce.rows), given, "; ".join(broken) or silence)
    found, rival = _search(model, known, start, reduce, given)
    return stated(model, found, given, rival)


def _free(window: Window, free: tuple[str, ...] | None) -> tuple[str, ...]:
    """Names of the free parameters, checked."""
    measured = window.theta_m is not None
    names = (WITH_ANGLE if measured else FROM_VOLTAGE) if free is None else tuple(free)
    for name in names:
        if name not in SPREADS:
            raise InvalidInput(f"free parameter {name!r} does not exist: allowed are {', '.join(SPREADS)}")
    if measured and "k_B" in names:
        raise InvalidInput(
            "k_B cannot be free where theta_m is measured: the position depends on it through theta_m only"
        )
    if not measured and {"k_B", "pitch"} <= set(names):
        raise InvalidInput("k_B and pitch cannot both be free without theta_m: the position shows p/k_B only")
    return tuple(dict.fromkeys(names))


def _model(window: Window, servo: Servo, free: tuple[str, ...], settings: JointSettings) -> JointModel:
    if window.theta_m is None and window.voltage is None:
        raise InvalidInput(f"{window.where}the window has neither theta_m (rad) nor voltage (V): one of them is needed")
    if not servo.rigid:
        raise InvalidInput(f"servo k_d = {servo.k_d} N/m: the joint estimator needs a rigid screw (k_d = inf)")
    delay = ("delay",) if settings.largest_delay_s > 0.0 else ()
    motor = MOTOR_START if window.theta_m is None else ()
    margin = margin_for(settings.largest_delay_s, window.sample_rate)
    if window.position.size < 200 + 2 * margin:
        raise InvalidInput(f"{window.where}the window has {window.position.size} samples: at least {200 + 2 * margin}")
    hold = settings.hold or (Hold.LINEAR if servo.controller.sample_rate is None else Hold.CONSTANT)
    unsure = jumps(window.voltage) if motor and hold is Hold.LINEAR and window.voltage is not None else ()
    names = ("gap", "place", *delay, *free, *motor, *(f"{JUMP}{index}" for index in unsure))
    return JointModel(window, servo, names, hold, margin, unsure)


def _known(model: JointModel, prior: float | GapEstimate | Prior | None, settings: JointSettings) -> Known:
    """Bounds and priors."""
    rows = {"gap": (0.0, settings.largest_gap_rad, 0.0, math.inf), "place": (-1.0, 1.0, 0.0, math.inf)}
    rows["delay"] = (-settings.largest_delay_s, settings.largest_delay_s, 0.0, math.inf)
    rows.update({name: (-4.0 * s, 4.0 * s, 0.0, s) for name, s in ((n, settings.spread(n)) for n in SPREADS)})
    if isinstance(prior, Prior):
        rows["gap"] = (0.0, settings.largest_gap_rad, prior.gap, max(prior.gap_std, settings.model_error_rad))
    if model.window.voltage is not None and model.window.theta_m is None:
        size = max(1e-6, float(np.abs(model.window.voltage).max()))
        speed, current = size / model.servo.k_B, size / model.servo.R
        rows["speed0"] = (-4.0 * speed, 4.0 * speed, float(model.window.voltage[0]) / model.servo.k_B, speed)
        rows["current0"] = (-4.0 * current, 4.0 * current, 0.0, current)
        for index in model.jumps:
            area = 0.5 * abs(float(np.diff(model.window.voltage)[index])) / model.rate
            rows[f"{JUMP}{index}"] = (-area, area, 0.0, area / math.sqrt(3.0))
    return Known(*(np.array(column) for column in zip(*(rows[name] for name in model.names), strict=True)))


def _start(model: JointModel, prior: float | GapEstimate | Prior | None) -> Array:
    values = dict.fromkeys(model.names, 0.0)
    values["gap"] = _gap_of(prior) or 0.0
    if "speed0" in values and model.window.voltage is not None:
        values["speed0"] = float(model.window.voltage[0]) / model.servo.k_B
    return np.array(list(values.values()))


def _gap_of(prior: float | GapEstimate | Prior | None) -> float | None:
    """rad."""
    gap = prior if prior is None or isinstance(prior, int | float) else prior.gap
    if isinstance(prior, GapEstimate) and not prior.ok:
        return None
    if gap is not None and not 0.0 <= gap < math.inf:
        raise InvalidInput(f"prior gap = {gap!r} rad: must be finite and at least 0")
    return gap


def _faults(window: Window) -> tuple[str, ...]:
    """What is plainly wrong with the channels that are used."""
    angle = window.position if window.theta_m is None else window.theta_m
    sentences = faults(Window(window.position, angle, sample_rate=window.sample_rate))
    return tuple(one for one in sentences if window.theta_m is not None or not one.startswith("theta_m"))


def _still(window: Window) -> bool:
    """Whether the voltage is all there is, and constant."""
    return window.theta_m is None and window.voltage is not None and float(np.ptp(window.voltage)) == 0.0


def _search(
    model: JointModel, known: Known, start: Array, reduce: Decimation, settings: JointSettings
) -> tuple[Stand, str]:
    """The best minimum, and what speaks against it being the only one."""
    values = dict(zip(model.names, start.tolist(), strict=True))
    gaps = np.unique(np.append(_GRID[settings.largest_gap_rad >= _GRID], values["gap"]))
    tolerance = _tolerance(model)
    first = known.vague(np.array([name not in MOTOR_START and not name.startswith(JUMP) for name in model.names]))
    coarse = [
        descend(model, begin, first, reduce.rows, 30.0 * tolerance)
        for begin in scan(model, values, gaps, _STARTS, reduce.rows)
    ]
    minima = _distinct(sorted(coarse, key=lambda one: one.cost))
    evaluations = sum(one.evaluations for one in coarse)
    noise = Autoregression.white(1.0)
    for number in range(settings.whitenings):
        noise = noise_left(model, minima[0], reduce, noise, settings.noise_order, put=number == settings.whitenings - 1)
        refined = [descend(model, one.point, known, _whitened(reduce, noise), tolerance) for one in minima]
        evaluations += sum(one.evaluations for one in refined)
        minima = [one for one in _distinct(sorted(refined, key=lambda one: one.cost)) if _near(one, refined)]
    return replace(minima[0], evaluations=evaluations), _rivalry(minima)


def _tolerance(model: JointModel) -> Array:
    """(P,) steps that do not matter: 3e-5 deg, and 1e-6 of what is a logarithm."""
    steps = {"gap": 5e-7, "place": 1e-2, "delay": 1e-8, "gap rate": 1e-6, "speed0": 1e-3, "current0": 1e-4}
    steps.update({f"{JUMP}{index}": 1e-8 for index in model.jumps})
    return np.array([steps.get(name, 1e-6) for name in model.names])


def _whitened(reduce: Decimation, noise: Autoregression):  # type: ignore[no-untyped-def]
    return lambda rows: noise.whiten(reduce.rows(rows))


def _distinct(stands: list[Stand]) -> list[Stand]:
    """The first of each group with the same gap."""
    kept: list[Stand] = []
    for one in stands:
        if all(abs(one.point[0] - other.point[0]) > _APART for other in kept):
            kept.append(one)
    return kept


def _near(one: Stand, others: list[Stand]) -> bool:
    """Whether a minimum is worth following: within a hundred times the rival's distance of the best."""
    return one.cost <= min(other.cost for other in others) + 100.0 * _RIVAL


def _rivalry(minima: list[Stand]) -> str:
    """Words for another minimum that explains the window nearly as well; empty when there is none."""
    rivals = [one for one in minima[1:] if one.cost < minima[0].cost + _RIVAL]
    if not rivals:
        return ""
    gaps = ", ".join(f"{math.degrees(one.point[0]):.3g} deg" for one in (minima[0], *rivals))
    return f"several gaps explain the window: {gaps}"
