"""Numbers out of the stored bodies of evidence; a body that cannot be read gives nothing."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec

from servotwin.store.records import StoredEvidence

NORMAL_95 = 1.959963984540054
"""Standard deviations on either side of the mean that hold 95 % of a normal distribution."""


class WearRate(NamedTuple):
    """Trend of the gap after a window.

    Attributes
    ----------
    time : float
        Sample time, s.
    gap, gap_std, rate, rate_std : float
        rad and rad/s.
    """

    time: float
    gap: float
    gap_std: float
    rate: float
    rate_std: float


def body_of(record: StoredEvidence) -> Any:
    """Decode the body of evidence; None where it cannot be."""
    try:
        return msgspec.msgpack.decode(record.body)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def finite(value: object) -> float | None:
    """A finite number, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def wear_rate(record: StoredEvidence | None) -> WearRate | None:
    """Read evidence of the kind trend; None: there is none that tells a rate, which one window alone does not."""
    if record is None:
        return None
    body = body_of(record)
    try:
        mean, covariance = body["mean"], body["covariance"]
        if body.get("updates", 2) < 2:
            return None
        read = (body["time"], mean[0], covariance[0], mean[1], covariance[4])
    except (KeyError, TypeError, IndexError):
        return None
    numbers = [finite(value) for value in read]
    time, gap, gap_variance, rate, rate_variance = numbers
    if time is None or gap is None or gap_variance is None or rate is None or rate_variance is None:
        return None
    return WearRate(time, gap, math.sqrt(max(0.0, gap_variance)), rate, math.sqrt(max(0.0, rate_variance)))


def interval_95(gap: float | None, std: float | None) -> tuple[float | None, float | None] | None:
    """95 % interval of a gap, rad, cut at 0; None where the gap or its spread is unknown."""
    if gap is None or std is None:
        return None
    return max(0.0, gap - NORMAL_95 * std), gap + NORMAL_95 * std


def interval_of(record: StoredEvidence) -> tuple[float | None, float | None] | None:
    """95 % interval of an estimate or a glance, rad; an end that is not finite is None: unbounded."""
    body: Any = body_of(record) if record.kind == "estimate" else None
    try:
        low, high = body["estimate"]["interval"]
    except (KeyError, TypeError, ValueError):
        return interval_95(record.gap, record.std)
    return finite(low), finite(high)
