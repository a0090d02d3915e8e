"""Least squares of the force on the motion, with standard deviations from blocks of the recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.special import stdtrit

from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand, filtered_rows
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

SYMMETRIC = ("inertia", "viscous", "coulomb", "offset")
ASYMMETRIC = ("inertia", "viscous_forward", "coulomb_forward", "viscous_backward", "coulomb_backward")
Groups: TypeAlias = np.ndarray[Any, np.dtype[np.int64]]

_FEWEST, _MOST = 4, 40  # blocks
_PARTS = 12  # of the travel
_LEAST_ROWS = 40


@dataclass(frozen=True, eq=False)
class ParameterFit:
    """Parameters of one model with their covariance.

    Attributes
    ----------
    names : tuple of str
        `SYMMETRIC` or `ASYMMETRIC`: inertia (kg; rotary kg m^2), viscous friction (N s/m; N m s/rad), Coulomb
        friction and offset (N; N m), the offset as a force that resists the forward motion.
    values : (p,) array
    covariance : (p, p) array
        By leaving out one part of the recording after the other; of `identify_drive` also of what a held command does,
        or the delay of a late one.
    freedom : (p,) array
        Degrees of freedom of the variances.
    beside : (p,) array
        Largest difference that an effect beside the parameters may make to each: standard deviations contain it.
    relative_error : float
        Norm of what the model leaves over that of the force, both filtered.
    condition : float
        Of the regressors' matrix, its columns of norm 1.
    rows : int
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    freedom: Array
    beside: Array
    relative_error: float
    condition: float
    rows: int

    def __getitem__(self, name: str) -> float:
        """Value of a parameter."""
        return float(self.values[self.names.index(name)])

    def only(self, names: tuple[str, ...]) -> ParameterFit:
        """The fit of some of its parameters, with what the others do to their covariance."""
        at = [self.names.index(name) for name in names]
        covariance = self.covariance[np.ix_(at, at)]
        return replace(
            self,
            names=names,
            values=self.values[at],
            covariance=covariance,
            freedom=self.freedom[at],
            beside=self.beside[at],
        )

    def std(self, name: str) -> float:
        """Standard deviation of a parameter."""
        place = self.names.index(name)
        return math.hypot(math.sqrt(float(self.covariance[place, place])), float(self.beside[place]))

    def half_width(self, name: str) -> float:
        """Half the 95 % interval of a parameter."""
        freedom = max(float(self.freedom[self.names.index(name)]), 1.0)
        return float(stdtrit(freedom, 0.975)) * self.std(name)


def regressors(motion: DriveMotion) -> Array:
    """(n, 9) columns of both models: four symmetric ones, then five asymmetric ones."""
    forward, backward = motion.side > 0.0, motion.side < 0.0
    ones = np.ones_like(motion.speed)
    return np.column_stack(
        [
            motion.acceleration,
            motion.speed,
            motion.side,
            ones,
            motion.acceleration,
            motion.speed * forward,
            ones * forward,
            motion.speed * backward,
            -ones * backward,
        ]
    )


class Rows(NamedTuple):
    """Filtered and decimated rows of one or more recordings.

    Attributes
    ----------
    design : (r, 9) array
        Regressors of the symmetric model, then of the asymmetric one.
    force : (r,) array
    blocks : (r,) int array
        Number of each row's block of time.
    places : (r,) int array
        Number of each row's part of the travel.
    extra : (r, e) array
        Further regressors of both models.
    """

    design: Array
    force: Array
    blocks: Groups
    places: Groups
    extra: Array


def rows_of(
    recording: DriveRecording, motion: DriveMotion, band: RegressionBand, cycle: float, extra: Array | None = None
) -> Rows:
    """Rows of a recording for a motion; `cycle` is the duration of one cycle of it, s, `extra` (n, e) regressors."""
    further = np.empty((motion.speed.size, 0)) if extra is None else extra
    columns = np.column_stack([regressors(motion), further, recording.force])
    rows, times = filtered_rows(columns, ~motion.resting, recording.usable, recording.rate, band)
    if len(rows) < _LEAST_ROWS:
        raise InvalidInput(
            f"{recording.source}: {len(rows)} moments of motion are left after filtering at {band.corner:.3g} Hz, "
            f"of at least {_LEAST_ROWS} ({100.0 * np.mean(~recording.usable):.0f} % of the samples are missing, the "
            f"axis rests in {100.0 * np.mean(motion.resting):.0f} %): record a longer motion without pauses"
        )
    position = recording.position[np.round(times * recording.rate).astype(int)]
    blocks, ends = _blocks(times, cycle, rows), len(SYMMETRIC) + len(ASYMMETRIC)
    return Rows(rows[:, :ends], rows[:, -1], blocks, _places(position), rows[:, ends:-1])


def joined(every: Sequence[Rows]) -> Rows:
    """Rows of all recordings; no block belongs to two."""
    firsts = np.cumsum([0, *(int(each.blocks[-1]) + 1 for each in every)])
    blocks = [each.blocks + first for each, first in zip(every, firsts, strict=False)]
    # A tight spot is in all logs at the same place.
    return Rows(
        *(
            np.concatenate(part)
            for part in zip(*(each._replace(blocks=own) for each, own in zip(every, blocks, strict=True)), strict=True)
        )
    )


def fit_models(rows: Rows, extra: tuple[str, ...] = ()) -> tuple[ParameterFit, ParameterFit]:
    """Fit the symmetric and the asymmetric model, both with the extra regressors, whose parameters come last."""
    symmetric, asymmetric = np.split(rows.design, [len(SYMMETRIC)], axis=1)
    if extra:
        symmetric, asymmetric = (np.column_stack([part, rows.extra]) for part in (symmetric, asymmetric))
    return (
        least_squares((*SYMMETRIC, *extra), symmetric, rows),
        least_squares((*ASYMMETRIC, *extra), asymmetric, rows),
    )


def widened(fit: ParameterFit, other: ParameterFit, share: float = 1.0) -> ParameterFit:
    """Fit whose covariance also contains its difference to another one that may as well be true, or a share of it."""
    off = share * (fit.values - other.values)
    return replace(fit, covariance=fit.covariance + np.outer(off, off))


def _blocks(times: Array, cycle: float, rows: Array) -> Groups:
    """Number of each row's block: whole cycles of motion, longer than errors hang together."""
    design, force = rows[:, : len(SYMMETRIC)], rows[:, -1]
    left = force - design @ solved(design, force)
    step = float(np.median(np.diff(times)))
    wanted = max(cycle, 5.0 * step * correlation_length(left))
    count = int(np.clip(times.size * step / wanted, _FEWEST, _MOST))
    return np.arange(times.size) * count // times.size


def _places(position: Array) -> Groups:
    """Number of each row's part of the travel, with as many rows in each."""
    return np.argsort(np.argsort(position)) * _PARTS // position.size


def cycle_time(motion: DriveMotion) -> float:
    """Usual time from a reversal to the next one of the same direction, s; 0 without."""
    side = motion.side[~motion.resting]
    changes = np.flatnonzero(np.diff(side) > 0.0)
    # Noise at a reversal changes the sign many times.
    gaps = np.diff(changes)
    gaps = gaps[gaps > 0.1 * gaps.max()] if gaps.size else gaps
    return float(np.median(gaps)) / motion.rate if gaps.size else 0.0


def correlation_length(left: Array) -> float:
    """Rows over which residuals hang together: integral of their correlation up to its first zero."""
    centred = left - left.mean()
    power = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
    correlation = np.fft.irfft(power)[: centred.size]
    if correlation[0] <= 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    below = np.flatnonzero(correlation < 0.0)
    return float(1.0 + 2.0 * correlation[1 : below[0] if below.size else correlation.size].sum())


def least_squares(names: tuple[str, ...], design: Array, rows: Rows) -> ParameterFit:
    """Fit, and leave out one block of time, or one part of the travel, after the other for the covariance.

    Errors hang together in time (drift) and, as they come again in every cycle, in place (cyclic friction, a tight
    spot): the covariance is the sum of both, on the safe side of that for two-way clusters (Cameron, Gelbach and Miller
    2011). A bootstrap that draws blocks may draw none at another speed, and is singular then; leaving out one is not.
    """
    scale = _scale(design)
    values = solved(design, rows.force)
    left = rows.force - design @ values
    singular = np.linalg.svd(design * scale, compute_uv=False)
    parts = [_left_out(design * scale, rows.force, groups) for groups in (rows.blocks, rows.places)]
    # Degrees of freedom of a sum of variances (Welch and Satterthwaite).
    variances = np.array([np.diag(each) for each in parts])
    counts = np.array([[rows.blocks.max()], [rows.places.max()]])
    freedom = variances.sum(axis=0) ** 2 / np.maximum((variances**2 / counts).sum(axis=0), np.finfo(float).tiny)
    return ParameterFit(
        names,
        values,
        np.sum(parts, axis=0) * np.outer(scale, scale),
        freedom,
        np.zeros(values.size),
        float(np.linalg.norm(left) / np.linalg.norm(rows.force)),
        float(singular[0] / max(singular[-1], np.finfo(float).tiny)),
        rows.force.size,
    )


def solved(design: Array, force: Array) -> Array:
    """(p,) least squares of a force on (r, p) columns, whatever their units: none counts as 0 for being small."""
    scale = _scale(design)
    return np.asarray(scale * np.linalg.lstsq(design * scale, force, rcond=None)[0])


def _scale(design: Array) -> Array:
    """(p,) factors that make columns of norm 1."""
    return np.asarray(1.0 / np.maximum(np.linalg.norm(design, axis=0), np.finfo(float).tiny))


def _left_out(design: Array, force: Array, groups: Groups) -> Array:
    """Covariance by leaving out one group after the other."""
    members = [groups == group for group in np.unique(groups)]
    grams = np.array([design[here].T @ design[here] for here in members])
    sides = np.array([design[here].T @ force[here] for here in members])
    gram, side = grams.sum(axis=0), sides.sum(axis=0)
    whole = np.linalg.lstsq(gram, side, rcond=None)[0]
    without = [np.linalg.lstsq(gram - g, side - h, rcond=None)[0] for g, h in zip(grams, sides, strict=True)]
    spread = np.array(without) - whole
    return np.asarray((len(members) - 1) / len(members) * spread.T @ spread)
