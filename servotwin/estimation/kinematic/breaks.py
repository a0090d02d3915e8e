"""Breaks in a recording: a slipped encoder, or two machines in one log."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.pauses import pauses_of
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.regression import INERTIA, LAG, LOAD, OFFSET, RATIO, Regression, columns, solved
from servotwin.plant.signals import Array

_EXPLAINED = 0.8  # of what the model leaves, by one step
_STEP = 0.5  # of the gap, at least
_RATIO = 0.03  # between the halves of a recording
_SURE = 5.0  # standard deviations of that
_BLOCKS = 16  # of the recording, of which each is left out once
_TRAVEL = 10.0  # gaps, from which on the ratio is known


_CHOSEN, _MOST = 20_000, (0.01, 0.99)  # samples of a part, and quantiles of what a line leaves
_PART = 100  # samples on either side of a join
_JOINS = 20  # looked at: the longest pauses and largest jumps
_LINE = 0.95  # correlation of load and motor in a part that shows their ratio
_OFF = 1.5  # spreads of both parts
_OTHER = 0.1  # of the ratio, and so many times the spread over the way of the shorter part


class _Line(NamedTuple):
    """A line through the load over the motor: slope, load at a given motor position, and spread about it."""

    slope: float
    load: float
    spread: float
    straight: bool


def check_not_joined(recording: EncoderRecording) -> None:
    """Refuse a recording whose load goes on elsewhere, or by another ratio, behind a pause or a jump.

    Such a break hides every gap: it has to be found before one is searched for.

    Raises
    ------
    InvalidInput
    """
    time, motor, load = recording.time, recording.motor, recording.load
    joins = [row for row in pauses_of(time, motor, load) if _PART <= row <= time.size - _PART]
    joins.sort(key=lambda row: -abs(load[row] - load[row - 1]))
    for row in joins[:_JOINS]:
        before, after = (_line(motor[part], load[part], motor[row]) for part in (slice(row), slice(row, None)))
        if not (before.straight and after.straight):
            continue
        change, spread = after.slope / before.slope - 1.0, before.spread + after.spread
        way = min(float(np.ptp(load[:row])), float(np.ptp(load[row:])))
        if abs(change) > max(_OTHER, _OFF * spread / way):
            raise InvalidInput(
                f"{recording.source}: the load moves by {before.slope:.4g} {recording.load_unit} per "
                f"{recording.motor_unit} until {time[row]:.4g} s and by {after.slope:.4g} from then on: two machines "
                "or units in one log; give each part by itself"
            )
        if abs(after.load - before.load) > _OFF * spread:
            raise InvalidInput(_slipped(recording, row, after.load - before.load))


def _line(motor: Array, load: Array, at: float) -> _Line:
    """Fit a line to evenly chosen samples; its load at the motor position `at`."""
    rows = np.unique(np.linspace(0, motor.size - 1, _CHOSEN).astype(int))
    x, y = motor[rows], load[rows]
    if not (np.ptp(x) > 0.0 and np.ptp(y) > 0.0):
        return _Line(0.0, 0.0, 0.0, False)
    slope, offset = np.polyfit(x - at, y, 1)
    spread = float(np.ptp(np.quantile(y - offset - slope * (x - at), _MOST)))
    return _Line(float(slope), float(offset), spread, abs(float(np.corrcoef(x, y)[0, 1])) > _LINE)


def _slipped(recording: EncoderRecording, row: int, size: float) -> str:
    return (
        f"{recording.source}: from {recording.time[row]:.4g} s on the load is {size:+.4g} {recording.load_unit} off "
        "where the motor moved it: an encoder or a coupling slipped, turns were lost in a pause, or two logs were "
        "joined; give each part by itself"
    )


class ResidualStep(NamedTuple):
    """The step that explains a residual best.

    Attributes
    ----------
    row : int
        First one behind it.
    size : float
    explained : float
        Share of the variance.
    """

    row: int
    size: float
    explained: float


def check_one_machine(recording: EncoderRecording, prepared: Regression, gap: float) -> None:
    """Refuse a recording in which the load jumps against the motor, or moves by another ratio in its second half.

    Raises
    ------
    InvalidInput
    """
    values, _ = columns(prepared, gap)
    reach, unit = float(np.ptp(recording.motor)), recording.load_unit
    known = min(float(np.ptp(part[1])) for part in np.array_split(values, 2, axis=1)) > max(_TRAVEL * gap, 0.1 * reach)
    halves = _halves(values, prepared)
    if known and abs(halves.change) > max(_RATIO, _SURE * halves.std):
        second = halves.ratio * (1.0 + halves.change)
        raise InvalidInput(
            f"{recording.source}: the load moves by {halves.ratio:.4g} {unit} per {recording.motor_unit} in its first "
            f"half and by {second:.4g} in its second: two machines or units in one log, or turns lost in a pause; "
            "give each part by itself"
        )
    used = [prepared.names.index(RATIO), prepared.names.index(OFFSET)]
    fit = solved(values @ values.T, used)
    step = largest_step(values[0] - fit.coefficients @ values[used])
    least = _STEP * gap * abs(float(fit.coefficients[0]))
    if step.explained > _EXPLAINED and abs(step.size) > least:
        raise InvalidInput(_slipped(recording, int(prepared.rows[step.row]), step.size))


class _Halves(NamedTuple):
    """Load per motor in the first half of a recording, its change to the second as a share, and that one's spread."""

    ratio: float
    change: float
    std: float


def _halves(values: Array, prepared: Regression) -> _Halves:
    """Fit columns (p, k) of a regression with a ratio and an offset for each half, and with what is one for both.

    A load that swings moves further than its ratio says, by as much as it is accelerated: faster strokes of the same
    machine are no other ratio. Blocks of time that are left out by turns give the spread.
    """
    load, output, offset, lag, inertia = (
        values[prepared.names.index(name)] for name in (LOAD, RATIO, OFFSET, LAG, INERTIA)
    )
    second = np.arange(load.size) >= load.size - load.size // 2
    table = np.array([load, output, second * output, offset, second * offset, lag, inertia])
    blocks = np.array([part @ part.T for part in np.array_split(table, _BLOCKS, axis=1)])
    used, whole = range(1, len(table)), blocks.sum(axis=0)
    ratio, change = solved(whole, used).coefficients[:2]
    others = solved(whole - blocks, used).coefficients
    std = math.sqrt(_BLOCKS - 1.0) * float(np.std(others[:, 1] / others[:, 0]))
    return _Halves(float(ratio), float(change / ratio), std)


def largest_step(residual: Array) -> ResidualStep:
    """Find the step with which a residual (k,) is explained best."""
    size, total = residual.size, residual - residual.mean()
    before = np.arange(1, size)
    sums = np.cumsum(total)[:-1]
    gain = sums**2 * (1.0 / before + 1.0 / (size - before))
    row = int(np.argmax(gain)) + 1
    scale = float(total @ total)
    jump = float(total[row:].mean() - total[:row].mean())
    return ResidualStep(row, jump, float(gain[row - 1]) / scale if scale else 0.0)
