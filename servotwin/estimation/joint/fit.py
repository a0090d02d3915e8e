"""The joint fit of one window: prior knowledge, bounded Levenberg-Marquardt, every minimum, noise of the residual."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.errors import InvalidInput
from servotwin.estimation.core.decimation import Decimation, decimation
from servotwin.estimation.core.least_squares import least_squares, orthonormal, spread
from servotwin.estimation.core.whitening import Autoregression, recursion, with_noise_restored
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.joint.model import JUMP, MOTOR_START, JointModel, Reduce
from servotwin.estimation.joint.settings import SPREADS, JointSettings
from servotwin.estimation.learning.trend import Prior
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

Flags: TypeAlias = NDArray[np.bool_]
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e-10, 1e9
_SINGULAR = 1e-8  # of a derivative's length: what the others leave of it below this is nothing
_LEAST_VOLTAGE = 1e-6  # V, the servo's own
_SMALL_GAIN = 1e-6  # of the cost: a step that gains less is the last; whitened, far below one standard deviation


@dataclass(frozen=True, eq=False)
class ParameterPrior:
    """Bounds and prior of each parameter, (P,) each, in the model's order; spread inf: nothing is known."""

    lowest: Array
    highest: Array
    mean: Array
    spread: Array

    def without_prior(self, free: Flags) -> ParameterPrior:
        """The bounds alone, and parameters that are not `free` (P,) fixed at their means: for a first search."""
        lowest, highest = np.where(free, self.lowest, self.mean), np.where(free, self.highest, self.mean)
        return ParameterPrior(lowest, highest, self.mean, np.full_like(self.spread, np.inf))


@dataclass(frozen=True, eq=False)
class FitPoint:
    """A point with its residual (m + P,) and derivatives (P, m + P); the prior counts as P more samples."""

    point: Array
    residual: Array
    jacobian: Array
    evaluations: int = 1
    converged: bool = False

    @property
    def cost(self) -> float:
        """Squared length of the residual."""
        return float(self.residual @ self.residual)

    def deviations(self) -> Array:
        """(P,) standard deviations for residuals of variance 1, all else unknown; inf where nothing is known."""
        rows = self.jacobian
        return np.array([spread(row, np.delete(rows, i, axis=0), _SINGULAR) for i, row in enumerate(rows)])

    def covariance(self) -> Array:
        """(P, P) covariance for residuals of variance 1; inf on the diagonal of what is not known."""
        scale = np.linalg.norm(self.jacobian, axis=1)
        scale[scale == 0.0] = 1.0
        scaled = self.jacobian / scale[:, None]
        covariance = np.linalg.pinv(scaled @ scaled.T, hermitian=True) / np.outer(scale, scale)
        np.fill_diagonal(covariance, self.deviations() ** 2)
        return covariance

    def step(self) -> Array:
        """(P,) Gauss-Newton step."""
        scale = np.linalg.norm(self.jacobian, axis=1)
        scale[scale == 0.0] = 1.0
        scaled = self.jacobian / scale[:, None]
        return -np.linalg.pinv(scaled @ scaled.T, hermitian=True) @ (scaled @ self.residual) / scale


Evaluate: TypeAlias = Callable[[Array], FitPoint]


def _evaluate_at(model: JointModel, point: Array, known: ParameterPrior, reduce: Reduce) -> FitPoint:
    """Evaluate residual and derivatives at a point."""
    slopes = model.slopes(dict(zip(model.names, point.tolist(), strict=True)), reduce)
    prior = (point - known.mean) / known.spread
    jacobian = np.hstack([slopes.jacobian, np.diag(1.0 / known.spread)])
    return FitPoint(point, np.concatenate([slopes.residual, prior]), jacobian)


def descend(evaluate: Evaluate, start: Array, known: ParameterPrior, tolerance: Array, steps: int = 40) -> FitPoint:
    """Descend from a start (P,) to the nearest minimum; it ends when a step is below `tolerance` (P,) in each."""
    here, damping = evaluate(np.clip(start, known.lowest, known.highest)), _FIRST_DAMPING
    for count in range(2, steps):
        trial = np.clip(here.point + _step(here, known, damping), known.lowest, known.highest)
        if np.all(np.abs(trial - here.point) <= tolerance):
            return replace(here, evaluations=count, converged=True)
        ahead = evaluate(trial)
        if ahead.cost < here.cost:
            gained, here, damping = here.cost - ahead.cost, ahead, max(0.1 * damping, _LEAST_DAMPING)
            if gained <= _SMALL_GAIN * ahead.cost:
                return replace(here, evaluations=count, converged=True)
        else:
            damping *= 8.0
            if damping > _LARGEST_DAMPING:
                return replace(here, evaluations=count, converged=True)
    return replace(here, evaluations=steps)


def _step(here: FitPoint, known: ParameterPrior, damping: float) -> Array:
    """The damped Gauss-Newton step of the parameters that are not held by their bounds."""
    downhill = -here.jacobian @ here.residual
    # A parameter at its bound whose step would leave it is fixed for this step; otherwise it would pull the others
    # along.
    blocked = ((here.point <= known.lowest) & (downhill < 0.0)) | ((here.point >= known.highest) & (downhill > 0.0))
    # Scaled columns: the parameters have units of their own, and the damping must treat them alike.
    size = np.linalg.norm(here.jacobian, axis=1)
    free = np.flatnonzero(~blocked & (size > 0.0))
    step = np.zeros_like(here.point)
    scaled = here.jacobian[free] / size[free, None]
    damped = scaled @ scaled.T + damping * np.eye(free.size)
    step[free] = np.linalg.solve(damped, downhill[free] / size[free]) / size[free]
    return step


def scan(model: JointModel, values: Mapping[str, float], gaps: Array, keep: int, reduce: Reduce) -> list[Array]:
    """The `keep` best starts (P,) of a grid of gaps (rad) and places, the other parameters as in `values`."""
    grid = [{**values, "gap": float(gap), "place": place} for gap in gaps for place in (-1.0, 0.0, 1.0)]
    best = np.argsort(model.costs(values, grid, reduce), kind="stable")[:keep]
    return [np.array([grid[i][name] for name in model.names]) for i in best]


AnyPrior = float | GapEstimate | Prior | None


def _prior_of(model: JointModel, prior: AnyPrior, settings: JointSettings) -> ParameterPrior:
    """Bounds and priors of the model's parameters."""
    rows = {"gap": (0.0, settings.largest_gap_rad, 0.0, math.inf), "place": (-1.0, 1.0, 0.0, math.inf)}
    rows["delay"] = (-settings.delay_limit, settings.delay_limit, 0.0, math.inf)
    rows.update({name: (-4.0 * s, 4.0 * s, 0.0, s) for name, s in ((n, settings.spread(n)) for n in SPREADS)})
    if isinstance(prior, Prior):
        rows["gap"] = (0.0, settings.largest_gap_rad, prior.gap, max(prior.gap_std, settings.model_error_rad))
    if model.window.voltage is not None and model.window.theta_m is None:
        size = max(_LEAST_VOLTAGE * scales(model.servo).voltage, float(np.abs(model.window.voltage).max()))
        speed, current = size / model.servo.k_B, size / model.servo.R
        rows["speed0"] = (-4.0 * speed, 4.0 * speed, float(model.window.voltage[0]) / model.servo.k_B, speed)
        rows["current0"] = (-4.0 * current, 4.0 * current, 0.0, current)
        for index in model.jumps:
            area = 0.5 * abs(float(np.diff(model.window.voltage)[index])) / model.rate
            # The time of the jump is anywhere in the interval: a uniform distribution, whose deviation is the half
            # width over sqrt(3).
            rows[f"{JUMP}{index}"] = (-area, area, 0.0, area / math.sqrt(3.0))
    return ParameterPrior(*(np.array(column) for column in zip(*(rows[name] for name in model.names), strict=True)))


def start_of(model: JointModel, prior: AnyPrior) -> Array:
    """(P,) start of the search; the gap and the place are scanned besides."""
    values = dict.fromkeys(model.names, 0.0)
    values["gap"] = gap_of(prior) or 0.0
    if "speed0" in values and model.window.voltage is not None:
        values["speed0"] = float(model.window.voltage[0]) / model.servo.k_B
    return np.array(list(values.values()))


def gap_of(prior: AnyPrior) -> float | None:
    """Gap (rad) of a prior; None without one."""
    gap = prior if prior is None or isinstance(prior, int | float) else prior.gap
    if isinstance(prior, GapEstimate) and not prior.ok:
        return None
    if gap is not None and not 0.0 <= gap < math.inf:
        raise InvalidInput(f"prior gap = {gap!r} rad: must be finite and at least 0")
    return gap


def tolerance_of(model: JointModel) -> Array:
    """(P,) steps small enough to end a search: 3e-5 deg for the gap, 1e-6 for logarithms; the servo's own units."""
    second, _, volt = scales(model.servo)
    steps = {"gap": 5e-7, "place": 1e-2, "delay": 1e-8 * second, "current0": 1e-4}
    steps.update({"gap rate": 1e-6 / second, "speed0": 1e-3 / second})
    steps.update({f"{JUMP}{index}": 1e-8 * second * volt for index in model.jumps})
    return np.array([steps.get(name, 1e-6) for name in model.names])


_LEAST = 1e-300


def estimate_noise(
    model: JointModel, minimum: FitPoint, reduce: Decimation, before: Autoregression, order: int, restore: bool
) -> Autoregression:
    """Estimate the noise from the residual of a fit that was made with a first idea of it.

    With `restore`, the noise that the fit may have taken away is restored.
    """
    table = _without_motor_start(
        model, model.table(dict(zip(model.names, minimum.point.tolist(), strict=True)), reduce.rows)
    )
    rows = before.whiten(table)
    solved = least_squares(rows[1:], rows[0])
    residual = table[0] - solved.coefficients @ table[1:]
    if not np.any(residual):
        return Autoregression.white(1.0)
    if not restore:
        return likeliest(residual[None], table, order)
    rest = rows[0] - solved.coefficients @ rows[1:]
    scale = math.sqrt(float(rest @ rest) / max(1, rest.size - len(solved.root)))
    return likeliest(with_noise_restored(residual, table[1:], solved.root, scale), table, order)


def likeliest(series: Array, table: Array, most: int) -> Autoregression:
    """The autoregression by Burg's method of equally likely series (s, n), its order the likeliest for what was fitted.

    The likelihood is the restricted one, that of the data `table[0]` off what the columns `table[1:]` can explain. The
    plain one prefers orders that model the hole which the fit itself left in the noise, and spreads come out too small.
    """
    predictors, power = recursion(series, min(most, series.shape[1] // 4))
    spreads = np.sqrt(np.maximum(power, _LEAST))
    orders = [Autoregression(predictors[:n, :n].copy(), spreads[:n]) for n in range(1, power.size + 1)]
    rows = np.vstack([table[:1], orthonormal(table[1:])])
    return min(orders, key=lambda noise: _restricted(noise, rows))


def _restricted(noise: Autoregression, rows: Array) -> float:
    """Minus twice the restricted log-likelihood of rows[0] off rows[1:], and the corrected Akaike penalty.

    The level of the noise is free.
    """
    size, white = rows.shape[1], noise.whiten(rows)
    residual = white[0] - least_squares(white[1:], white[0]).coefficients @ white[1:]
    degrees, count = max(1, size - len(white) + 1), noise.order + 1
    level = degrees * math.log(max(float(residual @ residual) / degrees, _LEAST))
    spreads = noise.spread[np.minimum(np.arange(size), noise.order)]
    information = float(np.linalg.slogdet(white[1:] @ white[1:].T)[1])
    likelihood = 2.0 * float(np.log(spreads).sum()) + level + information
    return likelihood + 2.0 * count * size / max(1, size - count - 1)


def _without_motor_start(model: JointModel, table: Array) -> Array:
    """The rows without those of the motor's start, which is over in milliseconds and takes little away."""
    first = len(table) - len(model.names)
    return np.delete(table, [first + i for i, name in enumerate(model.names) if name in MOTOR_START], axis=0)


RIVAL, APART = 12.0, math.radians(0.3)  # a rival's cost is as near; minima closer than this (rad) are one
_GRID = np.radians([0.0, 1.0, 2.0, 4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0, 50.0])
_WIDER = 1.25  # factor between wider gaps, where the largest is beyond the paper's
_STARTS = 3
_DRAWS = 16  # of rounding: standard deviations are known to a fifth
# Rate after decimation, in the servo's own seconds: at a lower one the noise model fits itself to the residual.
_SAMPLES_HZ = 250.0


@dataclass(frozen=True, eq=False)
class WindowMinima:
    """Minima of one window's cost, in its own noise.

    Attributes
    ----------
    model : JointModel
    known : ParameterPrior
    reduce : Decimation
    noise : Autoregression
    minima : tuple of FitPoint
        The lowest first; whitened.
    evaluations : int
    blocked : str
        Reason for which the window was not searched; empty if it was.
    """

    model: JointModel
    known: ParameterPrior
    reduce: Decimation
    noise: Autoregression
    minima: tuple[FitPoint, ...]
    evaluations: int
    blocked: str = ""

    @property
    def best(self) -> FitPoint:
        """The lowest minimum."""
        return self.minima[0]

    def evaluated(self, known: ParameterPrior) -> Evaluate:
        """Whitened residual and derivatives as a function of the point."""
        return lambda point: _evaluate_at(self.model, point, known, self.whitened)

    def shaken(self, random: np.random.Generator) -> WindowMinima:
        """The window with other errors of rounding."""
        return replace(self, model=self.model.shaken(random))

    def whitened(self, rows: Array) -> Array:
        """(k, m) reduced and whitened rows (k, n)."""
        return self.noise.whiten(self.reduce.rows(rows))


def spread_by_rounding(servo: Servo, best: FitPoint, shaken: Callable[[np.random.Generator], FitPoint]) -> Array:
    """(P, P) covariance of a minimum by the rounding of encoders with known counts; 0 without any.

    A step from the minimum in windows whose errors of rounding are others, which `shaken` draws and evaluates: also in
    these the errors bend the derivatives, so that the covariance contains the bias that rounding makes.
    """
    if not (servo.encoder_resolution or servo.position_resolution):
        return np.zeros((best.point.size, best.point.size))
    random, own = np.random.default_rng(0), best.step()
    moves = np.array([shaken(random).step() - own for _ in range(_DRAWS)])
    return np.asarray(moves.T @ moves / _DRAWS)


def unsearched(model: JointModel, prior: AnyPrior, settings: JointSettings, blocked: str = "") -> WindowMinima:
    """Make the fit from which a search begins."""
    known, noise = _prior_of(model, prior, settings), Autoregression.white(1.0)
    reduce = decimation(decimation_factor(model.servo, model.rate))
    here = _evaluate_at(model, start_of(model, prior), known, reduce.rows)
    return WindowMinima(model, known, reduce, noise, (here,), here.evaluations, blocked)


def searched(model: JointModel, prior: AnyPrior, settings: JointSettings) -> WindowMinima:
    """Search the minima of a window's cost; noise and parameters are estimated in turn."""
    fit = _unwhitened(unsearched(model, prior, settings), settings)
    for number in range(settings.whitenings):
        restore = number == settings.whitenings - 1
        noise = estimate_noise(model, fit.best, fit.reduce, fit.noise, settings.noise_order, restore)
        fit = _descended(replace(fit, noise=noise), fit.known, fit.minima)
    return fit


def _unwhitened(fit: WindowMinima, settings: JointSettings) -> WindowMinima:
    """Search in white noise, first with the motor's start and the jumps fixed: no scan could sort them out.

    Then all of them are free: the residual of a fixed jump would be taken for noise, a hundred times too much.
    """
    model, fine = fit.model, np.array([name in MOTOR_START or name.startswith(JUMP) for name in fit.model.names])
    values = dict(zip(model.names, fit.best.point.tolist(), strict=True))
    gaps = np.unique(np.append(_grid(settings.largest_gap_rad), values["gap"]))
    bounds, tolerance = fit.known.without_prior(~fine), 30.0 * tolerance_of(model)
    starts = scan(model, values, gaps, _STARTS, fit.reduce.rows)
    coarse = [descend(fit.evaluated(bounds), begin, bounds, tolerance) for begin in starts]
    searched_fit = replace(fit, minima=_distinct(coarse), evaluations=sum(one.evaluations for one in coarse))
    return (
        _descended(searched_fit, fit.known.without_prior(fine | True), searched_fit.minima)
        if fine.any()
        else searched_fit
    )


def _grid(largest: float) -> Array:
    """Gaps (g,) of the scan, rad, up to the largest."""
    more = max(0, math.floor(math.log(largest / _GRID[-1]) / math.log(_WIDER))) if largest > 0.0 else 0
    return np.append(_GRID[largest >= _GRID], _GRID[-1] * _WIDER ** np.arange(1, more + 1))


def _descended(fit: WindowMinima, known: ParameterPrior, starts: Sequence[FitPoint]) -> WindowMinima:
    """Descend from each of the starts to its minimum; keep those near the lowest."""
    tolerance = tolerance_of(fit.model)
    ends = [descend(fit.evaluated(known), one.point, known, tolerance) for one in starts]
    near = min(one.cost for one in ends) + 100.0 * RIVAL
    minima = tuple(one for one in _distinct(ends) if one.cost <= near)
    return replace(fit, minima=minima, evaluations=fit.evaluations + sum(one.evaluations for one in ends))


def decimation_factor(servo: Servo, rate: float) -> int:
    """Factor by which a window sampled at `rate` (Hz) is decimated for the fit."""
    return max(1, int(rate * scales(servo).time / _SAMPLES_HZ + 1e-9))


def _distinct(minima: Sequence[FitPoint]) -> tuple[FitPoint, ...]:
    """The lowest of each group with the same gap, the lowest of all first."""
    different: list[FitPoint] = []
    for one in sorted(minima, key=lambda one: one.cost):
        if all(abs(one.point[0] - other.point[0]) > APART for other in different):
            different.append(one)
    return tuple(different)
