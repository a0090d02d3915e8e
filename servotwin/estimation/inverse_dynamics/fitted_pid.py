"""The PID with a filtered derivative that ran while a drive was recorded, fitted to reference, position and command."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, signal

from servotwin.control.linear_law import LOAD, MOTOR
from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.fitted_cascade import EXPLAINED, RICHER, UNKNOWN
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

_SHORTEST, _LONGEST = 0.1, 200.0  # samples, time constants of the derivative


@dataclass(frozen=True)
class GivenPid:
    """Gains of a PID that the user knows, as `FittedPid` has them; None: to be fitted."""

    Kp: float | None = None
    Ki: float | None = None
    Kd: float | None = None
    Tf: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("kp", self.Kp), ("kd", self.Kd), ("derivative-filter", self.Tf)):
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"--{name} {value!r}: must be positive and finite")
        if self.Ki is not None and not (math.isfinite(self.Ki) and self.Ki >= 0.0):
            raise InvalidInput(f"--ki {self.Ki!r}: must be finite and at least 0")

    @property
    def complete(self) -> bool:
        """True where the law is known but for an integral and the filter of its derivative."""
        return self.Kp is not None and self.Kd is not None

    def scaled(self, force: float) -> GivenPid:
        """Gains in units of a force of which the command's unit is so many."""
        Kp, Ki, Kd = (None if each is None else force * each for each in (self.Kp, self.Ki, self.Kd))
        return GivenPid(Kp, Ki, Kd, self.Tf)


@dataclass(frozen=True)
class FittedPid:
    """force = Kp e + Ki integral of e + Kd times the derivative of e behind a low-pass, e = reference - position.

    Attributes
    ----------
    Kp, Ki, Kd : float
        Force per position, per position and s, and s per position, in the recording's units.
    Tf : float
        s, of the derivative's low-pass.
    left : float
        Norm of what the law leaves of the force, over that of the force.
    on : {"motor", "load"}
        Encoder that it reads.
    """

    Kp: float
    Ki: float
    Kd: float
    Tf: float
    left: float = math.nan
    on: str = MOTOR

    @property
    def explains(self) -> bool:
        """True where the law gives the force that was recorded."""
        return self.left < UNKNOWN


_FITTED = GivenPid()


def fitted_pid(recording: DriveRecording, given: GivenPid = _FITTED) -> FittedPid:
    """Fit what is not given: without integral action first, with it where that explains the force better.

    Raises
    ------
    InvalidInput
        There is no reference, and gains are not given.
    """
    if recording.reference is None:
        if given.Kp is None or given.Kd is None:
            raise InvalidInput(
                f"{recording.source}: without a reference the controller's gains cannot be fitted: give --reference "
                "COLUMN, or --kp and --kd"
            )
        return FittedPid(given.Kp, given.Ki or 0.0, given.Kd, given.Tf or 1.0 / recording.rate)
    encoders = (MOTOR,) if recording.load is None else (MOTOR, LOAD)
    integrals = (False, True) if given.Ki is None else (given.Ki > 0.0,)
    laws = [
        min((_fitted(recording, each, on, given) for on in encoders), key=lambda law: law.left) for each in integrals
    ]
    simple, rich = laws[0], laws[-1]
    return rich if simple.left > EXPLAINED and rich.left < RICHER * simple.left else simple


def _fitted(recording: DriveRecording, integral: bool, on: str, given: GivenPid) -> FittedPid:
    """Search the filter time; the gains are linear."""
    if given.Tf is not None:
        return _with_filter(recording, given.Tf, integral, on, given)

    def law(logarithm: float) -> FittedPid:
        return _with_filter(recording, math.exp(logarithm), integral, on, given)

    # The residual may have two minima over the decades: the better half first.
    grid = np.linspace(math.log(_SHORTEST / recording.rate), math.log(_LONGEST / recording.rate), 13)
    best = int(np.argmin([law(each).left for each in grid]))
    found = optimize.minimize_scalar(
        lambda x: min(law(x).left, 1e3),
        bounds=(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return law(float(found.x))


def _with_filter(recording: DriveRecording, Tf: float, integral: bool, on: str, given: GivenPid) -> FittedPid:
    """The law of a filter time, its gains by linear least squares where they are not given."""
    assert recording.reference is not None
    error = recording.reference - (recording.position if recording.load is None or on == MOTOR else recording.load)
    columns = {"Kp": error, "Kd": _derivative(error, Tf, recording.rate)}
    if integral:
        # The law adds an error to its integral after it has used it.
        columns["Ki"] = (np.cumsum(error) - error) / recording.rate
    gains = {name: getattr(given, name) for name in columns}
    force = recording.force - sum(gain * columns[name] for name, gain in gains.items() if gain is not None)
    unknown = [name for name, gain in gains.items() if gain is None]
    # The integral begins at an unknown value.
    design = np.column_stack([*(columns[name] for name in unknown), np.ones_like(error)])[recording.usable]
    scale = np.linalg.norm(design, axis=0)
    fit = np.linalg.lstsq(design / scale, force[recording.usable], rcond=None)[0] / scale
    rest = force[recording.usable] - design @ fit
    left = float(np.linalg.norm(rest) / np.linalg.norm(recording.force[recording.usable]))
    gains |= dict(zip(unknown, map(float, fit), strict=False))
    Kp, Ki, Kd = gains["Kp"], gains.get("Ki", 0.0), gains["Kd"]
    return FittedPid(Kp, Ki, Kd, Tf, left if min(Kp, Kd) > 0.0 <= Ki else math.inf, on)


def _derivative(error: Array, Tf: float, rate: float) -> Array:
    """The error less what its low-pass gives, over the time constant, as the law computes it."""
    share = -math.expm1(-1.0 / (rate * Tf))
    slow = signal.lfilter([0.0, share], [1.0, share - 1.0], error - error[0], zi=[0.0])[0] + error[0]
    return np.asarray((error - slow) / Tf)
