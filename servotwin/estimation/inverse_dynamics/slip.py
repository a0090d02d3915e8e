"""Slip between motor and load, of a belt that creeps or slides: a way between two encoders that force adds up.

A gap, an elastic belt, wrong pitches and late encoders leave a difference that only place, speed, acceleration and
force of the moment make. Slip adds up: it goes with the integral of the force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.estimation.inverse_dynamics.conditioning import (
    DriveMotion,
    RegressionBand,
    busiest,
    filtered_rows,
    motion_of,
)
from servotwin.estimation.inverse_dynamics.fit import ParameterFit, cycle_time, fit_models, joined, rows_of
from servotwin.estimation.inverse_dynamics.recording import DriveRecording, held_command
from servotwin.plant.signals import Array

_KNOTS = 8  # of the travel, for pitches and an encoder's own errors
_WARMTH = 3  # powers of time
_EXPLAINS = 0.6  # of the squares that the moment leaves: 56 healthy logs had at most 0.40, 42 with slip at least 0.66
_COUNTS = 4.0  # of the coarser encoder: least slip that is told
_BEHIND = ("load's acceleration", "load's side")


@dataclass(frozen=True, eq=False)
class BeltSlip:
    """Slip between motor and load.

    Attributes
    ----------
    size : float
        Way between the encoders that force added up and that nothing else explains, from least to most, m (rotary:
        rad).
    share : float
        Of the squares that place and force of the moment leave.
    symmetric, asymmetric : ParameterFit
        With the load's own acceleration beside the motor's.
    """

    size: float
    share: float
    symmetric: ParameterFit
    asymmetric: ParameterFit

    def remark(self, unit: str) -> str:
        """One sentence."""
        return (
            f"the load slips against the motor: by {self.size:.2g} {unit} in this log, with the force over time, as a "
            "belt does that creeps or slides; tension it and record again. The intervals contain what slip does to the "
            "parameters"
        )


def belt_slip(
    recordings: Sequence[DriveRecording], motions: Sequence[DriveMotion], bands: Sequence[RegressionBand]
) -> BeltSlip | None:
    """The slip that the first recording shows; None: no load encoder, or none for sure."""
    if recordings[0].load is None:
        return None
    size, share = _added_up(*busiest(recordings[0], motions[0]), bands[0])
    counts = max(recordings[0].resolution, recordings[0].load_resolution)
    if not (share > _EXPLAINS and size > _COUNTS * counts):
        return None
    every = []
    for recording, motion, band in zip(recordings, motions, bands, strict=True):
        if recording.load is not None:
            # The load's speed less the motor's is the force itself where a belt creeps, and would take its place.
            load = motion_of(recording.load, recording.rate, band)
            behind = np.column_stack([load.acceleration - motion.acceleration, load.side - motion.side])
            every.append(rows_of(held_command(recording), motion, band, cycle_time(motion), behind))
    symmetric, asymmetric = fit_models(joined(every), _BEHIND)
    return BeltSlip(size, share, symmetric, asymmetric)


def _added_up(recording: DriveRecording, motion: DriveMotion, band: RegressionBand) -> tuple[float, float]:
    """Way between the encoders that force adds up, from least to most, and the share of the squares it explains."""
    assert recording.load is not None
    moment, sums = _of_the_moment(recording, motion), _sums(recording, motion)
    columns = np.column_stack([moment, sums, recording.position - recording.load])
    rows, _ = filtered_rows(columns, np.ones(len(columns), dtype=bool), recording.usable, recording.rate, band)
    if len(rows) <= 2 * columns.shape[1]:
        return 0.0, 0.0
    design, apart = rows[:, :-1], rows[:, -1]
    left = _left(rows[:, : moment.shape[1]], np.column_stack([design[:, moment.shape[1] :], apart]))
    sums_left, apart_left = left[:, :-1], left[:, -1]
    slip = apart_left - _left(sums_left, apart_left[:, None])[:, 0]
    power = float(apart_left @ apart_left)
    return float(np.ptp(slip)), float(slip @ slip) / power if power > 0.0 else 0.0


def _of_the_moment(recording: DriveRecording, motion: DriveMotion) -> Array:
    """(n, c) columns of a difference that place, motion and force of the moment make, and warmth."""
    place = recording.position
    knots = np.linspace(place.min(), place.max(), _KNOTS)
    hats = np.maximum(0.0, 1.0 - np.abs(place[:, None] - knots) / (knots[1] - knots[0]))
    speed, side = motion.speed, np.where(motion.resting, 0.0, motion.side)
    warmth = np.linspace(-1.0, 1.0, place.size)[:, None] ** np.arange(1, _WARMTH + 1)
    return np.column_stack([hats, speed, motion.acceleration, side, recording.force, speed * np.abs(speed), warmth])


def _sums(recording: DriveRecording, motion: DriveMotion) -> Array:
    """(n, 4) what force and friction add up to over time, and force and inertia over the way."""
    side, fast = np.where(motion.resting, 0.0, motion.side), np.abs(motion.speed)
    each = [recording.force, side, fast * recording.force, fast * motion.acceleration]
    return np.asarray(np.cumsum(np.column_stack(each), axis=0) / recording.rate)


def _left(design: Array, columns: Array) -> Array:
    """Residual (r, c) of columns after least squares with a design (r, p)."""
    norm = np.linalg.norm(design, axis=0)
    scaled = design / np.where(norm > 0.0, norm, 1.0)
    return np.asarray(columns - scaled @ np.linalg.lstsq(scaled, columns, rcond=1e-10)[0])
