"""The controller that ran while a drive was recorded: its gains, fitted to reference, position and command."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, signal

from servotwin.control.linear_law import LOAD, MOTOR
from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.fit import solved
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

_LEAST_FILTER, _LONGEST_FILTER = 0.1, 50.0  # samples
_RESETS, _APART = 12, 0.3  # integral times tried first, from a sample to the log's length; logarithm
_NONE = 1e3  # in place of the residual of gains of the wrong sign
RICHER = 0.8
"""Of a simpler law's residual: a richer one must do better."""
EXPLAINED = 0.02
"""Of the force: a law that leaves no more needs no integral, and no other law."""
UNKNOWN = 0.25
"""Of the force: a law that leaves more is not the one that ran."""


@dataclass(frozen=True)
class FittedCascade:
    """Position P, velocity P or PI: force = Kv (e + integral of e / Ti), e = Kp (reference - position) - speed.

    Attributes
    ----------
    position_gain : float
        1/s.
    velocity_gain : float
        Force per speed, in the recording's units.
    integral_time : float or None
        s.
    speed_filter : float
        s, with which the position is differentiated.
    left : float
        Norm of what the law leaves of the force, over that of the force.
    on : {"motor", "load"}
        Encoder that the position loop reads.
    """

    position_gain: float
    velocity_gain: float
    integral_time: float | None
    speed_filter: float
    left: float = math.nan
    on: str = MOTOR

    @property
    def explains(self) -> bool:
        """True where the law gives the force that was recorded."""
        return self.left < UNKNOWN


@dataclass(frozen=True)
class GivenGains:
    """Gains that the user knows; None: to be fitted. The velocity gain is force per speed."""

    position_gain: float | None = None
    velocity_gain: float | None = None
    integral_time: float | None = None
    speed_filter: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (
            ("position_gain", "1/s"),
            ("velocity_gain", ""),
            ("integral_time", "s"),
            ("speed_filter", "s"),
        ):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(
                    f"--{name.replace('_', '-')} {value!r} {unit}".rstrip() + ": must be positive and finite"
                )

    @property
    def complete(self) -> bool:
        """True where the law is known but for the filter of its speed."""
        return self.position_gain is not None and self.velocity_gain is not None

    def scaled(self, force: float) -> GivenGains:
        """Gains in units of a force of which the command's unit is so many."""
        return self if self.velocity_gain is None else replace(self, velocity_gain=force * self.velocity_gain)


def fitted_cascade(recording: DriveRecording, given: GivenGains) -> FittedCascade:
    """Fit what is not given: without integral action first, with it where that explains the force better.

    Raises
    ------
    InvalidInput
        There is no reference, and gains are not given.
    """
    step = 1.0 / recording.rate
    if recording.reference is None:
        if not given.complete:
            raise InvalidInput(
                f"{recording.source}: without a reference the controller's gains cannot be fitted: give --reference "
                "COLUMN, or --position-gain and --velocity-gain"
            )
        return FittedCascade(given.position_gain, given.velocity_gain, given.integral_time, given.speed_filter or step)  # type: ignore[arg-type]
    encoders = (MOTOR,) if recording.load is None else (MOTOR, LOAD)
    integral = given.integral_time is not None
    simple = min((_fitted(recording, given, integral, on) for on in encoders), key=lambda law: law.left)
    if integral or given.complete or simple.left < EXPLAINED:
        return simple
    rich = min((_fitted(recording, given, True, on) for on in encoders), key=lambda law: law.left)
    return rich if rich.left < RICHER * simple.left else simple


def differentiated(position: Array, time: float, rate: float) -> Array:
    """Low-pass derivative of a sampled position, as the law of a cascade computes it."""
    share = -math.expm1(-1.0 / (rate * time))
    slow, _ = signal.lfilter([0.0, share], [1.0, share - 1.0], position - position[0], zi=[0.0])
    return np.asarray(share * rate * (position - position[0] - slow))


def _fitted(recording: DriveRecording, given: GivenGains, integral: bool, on: str) -> FittedCascade:
    """Search the filter's time and the integral time; the two gains are linear."""
    step = 1.0 / recording.rate
    if given.speed_filter is not None and not (integral and given.integral_time is None):
        return _with_gains(recording, given, on)
    bounds = (math.log(_LEAST_FILTER * step), math.log(_LONGEST_FILTER * step))

    def law_of(filter_log: float, integral_log: float | None) -> FittedCascade:
        speed_filter = given.speed_filter or math.exp(filter_log)
        reset = given.integral_time if integral_log is None else math.exp(integral_log)
        return _with_gains(recording, replace(given, speed_filter=speed_filter, integral_time=reset), on)

    best = optimize.minimize_scalar(lambda x: min(law_of(x, None).left, _NONE), bounds=bounds, method="bounded")
    if not integral or given.integral_time is not None:
        return law_of(float(best.x), None)
    resets = np.linspace(math.log(step), math.log(recording.duration), _RESETS)
    start = np.array([float(best.x), min(resets, key=lambda x: law_of(float(best.x), x).left)])
    both = optimize.minimize(
        lambda x: (
            min(law_of(*x).left, _NONE) if bounds[0] <= x[0] <= bounds[1] and resets[0] <= x[1] <= resets[-1] else _NONE
        ),
        start,
        method="Nelder-Mead",
        # Without it the first steps are parts of the logarithms, which depend on the unit of time.
        options={"maxiter": 120, "xatol": 1e-3, "fatol": 1e-7, "initial_simplex": start + _APART * np.eye(3, 2, -1)},
    )
    return law_of(*both.x)


def _with_gains(recording: DriveRecording, given: GivenGains, on: str) -> FittedCascade:
    """The law of given filter times, its gains by linear least squares where they are not given."""
    reference, position, force, rate = recording.reference, recording.position, recording.force, recording.rate
    assert reference is not None
    assert given.speed_filter is not None
    error = reference - (position if recording.load is None or on == MOTOR else recording.load)
    columns = np.column_stack([error, -differentiated(position, given.speed_filter, rate)])
    if given.integral_time is not None:
        columns = columns + (np.cumsum(columns, axis=0) - columns) / (rate * given.integral_time)
    # The integral begins at an unknown value, and the encoder's zero may be another one than the reference's.
    constant = np.ones((force.size, 1))
    force, columns, constant = force[recording.usable], columns[recording.usable], constant[recording.usable]
    # Force = Kv Kp first + Kv second: what is known of the two factors is taken out.
    Kp, Kv = given.position_gain, given.velocity_gain
    known, unknown = np.zeros_like(force), columns
    if Kp is not None:
        unknown = columns @ np.array([[Kp], [1.0]])
    if Kv is not None:
        known, unknown = Kv * (unknown[:, 0] if Kp is not None else columns[:, 1]), columns[:, : 0 if Kp else 1]
    design = np.column_stack([unknown, constant])
    fit = solved(design, force - known)
    left = force - known - design @ fit
    if Kv is None:
        Kv = float(fit[0] if Kp is not None else fit[1])
    if Kp is None:
        Kp = float(fit[0]) / Kv if Kv else 0.0
    share = float(np.linalg.norm(left) / np.linalg.norm(force))
    return FittedCascade(Kp, Kv, given.integral_time, given.speed_filter, share if min(Kp, Kv) > 0.0 else math.inf, on)
