"""The play operator with its exact sensitivities, at the samples and between them.

The screw's angle is piecewise affine in the gap and in where the screw began. Pushed forwards it is theta_m - half the
gap, pushed backwards theta_m + half the gap, and between contacts it rests. Before the first contact it rests where it
began.

Between the samples the structure's response takes the screw's angle as linear. That leaves out the bow of a curved
motion, the sample within which a contact begins, and the crest between two samples, which stays in the screw's angle
until the next contact: some 1e-10 m in all, and the evidence of a gap can be as small. In `polygon` the motor's angle
is a cubic in between, and the polygon keeps the true path's area and first moment in every interval: the structure,
slow against the sample rate, answers to both alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.hybrid.compiled import bare, compiled, inlined
from servotwin.plant.signals import Array

SCREW, BY_GAP, BY_START, BY_RATE = range(4)


class Gap(NamedTuple):
    """A gap that is linear in time, and where the screw began.

    Attributes
    ----------
    gap : float
        rad, TOTAL gap in the middle of the window.
    theta_d0 : float
        rad, the screw's angle before the first sample; clamped into the gap there.
    rate : float
        rad per sample.
    """

    gap: float
    theta_d0: float
    rate: float = 0.0


class Travel(NamedTuple):
    """Angles (rad) by which the motor pushed the screw forwards and backwards, and the range of its lead."""

    forwards: float
    backwards: float
    lead: float


def contacts(theta_m: Array, at: Gap) -> Array:
    """(4, n) the screw's angle (rad) and its derivatives by gap, theta_d0 and rate, for the motor's angle (n,).

    Where a contact begins, the derivatives are those of the side that the screw is on: the first sample in contact
    belongs to the contact.
    """
    out = np.empty((4, theta_m.size))
    follow(theta_m, at.gap, at.theta_d0, at.rate, out)
    return out


@bare
def follow(theta_m: Array, gap: float, theta_d0: float, rate: float, out: Array) -> None:
    """`contacts` into `out` (4, n)."""
    screw, by_gap, by_start, by_rate = theta_d0, 0.0, 1.0, 0.0
    middle = 0.5 * (theta_m.size - 1)
    for i in range(theta_m.size):
        half = 0.5 * (gap + rate * (i - middle))
        lower, upper = theta_m[i] - half, theta_m[i] + half
        if lower > screw:
            screw, by_gap, by_start, by_rate = lower, -0.5, 0.0, -0.5 * (i - middle)
        elif upper < screw:
            screw, by_gap, by_start, by_rate = upper, 0.5, 0.0, 0.5 * (i - middle)
        out[0, i], out[1, i], out[2, i], out[3, i] = screw, by_gap, by_start, by_rate


@bare
def follow_screw(theta_m: Array, gap: float, theta_d0: float, rate: float, out: Array) -> None:
    """The screw's angle alone, into `out` (n,)."""
    screw = theta_d0
    middle = 0.5 * (theta_m.size - 1)
    for i in range(theta_m.size):
        half = 0.5 * (gap + rate * (i - middle))
        screw = min(max(screw, theta_m[i] - half), theta_m[i] + half)
        out[i] = screw


def travel(theta_m: Array, at: Gap) -> Travel:
    """Sum up the screw's motion in a window, for the motor's angle (n,)."""
    screw = np.empty(theta_m.size)
    follow_screw(theta_m, *at, screw)
    moved = np.diff(screw)
    lead = float(np.ptp(theta_m - screw))
    return Travel(float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum()), lead)


@compiled
def last_contacts(
    theta_m: Array, gap: float, theta_d0: float, rate: float
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """(n,) sample at which the motor last pushed the screw; -1 before it ever did."""
    last = np.empty(theta_m.size, np.int64)
    screw, latest, middle = theta_d0, -1, 0.5 * (theta_m.size - 1)
    for i in range(theta_m.size):
        half = 0.5 * (gap + rate * (i - middle))
        moved = min(max(screw, theta_m[i] - half), theta_m[i] + half)
        if moved != screw:
            screw, latest = moved, i
        last[i] = latest
    return last


def through_gap(columns: Array, theta_m: Array, at: Gap) -> Array:
    """(k, n) changes of the screw's angle for changes `columns` (k, n) of the motor's: those at the last contact."""
    last = last_contacts(theta_m, at.gap, at.theta_d0, at.rate)
    touched = last >= 0
    return np.where(touched, columns[:, np.maximum(last, 0)], 0.0)


_SIXTH, _TWELFTH, _FORTY_FIFTH = 1.0 / 6.0, 1.0 / 12.0, 1.0 / 45.0  # a product takes a quarter of a division's time
_STEPS, _CLOSE = 30, 1e-13  # steps, and accuracy in samples, of the search for the begin of a contact

# Callees first: what is compiled is cached under the code of the functions that it names, if they are known by then.


@inlined
def level(x: float, low: float, slope: float, bend: float, twist: float) -> float:
    """A cubic, 0 <= x <= 1 from one sample to the next."""
    return low + x * (slope + x * (0.5 * bend + x * twist / 6.0))


@inlined
def integrals(x: float, low: float, slope: float, bend: float, twist: float) -> tuple[float, float]:
    """Area and first moment of the cubic from 0 to x."""
    area = x * (low + x * (slope / 2.0 + x * (bend / 6.0 + x * twist / 24.0)))
    return area, x * x * (low / 2.0 + x * (slope / 3.0 + x * (bend / 8.0 + x * twist / 30.0)))


@inlined
def summit(slope: float, bend: float, twist: float) -> float:
    """Return the x in 0..1 at which the cubic is highest."""
    if slope + bend + 0.5 * twist >= 0.0:
        return 1.0
    if slope <= 0.0:
        return 0.0
    return 2.0 * slope / (np.sqrt(bend * bend - 2.0 * twist * slope) - bend)


@inlined
def meeting(end: float, low: float, slope: float, bend: float, twist: float) -> float:
    """Find the x before `end` at which the cubic turns positive: by Newton's method, by halves where that fails."""
    inside, outside, x = end, 0.0, 0.5 * end
    for _ in range(_STEPS):
        value = level(x, low, slope, bend, twist)
        if value < 0.0:
            outside = x
        else:
            inside = x
        steepness = slope + x * (bend + 0.5 * x * twist)
        ahead = x - value / steepness if steepness > 0.0 else outside
        if abs(ahead - x) < _CLOSE:
            return ahead
        x = ahead if outside < ahead < inside else 0.5 * (outside + inside)
    return x


@inlined
def pushed(low: float, high: float, before: float, after: float) -> tuple[float, float, float, float]:
    """Push the screw from one sample to the next; angles are counted in the direction of the push, from the screw.

    Parameters
    ----------
    low, high : float
        rad, by how much the motor would push the screw at either sample.
    before, after : float
        rad, second differences of the motor's angle there.

    Returns
    -------
    crest : float
        rad, how far the screw was pushed; 0: not at all.
    begin : float
        0..1, time at which the push began.
    area, moment : float
        rad: of the screw's path less that of the line to its end, an interval being 1 long.
    """
    twist = after - before
    slope = high - low - 0.5 * before - _SIXTH * twist
    end = summit(slope, before, twist)
    if low == 0.0 and end == 1.0:
        return high, 0.0, -_TWELFTH * before - 0.5 * _TWELFTH * twist, -0.5 * _TWELFTH * before - _FORTY_FIFTH * twist
    crest = high if end == 1.0 else level(end, low, slope, before, twist)
    if crest <= 0.0:
        return 0.0, 1.0, 0.0, 0.0
    begin = 0.0 if low >= 0.0 else meeting(end, low, slope, before, twist)
    area, moment = integrals(end, low, slope, before, twist)
    if begin > 0.0:
        none = integrals(begin, low, slope, before, twist)
        area, moment = area - none[0], moment - none[1]
    rest = 1.0 - end
    return crest, begin, area + crest * (rest - 0.5), moment + crest * (0.5 * rest * (1.0 + end) - 1.0 / 3.0)


@inlined
def put(out: Array, i: int, side: float, time: float) -> None:
    """The derivatives at a sample, for the side and the time (samples from the middle) of the last push.

    The side is 1 forwards, -1 backwards, 0 before any contact.
    """
    out[BY_GAP, i] = -0.5 * side
    out[BY_START, i] = 1.0 - abs(side)
    out[BY_RATE, i] = -0.5 * side * time


@inlined
def begun(out: Array, i: int, begin: float) -> None:
    """Spread each derivative's step, at the part `begin` of the way from sample i - 1 to i, over both by its area."""
    moment = 0.5 * (1.0 - begin * begin) - 1.0 / 3.0
    early = 0.5 - begin - moment
    for row in range(SCREW + 1, BY_RATE + 1):
        step = out[row, i] - out[row, i - 1]
        out[row, i - 1] += early * step
        out[row, i] += moment * step


@bare
def trace(theta_m: Array, gap: float, theta_d0: float, rate: float, out: Array) -> None:
    """`polygon` into `out` (4, n); or its first row alone into (1, n)."""
    last, middle = theta_m.size - 1, 0.5 * (theta_m.size - 1)
    half = 0.5 * (gap - rate * middle)
    screw = min(max(theta_d0, theta_m[0] - half), theta_m[0] + half)
    side, time = np.sign(screw - theta_d0), -middle
    out[0, 0] = screw
    if len(out) > 1:
        put(out, 0, side, time)
    after = theta_m[2] - 2.0 * theta_m[1] + theta_m[0]
    for i in range(1, last + 1):
        before, narrow = after, half
        half = 0.5 * (gap + rate * (i - middle))
        if i < last:
            after = theta_m[i + 1] - 2.0 * theta_m[i] + theta_m[i - 1]
        area, moment, begin, new = 0.0, 0.0, 1.0, side
        for way in (1.0, -1.0):
            low = (way * theta_m[i - 1] - narrow) - way * screw  # 0 in contact, without rounding
            high = (way * theta_m[i] - half) - way * screw
            if max(low, high) + abs(before) + abs(after) <= 0.0:
                continue
            crest, begin, area, moment = pushed(low, high, way * before, way * after)
            if crest > 0.0:
                screw = theta_m[i] - way * half if crest == high else screw + way * crest
                area, moment, new, time = way * area, way * moment, way, i - middle
                break
        out[0, i - 1] += area - moment
        out[0, i] = screw + moment
        if len(out) > 1:
            put(out, i, new, time)
            if new != side and i == 1 and begin == 0.0:
                put(out, 0, new, -middle)
            elif new != side:
                begun(out, i, begin)
        side = new


def polygon(theta_m: Array, at: Gap) -> Array:
    """(4, n) rows as of `contacts`: corners of polygons with the areas of the screw's angle and of its derivatives.

    Parameters
    ----------
    theta_m : (n,) array
        rad, n >= 3.
    at : Gap
    """
    out = np.empty((4, theta_m.size))
    trace(theta_m, at.gap, at.theta_d0, at.rate, out)
    return out
