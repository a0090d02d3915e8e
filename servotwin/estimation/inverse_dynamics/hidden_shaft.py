"""An elasticity behind the motor's encoder: the load's acceleration lags, and a rigid fit has a wrong inertia."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from servotwin.estimation.inverse_dynamics.command_delay import DELAY, CommandDelay, derivative, later
from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand
from servotwin.estimation.inverse_dynamics.fit import (
    ASYMMETRIC,
    SYMMETRIC,
    ParameterFit,
    Rows,
    cycle_time,
    fit_models,
    joined,
    rows_of,
)
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

_TRIED = np.geomspace(0.02, 16.0, 30)  # resonances with the motor held, over the corner of the filter
_DAMPING = 0.05
_HIGHEST = 0.1  # of the sample rate: beyond, derivatives of samples look like a shaft
_LOAD = ("load_inertia",)
_LEAST = 0.05  # of the inertia: with cyclic friction 19 of 200 rigid machines seemed to have 0.004 to 0.03 on a shaft
# Told is what is twice its 95 % interval and explains so much of the squares that the rigid model leaves, or much of
# them: those 19 were at most 1.6 intervals and explained 0.11, EMPS is 1.9 and 0.02.
_SURE, _EXPLAINS, _MUCH = 2.0, 0.05, 0.2


@dataclass(frozen=True, eq=False)
class HiddenShaft:
    """Fits with a load on a shaft, its inertia the sum of both, and about its resonance with the motor held, Hz.

    `explained` is the part of the squares left by the rigid model that they explain.
    """

    resonance: float
    symmetric: ParameterFit
    asymmetric: ParameterFit
    explained: float

    @property
    def sure(self) -> bool:
        """If it is evident enough to be told."""
        fit = self.symmetric
        known = fit["load_inertia"] > _SURE * fit.half_width("load_inertia")
        return self.explained > (_EXPLAINS if known else _MUCH)

    @property
    def rigid(self) -> tuple[ParameterFit, ParameterFit]:
        """The parameters of the models without a shaft."""
        return self.symmetric.only(SYMMETRIC), self.asymmetric.only(ASYMMETRIC)

    def remark(self, load_encoder: bool) -> str:
        """One sentence; empty: not for sure."""
        if not self.sure:
            return ""
        text = (
            f"the command fits a machine with an elasticity better than a rigid one: a resonance of about "
            f"{self.resonance:.2g} Hz with the motor held, which the axis does not have; "
            "the intervals contain what it does to the parameters"
        )
        return text if load_encoder else f"{text}; record a second encoder at the load"


def hidden_shaft(
    recordings: Sequence[DriveRecording],
    motions: Sequence[DriveMotion],
    bands: Sequence[RegressionBand],
    late: CommandDelay,
) -> HiddenShaft | None:
    """The shaft that explains most of the command beside a delay; None: none is evident."""
    found = None
    tried = _TRIED * bands[0].corner
    for each in tried[tried < _HIGHEST * recordings[0].rate]:
        rows = _rows(recordings, motions, bands, late.delay, float(each))
        fit = fit_models(rows, (*DELAY, *_LOAD))
        load = fit[0]["load_inertia"]
        least = max(fit[0].half_width("load_inertia"), _LEAST * fit[0]["inertia"])
        evident = least < load < fit[0]["inertia"]
        if evident and (found is None or fit[0].relative_error < found.symmetric.relative_error):
            explained = 1.0 - (fit[0].relative_error / late.symmetric.relative_error) ** 2
            found = HiddenShaft(float(each), *fit, explained)
    return found


def _rows(
    recordings: Sequence[DriveRecording],
    motions: Sequence[DriveMotion],
    bands: Sequence[RegressionBand],
    delay: float,
    resonance: float,
) -> Rows:
    every = []
    for recording, motion, band in zip(recordings, motions, bands, strict=True):
        moved = later(recording, delay)
        lag = _load_acceleration(motion, resonance) - motion.acceleration
        extra = np.column_stack([derivative(moved, moved.force), lag])
        every.append(rows_of(moved, motion, band, cycle_time(motion), extra))
    return joined(every)


def _load_acceleration(motion: DriveMotion, resonance: float) -> Array:
    """Acceleration of a load on a shaft, of a resonance (Hz) with the motor held."""
    omega = 2.0 * math.pi * resonance
    law = [2.0 * _DAMPING * omega, omega**2], [1.0, 2.0 * _DAMPING * omega, omega**2]
    above, below, _ = signal.cont2discrete(law, 1.0 / motion.rate, "foh")
    return np.asarray(signal.lfilter(np.ravel(above), below, motion.acceleration))
