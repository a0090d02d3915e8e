"""The PID with a filtered derivative that ran while a drive was recorded, fitted to reference, position and command."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, signal

from servotwin.control.linear_law import LOAD, MOTOR
from servotwin.estimation.inverse_dynamics.fitted_cascade import EXPLAINED, RICHER, UNKNOWN
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

_SHORTEST, _LONGEST = 0.1, 200.0  # samples, time constants of the derivative


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


def fitted_pid(recording: DriveRecording) -> FittedPid:
    """Fit gains and filter time of a recording with a reference: without integral action first, then with it."""
    encoders = (MOTOR,) if recording.load is None else (MOTOR, LOAD)
    simple, rich = (
        min((_fitted(recording, integral, on) for on in encoders), key=lambda law: law.left)
        for integral in (False, True)
    )
    return rich if simple.left > EXPLAINED and rich.left < RICHER * simple.left else simple


def _fitted(recording: DriveRecording, integral: bool, on: str) -> FittedPid:
    """Search the filter time; the gains are linear."""
    # The residual may have two minima over the decades: the better half first.
    grid = np.linspace(math.log(_SHORTEST / recording.rate), math.log(_LONGEST / recording.rate), 13)
    best = int(np.argmin([_with_filter(recording, math.exp(each), integral, on).left for each in grid]))
    found = optimize.minimize_scalar(
        lambda x: min(_with_filter(recording, math.exp(x), integral, on).left, 1e3),
        bounds=(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return _with_filter(recording, math.exp(float(found.x)), integral, on)


def _with_filter(recording: DriveRecording, Tf: float, integral: bool, on: str) -> FittedPid:
    assert recording.reference is not None
    error = recording.reference - (recording.position if recording.load is None or on == MOTOR else recording.load)
    columns = [error, _derivative(error, Tf, recording.rate), np.ones_like(error)]
    if integral:
        # The law adds an error to its integral after it has used it.
        columns.insert(1, (np.cumsum(error) - error) / recording.rate)
    design, force = np.column_stack(columns)[recording.usable], recording.force[recording.usable]
    scale = np.linalg.norm(design, axis=0)
    fit = np.linalg.lstsq(design / scale, force, rcond=None)[0] / scale
    left = float(np.linalg.norm(force - design @ fit) / np.linalg.norm(force))
    Kp, Ki, Kd = (fit[0], fit[1], fit[2]) if integral else (fit[0], 0.0, fit[1])
    return FittedPid(float(Kp), float(Ki), float(Kd), Tf, left if min(Kp, Kd) > 0.0 <= Ki else math.inf, on)


def _derivative(error: Array, Tf: float, rate: float) -> Array:
    """The error less what its low-pass gives, over the time constant, as the law computes it."""
    share = -math.expm1(-1.0 / (rate * Tf))
    slow = signal.lfilter([0.0, share], [1.0, share - 1.0], error - error[0], zi=[0.0])[0] + error[0]
    return np.asarray((error - slow) / Tf)
