"""Effects beside inertia, friction and offset: what they explain of the force, and what they do to the parameters.

A belt that slips, friction that depends on the speed in another way, a spring or a motor whose torque saturates leave a
part of the force that noise does not make, and the four parameters take over another part. One encoder does not tell
most of these effects apart; as far as any of them explains what is left, the parameters are as uncertain as the fits
with and without it differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import signal

from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand
from servotwin.estimation.inverse_dynamics.fit import ASYMMETRIC, SYMMETRIC, ParameterFit, Rows, regressors
from servotwin.plant.signals import Array

_SLOW = (0.02, 0.06, 0.2)  # of the largest speed: within which friction falls from that of a start
_LIMITS = (0.4, 0.6, 0.8)  # of the largest force: beyond which a clutch or a motor gives less
_LAGS = (0.5, 2.0, 8.0, 32.0)  # rad: time constants of a load that creeps, times the corner
_POWERS = 3  # of place and time
_LARGEST = 0.99  # quantile that counts as the largest force
# Of the squares left, in blocks of time that the fit has not seen, and of what the best effect explains: with 0.1 and
# 0.5 the intervals of 16 healthy machines became 1.6 (inertia) to 3 (Coulomb) times as wide in the median, with these
# 1.15 to 1.6 times.
_EXPLAINS = 0.2
_AS_WELL = 0.6  # of what the best effect explains: others that explain so much may as well be true
_MOST = 3  # effects, one after the other
_MUCH = 0.03  # of the force: 32 healthy machines left at most 0.029 that effects explain
_TINY = 1e-9  # of a column's square, so that columns that are none can be inverted

SPEED = "friction that depends on the speed in another way"
PLACE = "a force or friction that depends on the place"
TIME = "a force or friction that changes with time"
FORCE = "friction that grows with the load, or a force that grows less than the command"
SLIP = "a load that lags or slips, behind a belt or clutch"
LOADED = "elasticity between motor and encoder"
_ENDS = np.cumsum([len(SYMMETRIC), len(ASYMMETRIC)])


class Effects(NamedTuple):
    """Candidates: their kinds, and (n, c) regressors, of each the numbers in `members`."""

    kinds: tuple[str, ...]
    members: tuple[tuple[int, ...], ...]
    columns: Array


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """Effects beside the parameters.

    Attributes
    ----------
    kinds : tuple of str
    symmetric, asymmetric : (4,) and (5,) array
        By how much the parameters of both models differ with them.
    explained : float
        Of the squares that the parameters leave.
    """

    kinds: tuple[str, ...]
    symmetric: Array
    asymmetric: Array
    explained: float

    def widened(self, fits: tuple[ParameterFit, ParameterFit]) -> tuple[ParameterFit, ParameterFit]:
        """Both models, their intervals with these differences."""
        one, other = (
            replace(fit, covariance=fit.covariance + np.diag(off**2))
            for fit, off in zip(fits, (self.symmetric, self.asymmetric), strict=True)
        )
        return one, other

    def remark(self, fit: ParameterFit) -> str:
        """One sentence on what a widened symmetric fit leaves; empty: little, or it hardly changes the parameters."""
        share = math.sqrt(self.explained) * fit.relative_error
        before = np.diag(fit.covariance) - self.symmetric**2
        if share < _MUCH or not np.any(self.symmetric[:-1] ** 2 > before[:-1]):
            return ""
        return (
            f"inertia and friction leave {100.0 * fit.relative_error:.2g} % of the command, which "
            f"{' and '.join(self.kinds)} would explain to {100.0 * share:.2g} %; the intervals contain what that does "
            "to the parameters"
        )


def effects_of(motion: DriveMotion, band: RegressionBand, position: Array, fit: ParameterFit) -> Effects:
    """Candidates along a motion; the force that some of them follow is that of the symmetric fit, without noise."""
    force = regressors(motion)[:, : len(SYMMETRIC)] @ fit.only(SYMMETRIC).values
    speed, side = motion.speed, np.where(motion.resting, 0.0, motion.side)
    fast, top = np.abs(speed), float(np.abs(speed).max())
    largest = float(np.quantile(np.abs(force), _LARGEST))
    place, time = _powers(position), _powers(np.arange(position.size, dtype=float))
    crept = force * fast
    tried = [
        (SPEED, speed * fast),
        *((SPEED, side * np.exp(-fast / (slow * top))) for slow in _SLOW),
        (PLACE, place),
        (PLACE, side[:, None] * place),
        (TIME, time),
        (TIME, side[:, None] * time),
        (FORCE, side * np.abs(force)),
        (FORCE, force**3),
        *((FORCE, force - np.clip(force, -limit * largest, limit * largest)) for limit in _LIMITS),
        (SLIP, np.column_stack([crept, np.gradient(crept, 1.0 / motion.rate)])),
        *((SLIP, _behind(motion, lag / (2.0 * math.pi * band.corner))) for lag in _LAGS),
        (LOADED, np.gradient(np.gradient(motion.acceleration, 1.0 / motion.rate), 1.0 / motion.rate)),
    ]
    ends = np.cumsum([0, *(1 if each.ndim == 1 else each.shape[1] for _, each in tried)])
    members = tuple(tuple(range(begin, end)) for begin, end in pairwise(ends))
    return Effects(tuple(kind for kind, _ in tried), members, np.column_stack([each for _, each in tried]))


def unmodelled(rows: Rows, effects: Effects) -> Unmodelled | None:
    """The effects that explain most, one after the other; None: none explains blocks of time that it has not seen.

    The last extra columns of the rows are the effects'; those before them belong to all models. Other effects that
    explain nearly as much may as well be true: the differences are the largest of all these.
    """
    squares = _Squares.of(rows)
    first = int(_ENDS[-1]) + rows.extra.shape[1] - effects.columns.shape[1]
    members = [[first + each for each in group] for group in effects.members]
    shared = list(range(int(_ENDS[-1]), first))
    symmetric, asymmetric = list(range(_ENDS[0])), list(range(_ENDS[0], _ENDS[1]))
    added: list[int] = []
    likely: list[list[int]] = []
    kinds: list[str] = []
    bare = left = squares.foreseen(symmetric + shared)
    for _ in range(_MOST):
        tried = [squares.foreseen(symmetric + shared + added + each) for each in members]
        best = int(np.argmin(tried))
        if not tried[best] < (1.0 - _EXPLAINS) * left:
            break
        enough = left - _AS_WELL * (left - tried[best])
        likely += [added + each for each, rest in zip(members, tried, strict=True) if rest <= enough]
        kinds.append(effects.kinds[best])
        added, left = added + members[best], tried[best]
    if not likely:
        return None

    def largest(own: list[int]) -> Array:
        plain = squares.values(own + shared)[: len(own)]
        others = np.array([squares.values(own + shared + extra)[: len(own)] for extra in likely])
        return np.asarray(np.abs(others - plain).max(axis=0))

    return Unmodelled(tuple(dict.fromkeys(kinds)), largest(symmetric), largest(asymmetric), 1.0 - left / bare)


class _Squares(NamedTuple):
    """(b, c, c) products of all columns in each block of time, each over its norm `scale`, the force's last."""

    products: Array
    scale: Array

    @classmethod
    def of(cls, rows: Rows) -> _Squares:
        columns = np.column_stack([rows.design, rows.extra, rows.force])
        scale = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
        parts = np.split(columns / scale, np.flatnonzero(np.diff(rows.blocks)) + 1)
        return cls(np.array([part.T @ part for part in parts]), scale)

    def values(self, columns: list[int]) -> Array:
        """Least squares of the force on these columns."""
        return _solved(self.products.sum(axis=0), columns) * self.scale[-1] / self.scale[columns]

    def foreseen(self, columns: list[int]) -> float:
        """Squares left in each block by a fit to all others, summed up; of all of the force's: 1."""
        values = _solved(self.products.sum(axis=0) - self.products, columns)
        whole = np.column_stack([values, -np.ones(len(values))])
        at = [*columns, -1]
        return float(np.einsum("bi,bij,bj->", whole, self.products[:, at][:, :, at], whole))


def _solved(products: Array, columns: list[int]) -> Array:
    gram = products[..., columns, :][..., columns] + _TINY * np.eye(len(columns))
    return np.asarray(np.linalg.solve(gram, products[..., columns, -1, None])[..., 0])


def _powers(values: Array) -> Array:
    """(n, _POWERS) powers from -1 to 1, without their means."""
    scaled = 2.0 * (values - values.min()) / float(np.ptp(values)) - 1.0
    powers = scaled[:, None] ** np.arange(1, _POWERS + 1)
    return np.asarray(powers - powers.mean(axis=0))


def _behind(motion: DriveMotion, lag: float) -> Array:
    """Acceleration of a load that follows with a time constant (s), less the motor's."""
    share = -math.expm1(-1.0 / (motion.rate * lag))
    return np.asarray(signal.lfilter([share], [1.0, share - 1.0], motion.acceleration) - motion.acceleration)
