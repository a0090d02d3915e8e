"""Lost motion between two encoders without a model of the dynamics: `estimate_lost_motion`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NOTHING_KNOWN, GapStatus, Interval
from servotwin.estimation.kinematic import bootstrap as draws
from servotwin.estimation.kinematic.breaks import check_one_machine
from servotwin.estimation.kinematic.cyclic import periods
from servotwin.estimation.kinematic.local import LocalGap, local_gaps
from servotwin.estimation.kinematic.models import Model, ModelScore, chosen, compared
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.regression import (
    INERTIA,
    LAG,
    RATIO,
    Regression,
    Solution,
    columns,
    least_gap,
    products,
    regression,
    solved,
)
from servotwin.estimation.kinematic.strokes import counts_of, noise_of, play_and_side, strokes_of
from servotwin.estimation.kinematic.verdict import KinematicFit, simpler, structured, verdict
from servotwin.plant.signals import Array

_GAPS = 32  # of the coarse search, geometric from a count to the whole travel
_FINE = 17  # of each finer one
_ROUNDS = 4
_COUNTS = 4.0  # a reversal is a motion of more than so many counts, and of more than the noise
_LEAST_REVERSALS = 2
_PIECES = 10  # of a stroke on the average, in each of which noise and hunting average out
_SHIFT = 0.5  # of what the model leaves, and of the difference of two weightings: standard deviation of the gap
_SKEW = 2.0  # samples between two channels that are nothing unusual
_ENDS = (0.002, 0.998)  # quantiles of the lead: single samples beyond are noise
_CHANCE = 0.025  # on either side of a 95 % interval


class FittedCurves(NamedTuple):
    """Curves for a picture of the fit.

    Attributes
    ----------
    time, load, lead, residual : (k,) array
        Times in s, positions of the load, by how much the motor leads it (the motor's unit), and what the model leaves
        (the load's).
    gaps, rms : (g,) array
        Error of the model, the load's unit, for other gaps.
    """

    time: Array
    load: Array
    lead: Array
    residual: Array
    gaps: Array
    rms: Array


@dataclass(frozen=True)
class LostMotion:
    """Lost motion that a recording shows: the gap, and what friction winds up at a reversal, together.

    Angles and lengths are in the units of the recording. `wind_up.gap_within` says what of it is gap.

    Attributes
    ----------
    at_motor, std_motor : float
        Lost motion on the motor's side and its standard deviation, the motor's unit; a lower bound where the status
        says so; NaN where nothing is known.
    interval_motor : (float, float)
        95 %.
    ratio : float
        Load per motor; NaN where unknown.
    lag : float
        s, by which the load follows.
    status : GapStatus
        Of the lost motion: OK says nothing of the gap.
    reasons : tuple of str
    model : str
        The model that the evidence chose.
    comparisons : tuple of ModelScore
        All models out of sample, from simple to rich.
    cycles : tuple of float
        Periods of cyclic errors, the motor's unit.
    rms : float
        What the model leaves, the load's unit.
    local : tuple of LocalGap
        One for each reversal.
    curves : FittedCurves or None
    """

    at_motor: float
    std_motor: float
    interval_motor: Interval
    ratio: float
    lag: float
    status: GapStatus
    reasons: tuple[str, ...] = ()
    model: str = ""
    comparisons: tuple[ModelScore, ...] = ()
    cycles: tuple[float, ...] = ()
    rms: float = np.nan
    local: tuple[LocalGap, ...] = ()
    curves: FittedCurves | None = None

    @property
    def at_load(self) -> float:
        return self.at_motor * abs(self.ratio)

    @property
    def std_load(self) -> float:
        return self.std_motor * abs(self.ratio)

    @property
    def interval_load(self) -> Interval:
        low, high = self.interval_motor
        return (low * abs(self.ratio), high * abs(self.ratio))

    @property
    def ok(self) -> bool:
        return self.status is GapStatus.OK


def estimate_lost_motion(recording: EncoderRecording) -> LostMotion:
    """Fit load = ratio x play(motor) + offset, with lag, wind-up and cyclic errors where the log shows them.

    The model is chosen by its errors on strokes that it was not fitted to; the interval is a block bootstrap over
    cycles of motion. Two weightings of the samples, by time and by travel, have one answer where the model is right:
    where they differ, or models that the log cannot tell apart, the interval covers all of them and the status is not
    OK.

    Raises
    ------
    InvalidInput
        The motor or the load does not move, the motor never reverses, or the load jumps against it.
    """
    motor_count, load_count = counts_of(recording)
    least = _least_motion(recording.motor, motor_count)
    strokes = strokes_of(recording, least)
    _check(recording, least, strokes.reversals)
    if not _follows(recording.load, load_count, strokes.reversals):
        return _bound(recording)
    prepared = regression(recording, strokes, 0)
    coarse = _coarse(prepared, least)
    # Until the gap has been taken up once nobody knows where the load is within it.
    first = _settled(recording, 1.1 * coarse)
    if first is None:
        return _no_gap()
    prepared = regression(recording, strokes, first)
    check_one_machine(recording, prepared, coarse)
    prepared = prepared._replace(cycles=np.array(_cycles(prepared, coarse)))
    grid, tensor = _tensor(prepared, coarse, least)
    counts = np.diff(prepared.bounds, append=prepared.rows.size)
    comparisons = compared(prepared, grid, tensor, counts)
    best = chosen(comparisons[:-1])
    errors = solved(tensor.sum(axis=1), best.model.places(prepared)).squares
    found = _answer(recording, prepared, best, comparisons, least)
    rms = np.sqrt(errors / prepared.rows.size)
    return replace(found, curves=_curves(recording, prepared, best.model, found, grid, rms))


def _least_motion(values: Array, count: float) -> float:
    """Motion that is more than an encoder's counts and noise."""
    return max(_COUNTS * count, 3.0 * _COUNTS * noise_of(values), 1e-4 * float(np.ptp(values)))


def _follows(load: Array, count: float, reversals: int) -> bool:
    """True for a load whose means over tenths of a stroke move by more than its counts and noise.

    From sample to sample a machine that hunts moves as fast as noise does; its means move with the strokes.
    """
    size = max(1, load.size // (_PIECES * (reversals + 1)))
    means = load[: load.size // size * size].reshape(-1, size).mean(axis=1)
    return float(np.ptp(means)) > max(_COUNTS * count, 3.0 * _COUNTS * noise_of(load) / math.sqrt(size))


def _check(recording: EncoderRecording, least: float, reversals: int) -> None:
    unit, source = recording.motor_unit, recording.source
    reach = float(np.ptp(recording.motor))
    if not reach > 2.0 * least:
        raise InvalidInput(
            f"{source}: the motor moves by {reach:.4g} {unit} only, which its counts and its noise or hunting "
            "explain: record a motion to and fro that takes up the gap on both sides"
        )
    if reversals < _LEAST_REVERSALS:
        raise InvalidInput(
            f"{source}: the motor reverses {max(reversals, 0)} times in {np.ptp(recording.time):.4g} s: the gap shows "
            f"at reversals only; record at least {_LEAST_REVERSALS}, better ten"
        )


def _settled(recording: EncoderRecording, gap: float) -> int | None:
    """First sample by which the motor has moved by `gap`."""
    motor = recording.motor
    reach = np.maximum.accumulate(motor) - np.minimum.accumulate(motor)
    place = int(np.searchsorted(reach, gap))
    return None if place > motor.size // 2 else place


def _coarse(prepared: Regression, least: float) -> float:
    """Gap of the least sum of squares on a geometric grid, everything else free but the lag.

    Until the first contact the load rests, wherever in the gap: its motion until then counts against the gap.
    """
    reach = float(np.ptp(prepared.recording.motor))
    grid = np.concatenate([[0.0], np.geomspace(0.1 * least, 0.95 * reach, _GAPS)])
    used = Model("", (RATIO, "offset")).places(prepared)
    squares = []
    for gap in grid:
        values, side = columns(prepared, gap)
        known, resting = values[:, side != 0], values[0, side == 0]
        squares.append(float(solved(known @ known.T, used).squares) + resting.size * _variance(resting))
    return float(grid[int(np.argmin(squares))])


def _variance(values: Array) -> float:
    return float(np.var(values)) if values.size else 0.0


def _cycles(prepared: Regression, gap: float) -> tuple[float, ...]:
    values, _ = columns(prepared, gap)
    used = Model("", (RATIO, "offset", LAG)).places(prepared)
    fit = solved(values @ values.T, used)
    return periods(values[1], values[0] - fit.coefficients @ values[used])


def _tensor(prepared: Regression, coarse: float, least: float) -> tuple[Array, Array]:
    """Sums of products on a grid from 0 to twice the coarse gap."""
    grid = np.linspace(0.0, 2.0 * max(coarse, least), 2 * _FINE + 1)
    return grid, np.array([products(prepared, gap) for gap in grid])


def _fitted(prepared: Regression, model: Model, gap: float, width: float) -> tuple[float, float, draws.Spread]:
    """Gap by time and by travel, and their bootstrap, on grids that are narrowed to the spread."""
    places = model.places(prepared)
    travel, least = _travel(prepared), 1e-3 * max(gap, width)
    for _ in range(_ROUNDS):
        grid = np.linspace(max(gap - width, 0.0), gap + width, _FINE)
        by_time = np.array([products(prepared, each) for each in grid])
        by_travel = np.array([products(prepared, each, travel) for each in grid])
        spread = draws.bootstrap(grid, by_time, by_travel, places)
        gap, other = (float(least_gap(grid, solved(each.sum(axis=1), places).squares)) for each in (by_time, by_travel))
        wanted = max(5.0 * spread.std, 1.5 * abs(other - gap), least)
        if 0.4 * width <= wanted <= 1.5 * width:
            break
        width = wanted
    return gap, other, spread


def _curves(
    recording: EncoderRecording, prepared: Regression, model: Model, found: LostMotion, grid: Array, rms: Array
) -> FittedCurves:
    gap = found.at_motor if math.isfinite(found.at_motor) else 0.0
    values, _ = columns(prepared._replace(lag=found.lag), gap)
    places = model.places(prepared)
    fit = solved(values @ values.T, places)
    load, rows = values[0], prepared.rows
    return FittedCurves(
        time=recording.time[rows],
        load=load,
        lead=recording.motor[rows] - _follower(values, fit, places),
        residual=load - fit.coefficients @ values[places],
        gaps=grid,
        rms=rms,
    )


def _travel(prepared: Regression) -> Array:
    """Way of the motor from one row to the next, its counts and noise left out, relative to the mean."""
    motor = prepared.recording.motor
    side = np.zeros(motor.size, dtype=np.int8)
    smooth = play_and_side(motor, 2.0 * counts_of(prepared.recording)[0], side)[prepared.rows]
    way = np.abs(np.diff(smooth, prepend=smooth[0]))
    return way / max(float(way.mean()), np.finfo(float).tiny)


def _answer(
    recording: EncoderRecording,
    prepared: Regression,
    best: ModelScore,
    comparisons: tuple[ModelScore, ...],
    least: float,
) -> LostMotion:
    """Fit the chosen model closely and judge it."""
    if LAG in best.model.used:
        prepared = _with_lag(prepared, best)
    gap, by_travel, spread = _fitted(prepared, best.model, best.gap, max(0.5 * best.gap, least))
    values, side = columns(prepared, gap)
    places = best.model.places(prepared)
    fit = solved(values @ values.T, places)
    residual, ratio = values[0] - fit.coefficients @ values[places], float(fit.coefficients[0])
    motor_count, load_count = counts_of(recording)
    quantisation = math.hypot(motor_count, load_count / abs(ratio)) / math.sqrt(12.0)
    quantile = float(student.ppf(1.0 - _CHANCE, max(spread.units - 1, 1)))
    left = structured(prepared, residual) / abs(ratio)
    # Counts and what the model leaves are the same in every cycle: the bootstrap does not see that they shift the gap.
    half = quantile * math.hypot(spread.std, quantisation, _SHIFT * left, _SHIFT * (by_travel - gap))
    judged = verdict(
        KinematicFit(
            gap=gap,
            by_travel=by_travel,
            simpler=simpler(best, comparisons),
            spread=spread,
            half=half,
            quantisation=quantisation,
            left=left,
            better_than_none=best.rms < comparisons[-1].rms,
            lead=_lead(prepared, best),
            reach=float(np.ptp(np.quantile(recording.motor[prepared.rows] - values[0] / ratio, _ENDS))),
        ),
        recording.motor_unit,
    )
    rows, known = prepared.rows, judged.interval != NOTHING_KNOWN
    return LostMotion(
        at_motor=gap if known else math.nan,
        std_motor=half / quantile if known else math.inf,
        interval_motor=judged.interval,
        ratio=ratio,
        lag=prepared.lag,
        status=judged.status,
        reasons=judged.reasons,
        model=best.model.name,
        comparisons=comparisons,
        cycles=tuple(map(float, prepared.cycles)),
        rms=float(np.sqrt(np.mean(residual**2))),
        local=local_gaps(recording.time[rows], recording.load[rows], side, residual, gap, ratio) if known else (),
    )


def _lead(prepared: Regression, best: ModelScore) -> float:
    usual = float(np.median(np.diff(prepared.recording.time)))
    return -prepared.lag if INERTIA in best.model.used and prepared.lag < -_SKEW * usual else 0.0


def _follower(values: Array, fit: Solution, places: list[int]) -> Array:
    """The load's position in the motor's unit, without what is neither ratio nor gap, such as an offset."""
    others = fit.coefficients[1:] @ values[places[1:]]
    return (values[0] - others) / fit.coefficients[0]


def _with_lag(prepared: Regression, best: ModelScore) -> Regression:
    """The design with the lag moved from its column, which is right to first order, into the time."""
    places = best.model.places(prepared)
    lag = places.index(prepared.names.index(LAG))
    for _ in range(3):
        values, _ = columns(prepared, best.gap)
        fit = solved(values @ values.T, places)
        prepared = prepared._replace(lag=prepared.lag + float(fit.coefficients[lag] / fit.coefficients[0]))
    return prepared


def _no_gap() -> LostMotion:
    reason = (
        "the best fit is a gap as large as the motor's way: the load does not follow the motor through a gap; check "
        "that both columns are of one axis, and that the log is fast enough for its motion"
    )
    return LostMotion(np.nan, np.inf, NOTHING_KNOWN, np.nan, 0.0, GapStatus.UNIDENTIFIABLE, (reason,))


def _bound(recording: EncoderRecording) -> LostMotion:
    reach = float(np.ptp(recording.motor))
    reason = (
        f"the motor moves by {reach:.4g} {recording.motor_unit} and the load does not follow: the lost motion is larger"
    )
    return LostMotion(reach, np.inf, (reach, np.inf), np.nan, 0.0, GapStatus.LOWER_BOUND, (reason,))
