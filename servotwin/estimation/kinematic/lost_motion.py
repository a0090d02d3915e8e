"""Lost motion between two encoders without a model of the dynamics: `estimate_lost_motion`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NOTHING_KNOWN, GapStatus, Interval
from servotwin.estimation.kinematic.breaks import check_not_joined, check_one_machine
from servotwin.estimation.kinematic.close_fit import fitted_closely, half_width
from servotwin.estimation.kinematic.curves import FittedCurves, fitted_curves
from servotwin.estimation.kinematic.local import LocalGap, drift_of, local_gaps
from servotwin.estimation.kinematic.models import ModelScore, chosen, undecided
from servotwin.estimation.kinematic.one_speed import lag_of_gap
from servotwin.estimation.kinematic.pauses import behind_pauses
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.regression import (
    INERTIA,
    LAG,
    Regression,
    regression,
)
from servotwin.estimation.kinematic.search import (
    coarse_gap,
    compared_models,
    compared_with_fitted_lag,
    cyclic_periods,
    lag_left,
    with_lag,
)
from servotwin.estimation.kinematic.strokes import counts_of, noise_of, strokes_of
from servotwin.estimation.kinematic.verdict import KinematicFit, simpler, verdict
from servotwin.plant.signals import Array

_COUNTS = 4.0  # a reversal is a motion of more than so many counts, and of more than the noise
_LEAST_REVERSALS = 2
_JUMPS, _NEAR_BY = 5.0, 0.01  # times the step to the next sample but one, and of the range: two motions by turns
_PIECES = 10  # of a stroke on the average, in each of which noise and hunting average out
_SKEW = 2.0  # samples between two channels that are nothing unusual
_ENDS = (0.002, 0.998)  # quantiles of the lead: single samples beyond are noise
_EXCHANGED = (
    "the motor's column follows the load's through a gap, and not the load's the motor's: --motor and --load are "
    "exchanged, or the load overshoots at every reversal"
)


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
    load_spread : float
        Half width of the interval at the load over `ratio` times that at the motor: the ratio is estimated too.
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
    load_spread: float
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
        return self.std_motor * abs(self.ratio) * self.load_spread

    @property
    def interval_load(self) -> Interval:
        return self.seen_at_load(self.at_motor, self.interval_motor)

    def seen_at_load(self, gap: float, interval: Interval) -> Interval:
        """An interval about a gap, the motor's unit, in the load's unit."""
        if interval == NOTHING_KNOWN or math.isnan(gap):
            return (interval[0] * abs(self.ratio), interval[1] * abs(self.ratio))
        low, high = (abs(self.ratio) * (gap + self.load_spread * (end - gap)) for end in interval)
        return (max(low, 0.0), high)

    def with_load_times(self, scale: float) -> LostMotion:
        """The same in a unit of the load that is `scale` times smaller."""
        return replace(
            self,
            ratio=scale * self.ratio,
            rms=scale * self.rms,
            comparisons=tuple(
                each._replace(rms=scale * each.rms, squares=scale**2 * each.squares) for each in self.comparisons
            ),
            local=tuple(each._replace(position=scale * each.position) for each in self.local),
            curves=None if self.curves is None else self.curves.with_load_times(scale),
        )

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
    found = _estimated(recording)
    if found.interval_motor == NOTHING_KNOWN and _exchanged(recording):
        return replace(found, reasons=(_EXCHANGED, *found.reasons))
    return found


def _exchanged(recording: EncoderRecording) -> bool:
    """True where a lost motion shows with motor and load exchanged."""
    other = replace(
        recording,
        motor=recording.load,
        load=recording.motor,
        motor_count=recording.load_count,
        load_count=recording.motor_count,
    )
    try:
        return _estimated(other).ok
    except InvalidInput:
        return False


def _estimated(recording: EncoderRecording) -> LostMotion:
    motor_count, load_count = counts_of(recording)
    least = _least_motion(recording.motor, motor_count)
    strokes = strokes_of(recording, least)
    _check(recording, least, strokes.reversals)
    check_not_joined(recording)
    if not _follows(recording.load, load_count, strokes.reversals):
        return _bound(recording)
    prepared = regression(recording, strokes, 0)
    coarse = coarse_gap(prepared, least)
    # Until the gap has been taken up once nobody knows where the load is within it.
    first = _first_moved(recording, 1.1 * coarse)
    if first is None:
        return _no_gap()
    prepared = regression(recording, strokes, first, ~behind_pauses(recording, coarse))
    check_one_machine(recording, prepared, coarse)
    prepared = prepared._replace(cycles=np.array(cyclic_periods(prepared, coarse)))
    comparisons = compared_models(prepared, coarse, least)
    best = chosen(comparisons[:-1])
    if INERTIA in best.model.used:
        comparisons = compared_with_fitted_lag(prepared, comparisons, coarse, least)
        best = chosen(comparisons[:-1])
    found = _answer(recording, prepared, best, comparisons, least)
    shown = found.at_motor if math.isfinite(found.at_motor) else 0.0
    curves = fitted_curves(prepared._replace(lag=found.lag), best.model, shown, found.interval_motor)
    drift = "" if found.ok else drift_of(found.local, recording.motor_unit)
    return replace(found, curves=curves, reasons=(drift, *found.reasons) if drift else found.reasons)


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
    for part, values in (("motor", recording.motor), ("load", recording.load)):
        if _alternates(values):
            raise InvalidInput(
                f"{source}: the {part}'s position jumps to and fro from sample to sample: two machines by turns in one "
                "log, give each by itself; or one that hunts at half the sample rate, record it faster"
            )
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


def _alternates(values: Array) -> bool:
    """True where every second sample belongs to another motion: far from its neighbours, near the next but one."""
    near, far = np.diff(values), values[2:] - values[:-2]
    return float(np.median(np.abs(near))) > _JUMPS * max(
        float(np.median(np.abs(far))), _NEAR_BY * float(np.ptp(values))
    )


def _first_moved(recording: EncoderRecording, gap: float) -> int | None:
    """First sample by which the motor has moved by `gap`."""
    motor = recording.motor
    reach = np.maximum.accumulate(motor) - np.minimum.accumulate(motor)
    place = int(np.searchsorted(reach, gap))
    return None if place > motor.size // 2 else place


def _answer(
    recording: EncoderRecording,
    prepared: Regression,
    best: ModelScore,
    comparisons: tuple[ModelScore, ...],
    least: float,
) -> LostMotion:
    """Fit the chosen model closely and judge it."""
    if LAG in best.model.used:
        prepared = with_lag(prepared, best)
    close = fitted_closely(prepared, best, least)
    width = half_width(recording, prepared, close)
    gap, ratio, residual, rows = close.gap, close.ratio, close.residual, prepared.rows
    lag = prepared.lag + lag_left(prepared, close.fit, close.places)
    judged = verdict(
        KinematicFit(
            gap=gap,
            by_travel=close.by_travel,
            simpler=simpler(best, comparisons),
            spread=close.spread,
            half=width.at_motor,
            quantisation=width.quantisation,
            left=width.left,
            rms=float(np.sqrt(np.mean(residual**2))) / abs(ratio),
            of_none=(best.rms / comparisons[-1].rms) ** 2 if comparisons[-1].rms else 1.0,
            accelerated=INERTIA in best.model.used,
            lead=_lead(prepared),
            richer=tuple(each.gap for each in undecided(best, comparisons[:-1])),
            as_lag=lag_of_gap(prepared, close, lag),
            reach=float(np.ptp(np.quantile(recording.motor[rows] - close.values[0] / ratio, _ENDS))),
        ),
        recording.motor_unit,
    )
    half, known = width.at_motor, judged.interval != NOTHING_KNOWN
    if judged.status is GapStatus.OK:
        half = max(half, 0.5 * (judged.interval[1] - judged.interval[0]))
    return LostMotion(
        at_motor=gap if known else math.nan,
        std_motor=half / width.quantile if known else math.inf,
        interval_motor=judged.interval,
        ratio=ratio,
        load_spread=max(width.at_load / (half * abs(ratio)), 1.0) if half else 1.0,
        lag=lag,
        status=judged.status,
        reasons=judged.reasons,
        model=best.model.name,
        comparisons=comparisons,
        cycles=tuple(map(float, prepared.cycles)),
        rms=float(np.sqrt(np.mean(residual**2))),
        local=local_gaps(recording.time[rows], recording.load[rows], close.side, residual, gap, ratio) if known else (),
    )


def _lead(prepared: Regression) -> float:
    usual = float(np.median(np.diff(prepared.recording.time)))
    return -prepared.lag if prepared.lag < -_SKEW * usual else 0.0


def _no_gap() -> LostMotion:
    reason = (
        "the best fit is a gap as large as the motor's way: the load does not follow the motor through a gap; check "
        "that both columns are of one axis, and that the log is fast enough for its motion"
    )
    return LostMotion(np.nan, np.inf, NOTHING_KNOWN, np.nan, 1.0, 0.0, GapStatus.UNIDENTIFIABLE, (reason,))


def _bound(recording: EncoderRecording) -> LostMotion:
    reach = float(np.ptp(recording.motor))
    reason = (
        f"the motor moves by {reach:.4g} {recording.motor_unit} and the load does not follow: the lost "
        "motion is larger, or the load's column is of something else"
    )
    return LostMotion(reach, np.inf, (reach, np.inf), np.nan, 1.0, 0.0, GapStatus.LOWER_BOUND, (reason,))
