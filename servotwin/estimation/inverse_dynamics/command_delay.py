"""Delay between the logged command and the force that moves the drive: fitted beside its parameters.

A held command acts half a sample late; a controller that takes a sample to compute, the lag of a current loop and
clocks that differ add to that. To first order all of them add the command's derivative to the regressors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand
from servotwin.estimation.inverse_dynamics.fit import (
    SYMMETRIC,
    ParameterFit,
    Rows,
    cycle_time,
    fit_models,
    joined,
    least_squares,
    rows_of,
    widened,
)
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

DELAY = ("delay",)
_WELL = 0.05  # of the command: a model that leaves less needs no search
_BETTER = 0.5  # of what is left without a shift
_SHIFTS = (1, 2, 3, 5, 8, 13, 21, 34, 55)  # samples
_FINER = 4
_REVERSAL = 0.05  # of the period of the corner
_ROUNDS, _RESTS = 8, 0.02  # samples
_SHIFT_COUNTS = 0.4  # of a shift: the intervals contain the difference that so much of it makes
_FARTHEST = 13.0  # samples beyond that search
_HOLD, NEAR = 0.5, 0.25  # samples: delay of a held command, and what derivatives of samples may add


@dataclass(frozen=True, eq=False)
class CommandDelay:
    """Delay of a command's effect, and the fits with the command at that time.

    Attributes
    ----------
    delay, half_width : float
        s, and half of its 95 % interval.
    symmetric, asymmetric : ParameterFit
    statistical : ParameterFit
        The symmetric one without what no further motion shows.
    """

    delay: float
    half_width: float
    symmetric: ParameterFit
    asymmetric: ParameterFit
    statistical: ParameterFit

    def beyond_hold(self, rate: float, unsure: float = 0.0) -> float:
        """Part of the delay that no holding of a command at a rate (Hz) explains, s; 0: none for sure."""
        hold = _HOLD / rate
        slack = self.half_width + NEAR / rate + unsure
        return 0.0 if -slack <= self.delay <= hold + slack else self.delay - hold


def delay_remark(late: CommandDelay, lag: float | None, rate: float, corner: float) -> str:
    """Say that the command moves the drive at another time than it was logged; empty: not for sure.

    `lag` is that of the simulated loop (s; None: there is none, or its law is not the one that ran). Reversals do not
    make it wrong as they make the delay of inverse dynamics wrong, by a part of the period of its filter's corner (Hz).
    """
    held = _HOLD / rate
    early = late.delay < 0.0 and (lag is None or lag <= NEAR / rate)
    sure = late.beyond_hold(rate, _REVERSAL / corner) != 0.0 if lag is None or early else lag > NEAR / rate
    if not sure:
        return ""
    delay = late.delay if lag is None or early else lag + held
    sense, cause = "later", "a delay or lag of the drive" + (", or clocks that differ" if lag is None else "")
    if early:
        sense, cause = "earlier", "command and position have different clocks; record both on one"
    return (
        f"the command moves the drive about {1e3 * abs(delay):.2g} ms {sense} than it was logged, of which holding it "
        f"explains {1e3 * held:.2g} ms ({cause}); the parameters are those of the command at that time"
    )


def later(recording: DriveRecording, delay: float) -> DriveRecording:
    """The recording with its command so much later, s."""
    places = np.arange(recording.force.size)
    shifted = places - delay * recording.rate
    usable = np.interp(shifted, places, recording.usable) > 1.0 - 1e-9
    force = np.interp(shifted, places, recording.force)
    return replace(recording, force=force, usable=usable & recording.usable)


def derivative(recording: DriveRecording, force: Array) -> Array:
    """(n, 1) derivative of a force: the regressor of a delay, s."""
    return np.gradient(force, 1.0 / recording.rate)[:, None]


def rows_at(
    recordings: Sequence[DriveRecording], motions: Sequence[DriveMotion], bands: Sequence[RegressionBand], delay: float
) -> Rows:
    """Rows of recordings whose command acts so much later, beside its derivative."""
    every = []
    for recording, motion, band in zip(recordings, motions, bands, strict=True):
        moved = later(recording, delay)
        every.append(rows_of(moved, motion, band, cycle_time(motion), derivative(moved, moved.force)))
    return joined(every)


def fitted_delay(
    recordings: Sequence[DriveRecording], motions: Sequence[DriveMotion], bands: Sequence[RegressionBand]
) -> CommandDelay:
    """The delay at which the command's derivative explains no more, and the two fits there."""
    step = 1.0 / recordings[0].rate
    start = _searched(recordings[0], motions[0], bands[0]) * step
    delay = start
    for _ in range(_ROUNDS):
        change = fit_models(rows_at(recordings, motions, bands, delay), DELAY)[0]["delay"]
        delay = float(np.clip(delay + change, start - _FARTHEST * step, start + _FARTHEST * step))
        if abs(change) < _RESTS * step:
            break
    best = fit_models(rows_at(recordings, motions, bands, delay), DELAY)
    # Derivatives, and the straight lines of a shifted command, err as some of that shift.
    off = delay - max(_SHIFT_COUNTS * abs(delay), _HOLD * step)
    shifted = rows_at(recordings, motions, bands, off)
    others = fit_models(shifted._replace(extra=shifted.extra[:, :0]))
    symmetric, asymmetric = (widened(fit.only(other.names), other) for fit, other in zip(best, others, strict=True))
    return CommandDelay(delay, best[0].half_width("delay"), symmetric, asymmetric, best[0].only(SYMMETRIC))


def _searched(recording: DriveRecording, motion: DriveMotion, band: RegressionBand) -> int:
    """Samples by which the command explains the motion far better later than it was logged; 0: by none."""
    cycle = cycle_time(motion)

    def left(shift: int) -> float:
        rows = rows_of(later(recording, shift / recording.rate), motion, band, cycle)
        return least_squares(SYMMETRIC, rows.design[:, : len(SYMMETRIC)], rows).relative_error

    now = left(0)
    if now < _WELL or recording.usable.size < 4 * _SHIFTS[-1]:
        return 0
    tried = {shift: left(shift) for each in _SHIFTS for shift in (each, -each)}
    near = min(tried, key=lambda shift: tried[shift])
    step = max(1, abs(near) // _FINER)
    tried |= {shift: left(shift) for shift in range(near - 2 * step, near + 2 * step + 1, step)}
    best = min(tried, key=lambda shift: tried[shift])
    return best if tried[best] <= _BETTER * now else 0
