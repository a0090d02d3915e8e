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
from servotwin.estimation.inverse_dynamics.fit import ASYMMETRIC, SYMMETRIC, ParameterFit, Rows
from servotwin.plant.signals import Array

_SLOW = (0.02, 0.06, 0.2)  # of the largest speed: within which friction falls from that of a start
_LOADS = (1.0, 0.7, 0.4)  # of the inertia: the load's own part, whose force makes friction
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
# Of the force, of which nothing explains a part: healthy machines left at most 0.03, a belt that sticks and slips 0.24.
_UNKNOWN = 0.1
_OF_CHANCE = 0.5  # a 95 % interval has two standard deviations: belts that slip were off by up to 0.8 of that
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
    """Candidates: their kinds, and (n, c) regressors, of each the numbers in `members`.

    `steady` (s, c) are the regressors at constant `speeds` (s,), half the difference of both directions.
    """

    kinds: tuple[str, ...]
    members: tuple[tuple[int, ...], ...]
    columns: Array
    speeds: Array
    steady: Array


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """Effects beside the parameters.

    Attributes
    ----------
    kinds : tuple of str
        Empty where much is left and nothing explains it.
    symmetric, asymmetric : (4,) and (5,) array
        By how much the parameters of both models differ with them.
    friction : (s,) array
        By how much the friction at the `speeds` of the effects does.
    explained : float
        Of the squares that the parameters leave.
    """

    kinds: tuple[str, ...]
    symmetric: Array
    asymmetric: Array
    friction: Array
    explained: float

    def widened(self, fits: tuple[ParameterFit, ParameterFit]) -> tuple[ParameterFit, ParameterFit]:
        """Both models, their intervals with these differences."""
        one, other = (
            replace(fit, beside=np.hypot(fit.beside, off))
            for fit, off in zip(fits, (self.symmetric, self.asymmetric), strict=True)
        )
        return one, other

    def remark(self, fit: ParameterFit) -> str:
        """One sentence on what a widened symmetric fit leaves; empty: little, or it hardly changes the parameters."""
        if not self.kinds:
            return (
                f"inertia and friction leave {100.0 * fit.relative_error:.2g} % of the command, and nothing that was "
                "tried explains it: the intervals contain what a force so large could do to each parameter; look for "
                "what slips, sticks or plays, and record a second encoder"
            )
        share = math.sqrt(self.explained) * fit.relative_error
        before = np.diag(fit.covariance)
        if share < _MUCH or not np.any(self.symmetric[:-1] ** 2 > before[:-1]):
            return ""
        return (
            f"inertia and friction leave {100.0 * fit.relative_error:.2g} % of the command, which "
            f"{' and '.join(self.kinds)} would explain to {100.0 * share:.2g} %; the intervals contain what that does "
            "to the parameters"
        )


class _Moment(NamedTuple):
    """(n,) acceleration, speed and its sign."""

    acceleration: Array
    speed: Array
    side: Array

    def force(self, fit: ParameterFit, share: float = 1.0) -> Array:
        """(n,) force of a symmetric fit, of its inertia a share."""
        inertial = share * fit["inertia"] * self.acceleration
        return inertial + fit["viscous"] * self.speed + fit["coulomb"] * self.side + fit["offset"]


def effects_of(motion: DriveMotion, band: RegressionBand, position: Array, fit: ParameterFit) -> Effects:
    """Candidates along a motion; the force that some of them follow is that of the symmetric fit, without noise."""
    side = np.where(motion.resting, 0.0, motion.side)
    moving, speeds = _Moment(motion.acceleration, motion.speed, side), motion.speeds
    both = np.concatenate([speeds, -speeds])
    steady = _Moment(np.zeros(both.size), both, np.sign(both))
    force = moving.force(fit)
    ends = float(np.abs(motion.speed).max()), float(np.quantile(np.abs(force), _LARGEST))
    of_moment, at_speeds = (_of_the_moment(each, fit, *ends) for each in (moving, steady))
    place, time = _powers(position), _powers(np.arange(position.size, dtype=float))
    changing = [
        (PLACE, place),
        (PLACE, side[:, None] * place),
        (TIME, time),
        (TIME, side[:, None] * time),
        *((SLIP, _behind(motion, lag / (2.0 * math.pi * band.corner))) for lag in _LAGS),
        (LOADED, np.gradient(np.gradient(motion.acceleration, 1.0 / motion.rate), 1.0 / motion.rate)[:, None]),
    ]
    crept, crept_there = (each.force(fit) * np.abs(each.speed) for each in (moving, steady))
    creep = np.column_stack([crept, np.gradient(crept, 1.0 / motion.rate)])
    tried = [*of_moment, (SLIP, creep), *changing]
    ends_of = np.cumsum([0, *(each.shape[1] for _, each in tried)])
    columns = np.column_stack([each for _, each in tried])
    there = np.zeros((both.size, columns.shape[1]))
    there[:, : len(of_moment) + 1] = np.column_stack([*(each for _, each in at_speeds), crept_there])
    return Effects(
        tuple(kind for kind, _ in tried),
        tuple(tuple(range(begin, end)) for begin, end in pairwise(ends_of)),
        columns,
        speeds,
        0.5 * (there[: speeds.size] - there[speeds.size :]),
    )


def _of_the_moment(at: _Moment, fit: ParameterFit, top: float, largest: float) -> list[tuple[str, Array]]:
    """Kinds and (n, 1) regressors that follow speed and force of the moment, by the largest of both in a log."""
    force, fast = at.force(fit), np.abs(at.speed)
    return [
        (kind, column[:, None])
        for kind, column in (
            (SPEED, at.speed * fast),
            *((SPEED, at.side * np.exp(-fast / (slow * top))) for slow in _SLOW),
            *((FORCE, at.side * np.abs(at.force(fit, share))) for share in _LOADS),
            (FORCE, force**3),
            *((FORCE, force - np.clip(force, -limit * largest, limit * largest)) for limit in _LIMITS),
        )
    ]


def unmodelled(rows: Rows, effects: Effects) -> Unmodelled | None:
    """The effects that explain most, one after the other; None: little is left, or noise.

    The last extra columns of the rows are the effects'; those before them belong to all models. Other effects that
    explain nearly as much may as well be true: the differences are the largest of all these. Where much is left and
    none explains blocks of time that it has not seen, they are those of a force as large as what is left.
    """
    squares = _Squares.of(rows)
    first = int(_ENDS[-1]) + rows.extra.shape[1] - effects.columns.shape[1]
    members = [[first + each for each in group] for group in effects.members]
    shared = list(range(int(_ENDS[-1]), first))
    symmetric = list(range(_ENDS[0]))
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
    if likely:
        off = _differences(squares, shared, likely, np.column_stack([_steady(effects.speeds), effects.steady]))
    elif bare > _UNKNOWN**2:
        off = _of_chance(squares, shared, bare, _steady(effects.speeds))
    else:
        return None
    return Unmodelled(tuple(dict.fromkeys(kinds)), *off, 1.0 - left / bare)


def _steady(speeds: Array) -> Array:
    """(s, 4) symmetric regressors at constant speeds, half the difference of both directions."""
    none = np.zeros_like(speeds)
    return np.column_stack([none, speeds, np.ones_like(speeds), none])


def _differences(
    squares: _Squares, shared: list[int], likely: list[list[int]], steady: Array
) -> tuple[Array, Array, Array]:
    """Largest differences that effects make to both models and to the friction, at (s, 4 + c) steady regressors."""

    def largest(own: list[int]) -> Array:
        plain = squares.values(own + shared)[: len(own)]
        others = np.array([squares.values(own + shared + extra)[: len(own)] for extra in likely])
        return np.asarray(np.abs(others - plain).max(axis=0))

    symmetric, asymmetric = list(range(_ENDS[0])), list(range(_ENDS[0], _ENDS[1]))
    ends = len(symmetric), int(_ENDS[1]) + len(shared)
    plain = steady[:, symmetric] @ squares.values(symmetric + shared)[symmetric]
    friction = []
    for extra in likely:
        values = np.delete(squares.values(symmetric + shared + extra), range(ends[0], ends[0] + len(shared)))
        there = steady[:, [*symmetric, *(each - ends[1] + ends[0] for each in extra)]]
        friction.append(np.abs(there @ values - plain))
    return largest(symmetric), largest(asymmetric), np.max(friction, axis=0)


def _of_chance(squares: _Squares, shared: list[int], left: float, steady: Array) -> tuple[Array, Array, Array]:
    """Standard deviations of both models and of the friction: half of what a force as large as what is left makes."""
    symmetric, asymmetric = list(range(_ENDS[0])), list(range(_ENDS[0], _ENDS[1]))
    left *= _OF_CHANCE**2
    one, other = (squares.spread(own + shared, left)[: len(own), : len(own)] for own in (symmetric, asymmetric))
    return np.sqrt(np.diag(one)), np.sqrt(np.diag(other)), np.sqrt(np.einsum("si,ij,sj->s", steady, one, steady))


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

    def spread(self, columns: list[int], left: float) -> Array:
        """Covariance of these by one force of such squares, of all of the command's 1, along each of them."""
        gram = self.products.sum(axis=0)[np.ix_(columns, columns)] + _TINY * np.eye(len(columns))
        units = self.scale[-1] / self.scale[columns]
        return np.asarray(left * np.linalg.inv(gram) * np.outer(units, units))

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
    """(n, 1) acceleration of a load that follows with a time constant (s), less the motor's."""
    share = -math.expm1(-1.0 / (motion.rate * lag))
    behind = signal.lfilter([share], [1.0, share - 1.0], motion.acceleration) - motion.acceleration
    return np.asarray(behind)[:, None]
