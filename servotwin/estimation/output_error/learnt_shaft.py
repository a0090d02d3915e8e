"""The machine's own numbers as a window of a free shaft tells them: stiffness and damping over mass, and mass ratio.

The fit weighs what was known of them against the window's noise. Errors of rounding are no such noise: they do not
average out within a window, and they repeat with the motion. So the window's own information is taken out of the fit,
weakened by them, and joined to what was known anew; and it counts only in those combinations of the numbers that it
tells much better than they were known. Many windows alike tell no more than one. Slow motion that the fit leaves
weakens it too: a machine of another kind has no numbers of this one's.

The transmission's ratio is not learnt: a load that friction holds rests anywhere on its wind-up, so that windows of a
ball screw read ratios that were up to 0.2 % off, and wrongly by 18 of their standard deviations.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.estimate import MachineReading
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.mismatches import moved_by_growth
from servotwin.estimation.output_error.models import LEARNT, ShaftModel
from servotwin.estimation.output_error.rounding import per_count
from servotwin.estimation.output_error.search import also_from
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.output_error.unexplained import left_open, slow_error
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array

# Standard deviations of what the model leaves out, in the order of `FACTORS`: a window tells none of them better.
_UNMODELLED = (1e-2, 2e-2, math.inf, 5e-3)
# The same of the shaft's damping, of the critical one: a motor that is not straight between samples, and a filter of
# its noise, damp. On a shaft of 0.007 a fit was 13 % off, and known to 3 % by itself.
_DAMPED = 2e-3
# The noise's spectrum and the contacts come from the same window: tails are longer than normal.
_DOUBT = 2.0
_TELLS = 0.5  # of the standard deviation that was known: a window counts where no more is left with it
_BETTER = 0.99  # times a usual spread: a smaller one was learnt
_TOGETHER = 5.0  # standard deviations between a window's numbers and those that were known
_LEAST_INFORMATION = 1e-2  # of what was known: where a window tells less, it shows nothing
_EVENLY = 1.0 / math.sqrt(12.0)  # standard deviation of a place anywhere in an interval, of its length
_SINGULAR = 1e-12
_NOTHING = 1e3  # standard deviation of a logarithm of which nothing is known
_MUCH_LESS = 0.5  # of the errors with what was learnt: another shaft that leaves no more than this is the machine's
_DAMPING = LEARNT["shaft damping"]


def adapted_shaft(axis: Axis, factors: Array) -> Axis:
    """An axis with logarithms (4,) of `FACTORS` over its own numbers: stiffness and damping are those of the shaft."""
    k, c, pitch, ratio = np.exp(factors).tolist()
    screw, load = axis.transmission, axis.load
    shaft = replace(screw, p=pitch * screw.p, k_d=k * screw.k_d, c_d=c * screw.c_d)
    return axis.replace(transmission=shaft, load=replace(load, m=(*load.m[:-1], ratio * load.m[-1])))


def is_learnt(machine: FactorPrior, settings: OutputErrorSettings) -> bool:
    """True where windows have told stiffness or damping of a shaft: they are known better than they are usually."""
    usual = np.array([settings.stiffness, settings.damping])
    return bool(np.any(np.sqrt(np.diag(machine.covariance)[:2]) < _BETTER * usual))


def beside_what_was_learnt(found: Search, freed: Search | None) -> tuple[Search, tuple[str, ...]]:
    """The fit, begun again where another shaft than the learnt one fits, and the sentence if that leaves far less.

    The search ends a few per cent from what was learnt. There a shaft of another machine fits best in a wrong gap, and
    leaves slow motion; and so close the search may miss the right minimum of the learnt one.
    """
    if freed is None:
        return found, ()
    found = also_from(found, freed.best.values)
    less = float(np.linalg.norm(freed.best.raw) / np.linalg.norm(found.best.raw))
    if less > _MUCH_LESS:
        return found, ()
    return found, (f"another shaft than the one that was learnt leaves {100.0 * less:.2g} % of the errors only",)


class ShaftReading(NamedTuple):
    """Numbers of the machine after a window of a free shaft.

    Attributes
    ----------
    machine : MachineReading
        What was known before included; equal to it where the window tells nothing much better.
    away : float
        Standard deviations between the window's own numbers and those that were known, of all together.
    """

    machine: MachineReading
    away: float

    @property
    def contradicts(self) -> bool:
        """True where the window's machine is not the one that was known."""
        return self.away > _TOGETHER

    @property
    def sentence(self) -> str:
        """Reason of a window that contradicts."""
        return (
            f"stiffness, damping and masses of the shaft are {self.away:.2g} standard deviations from what is known of "
            f"them, and {_TOGETHER:g} are allowed"
        )


def shaft_reading(found: Search, machine: FactorPrior, calibration: float, gap_rate: float = 0.0) -> ShaftReading:
    """Join what a window tells of the machine to what was known.

    Parameters
    ----------
    found : Search
        Fit of the window with a `ShaftModel` whose learnt numbers are those of `machine`.
    machine : FactorPrior
    calibration : float
        Reported over computed standard deviation.
    gap_rate : float
        Growth of the total gap at the motor, rad/s, as likely as a standard deviation.
    """
    model = found.problem.model
    assert isinstance(model, ShaftModel)
    which, places = (np.array(each) for each in zip(*model.places, strict=True))
    known = machine.covariance[np.ix_(which, which)]
    unmodelled = np.hypot(_unmodelled(model.axis)[which], _by_slow_error(found, places))
    grown = moved_by_growth(found, 0.5 * model.axis.p * gap_rate, places.tolist())
    unmodelled = np.hypot(unmodelled, grown)
    told, score = _own_information(found, places, calibration, unmodelled)
    # In units of what was known the prior is white.
    lower = np.linalg.cholesky(known)
    gains, axes = np.linalg.eigh(lower.T @ told @ lower)
    shown = axes.T @ (lower.T @ score)
    # A direction of information g has the window's own number, shown / g, with the variance 1 / g + 1 about 0.
    informed = gains > _LEAST_INFORMATION
    away = math.sqrt(float(np.sum(shown[informed] ** 2 / (gains[informed] * (1.0 + gains[informed])))))
    counts = gains > 1.0 / _TELLS**2 - 1.0
    gains, shown = gains * counts, shown * counts
    back = lower @ axes
    mean, covariance = machine.mean.copy(), machine.covariance.copy()
    mean[which] += back @ (shown / (1.0 + gains))
    covariance[np.ix_(which, which)] = (back / (1.0 + gains)) @ back.T
    return ShaftReading(FactorPrior(mean, covariance, machine.softness).reading, away)


def _unmodelled(axis: Axis) -> Array:
    """(4,) standard deviations of what the model leaves out, of the logarithms of `FACTORS`."""
    spreads, shaft = np.array(_UNMODELLED), axis.transmission
    if shaft.c_d > 0.0:
        critical = 2.0 * math.sqrt(shaft.k_d * axis.load.m[0])
        spreads[_DAMPING] = math.hypot(spreads[_DAMPING], _DAMPED * critical / shaft.c_d)
    return spreads


def _by_slow_error(found: Search, places: NDArray[np.intp]) -> Array:
    """(f,) standard deviations of unknowns at places (f,) by slow motion that the fit leaves: another machine's."""
    error = slow_error(found)
    if error == 0.0:
        return np.zeros(places.size)
    return np.minimum(left_open(found, error, places.tolist()), _NOTHING)


def _own_information(
    found: Search, places: NDArray[np.intp], calibration: float, unmodelled: Array
) -> tuple[Array, Array]:
    """Information (f, f) of a window alone on unknowns at places (f,), and the same times their values (f,) in it.

    The fit's information on them, the freedom of the others taken out, is that of white noise. Rounding and what the
    model leaves out, with standard deviations `unmodelled` (f,), weaken it.
    """
    fit, data = found.best, found.best.raw.size
    own = _without_others(found, places)
    size = np.linalg.norm(own, axis=1)
    size[size == 0.0] = 1.0
    own /= size[:, None]
    plain = own @ own.T
    score = plain @ (size * fit.values[places]) - own @ fit.residual
    sums = _EVENLY * found.problem.count * per_count(found, own[:, :data])
    noise = _DOUBT**2 * (calibration**2 * fit.variance() * plain + sums @ sums.T)
    weights = plain @ np.linalg.pinv(noise, rcond=_SINGULAR, hermitian=True)
    told, shown = size[:, None] * (weights @ plain) * size, size * (weights @ score)
    weaker = np.linalg.solve(told + np.diag(unmodelled**-2.0), np.column_stack([told, shown]))
    return told - told @ weaker[:, :-1], shown - told @ weaker[:, -1]


def _without_others(found: Search, places: NDArray[np.intp]) -> Array:
    """(f, M) derivatives of the residual by unknowns at places (f,), without their prior and what others could do."""
    rows, root = found.best.rows, found.problem.model.root
    seen = found.free & (np.linalg.norm(rows, axis=1) > 0.0)
    seen[places] = False
    own, others = rows[places].copy(), rows[seen]
    own[:, -len(root) :] = 0.0
    others = others / np.linalg.norm(others, axis=1)[:, None]
    return np.asarray(own - np.linalg.lstsq(others.T, own.T, rcond=_SINGULAR)[0].T @ others)
