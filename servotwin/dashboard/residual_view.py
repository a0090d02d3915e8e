"""Residual of a stored window's fit, and whether it is white: for one panel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from servotwin.dashboard.window_view import envelope_indices
from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.estimation.axis_model import servo_for
from servotwin.estimation.gap import options_for
from servotwin.estimation.late_window import prompt_window
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.reduction import CONSTANT, RESIDUAL
from servotwin.estimation.window import Window
from servotwin.messages import InvalidMessage, WindowMessage, decode
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array
from servotwin.twin.context import described, parts_of
from servotwin.twin.estimating import decode_window, own_fit, stated_machine
from servotwin.twin.evidence_rows import StoredEstimate

_LAGS, _COLUMNS = 60, 300
"""Lags of the autocorrelations, and columns of the plot of the residual."""
_OUTSIDE_WHITE = 0.1
"""Share of lags outside the 95 % band up to which a residual counts as white: of 60 lags white noise has more in three
cases of a hundred."""
_PUBLISHED = (
    "method 'paper' compares channels that it has filtered: no residual of the position is left that could be white"
)


class StoredFit(msgspec.Struct):
    """A window, its estimate's evidence and its context, as stored."""

    window: bytes
    body: bytes
    context: str


def residual_view(stored: StoredFit) -> dict[str, Any]:
    """Fit a stored window again, from the estimate that it led to, and describe what the fit leaves.

    Returns
    -------
    dict
        Ready for JSON, SI units. of ("position", or "motor": its angle, as motion of the load), rms (m or rad),
        predicted (share of the residual's variance that follows from earlier samples), white (bool), outside and lags
        (numbers of autocorrelations of the whitened residual outside the 95 % band, and in all), band (half-width),
        lag (s), autocorrelation and autocorrelation_white (from lag 1 on), time (s after the window's first sample)
        and residual.

    Raises
    ------
    InvalidInput
        The window, the evidence or the context cannot be read, or the machine's estimator has no such residual.
    """
    found = _fit(decode_window(_window(stored.window)), stored)
    left = found.left
    coloured, whitened_ = autocorrelation(left, _LAGS), autocorrelation(found.white, _LAGS)
    band = 1.96 / math.sqrt(left.size)
    outside = int(np.sum(np.abs(whitened_) > band))
    kept = envelope_indices(left.tolist(), _COLUMNS)
    return {
        "of": found.of,
        "rms": float(np.sqrt(np.mean(left**2))),
        "predicted": found.predicted,
        "white": outside <= _OUTSIDE_WHITE * whitened_.size,
        "outside": outside,
        "lags": whitened_.size,
        "band": band,
        "lag": found.interval,
        "autocorrelation": _short(coloured),
        "autocorrelation_white": _short(whitened_),
        "time": [round(found.start + k * found.interval, 9) for k in kept],
        "residual": _short(left[kept]),
    }


def autocorrelation(series: Array, lags: int) -> Array:
    """Autocorrelations of a series at the lags 1 ... `lags`, fewer of a short series; zeros of a constant one."""
    centred = series - series.mean()
    power, lags = float(centred @ centred), min(lags, series.size // 4)
    if power <= 0.0:
        return np.zeros(lags)
    return np.array([float(centred[lag:] @ centred[:-lag]) / power for lag in range(1, lags + 1)])


@dataclass(frozen=True, eq=False)
class _Left:
    """Residual of a fit.

    Attributes
    ----------
    of : str
        What is fitted: "position" of the load, or angle of the "motor", as motion of the load.
    left, white : (n,) array
        Measured less the model's, m or rad; and after the fit's noise model.
    interval, start : float
        s between two samples, and of the first one after the window's.
    predicted : float
        Share of the variance that follows from earlier samples.
    """

    of: str
    left: Array
    white: Array
    interval: float
    start: float
    predicted: float


def _fit(window: Window, stored: StoredFit) -> _Left:
    """Fit a window with the model and what was expected of it then."""
    servo, settings = described(parts_of(stored.context))
    settings, window = settings.on(servo), prompt_window(window, servo)
    try:
        body = msgspec.msgpack.decode(stored.body, type=StoredEstimate)
        gap = msgspec.msgpack.decode(body.estimate)["gap"]
    except (msgspec.MsgspecError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise InvalidInput(f"the stored estimate is not understood: {error}") from None
    expected = body.prior.expectation(settings.trend)
    model = None if servo.at_motor else servo_for(servo)
    if model is None and isinstance(servo, Axis):
        return _of_search(own_fit(window, servo, settings, expected), window, servo.at_motor)
    options = options_for(servo, settings.method, settings.estimator)
    if model is None or not isinstance(options, whitened.WhitenedSettings):
        raise InvalidInput(_PUBLISHED)
    start = float(gap) if isinstance(gap, int | float) and math.isfinite(gap) else expected.previous
    growing = replace(options, gap_rate=options.gap_rate or expected.gap_rate(settings.trend))
    machine = (expected.machine or stated_machine(settings)) if settings.learning.learn and model.rigid else None
    fitted = whitened.fit(window, model, start, growing, machine).aligned
    if fitted is None:
        raise InvalidInput("the window's channels are broken, so that nothing was fitted")
    return _of_whitened(fitted.whitened, window)


def _of_whitened(result: WhitenedFit, window: Window) -> _Left:
    left, factor = result.residual, result.reduction.decimation.factor
    white = result.rows[RESIDUAL] - result.shares @ result.rows[CONSTANT:]
    white = white[: left.size]  # what comes after it is prior knowledge, and no sample
    predicted = max(0.0, 1.0 - result.noise.unpredicted / result.reduction.decimation.whiteness)
    interval = factor / window.sample_rate
    return _Left("position", left, white, interval, 2.0 * (factor > 1) * interval, predicted)


def _of_search(found: Search, window: Window, at_motor: bool) -> _Left:
    """Residual of the fit by an axis's own method: output error, or motor side."""
    left = -found.best.raw
    white = -found.best.residual[: left.size]  # what comes after it is prior knowledge, and no sample
    of, predicted = "motor" if at_motor else "position", 1.0 - found.noise.unpredicted
    return _Left(of, left, white, 1.0 / window.sample_rate, 0.0, max(0.0, predicted))


def _window(data: bytes) -> WindowMessage:
    try:
        message = decode(data)
    except InvalidMessage as error:
        raise InvalidInput(f"the stored window is not understood: {error}") from None
    if not isinstance(message, WindowMessage):
        raise InvalidInput("the stored message is no window")
    return message


def _short(values: Array) -> list[float]:
    """Five digits: a screen shows no more."""
    return [float(f"{value:.5g}") for value in values]
