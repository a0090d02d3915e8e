"""Effect of the int16 channels of messages on the estimates."""

from __future__ import annotations

from dataclasses import dataclass

from servotwin.cosim.loop import Loop
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.window import Window
from servotwin.messages import WindowMessage
from servotwin.simulation import Run
from servotwin.twin.estimating import decode_window, estimator_of


@dataclass(frozen=True)
class Quantisation:
    """Effect of the int16 channels of one window on its estimate.

    Attributes
    ----------
    start : float
        s, of the window.
    position_step, theta_m_step : float
        m and rad: one count of the channel's code, its resolution.
    gap_change : float
        rad: gap from the decoded window minus gap from the raw samples; NaN where one of them is unknown.
    """

    start: float
    position_step: float
    theta_m_step: float
    gap_change: float


def quantisation(loop: Loop) -> tuple[Quantisation, ...]:
    """Effect of the int16 channels on each estimate: every window is estimated again from the unquantised samples.

    Both estimates start from the same previous gap, that of the window before (as the twin does while windows arrive in
    order).
    """
    settings = loop.scenario.twin
    estimate = estimator_of(loop.scenario.servo, settings)
    previous, effects = settings.initial_gap, []
    for window in loop.windows:
        pair = decode_window(window), _raw(loop.run, window)
        decoded, raw = (estimate(w, Expectation(previous)) for w in pair)
        steps = {channel.name: channel.scale for channel in window.channels}
        effects.append(Quantisation(window.start, steps["position"], steps["theta_m"], decoded.gap - raw.gap))
        previous = decoded.gap if decoded.ok else previous
    return tuple(effects)


def _raw(run: Run, window: WindowMessage) -> Window:
    """Window with the raw samples of the sensors."""
    first = round(window.start * window.rate)
    part = slice(first, first + window.samples)
    return Window(
        run.measured("position")[part],
        theta_m=run.measured("theta_m")[part],
        voltage=run.measured("voltage")[part],
        reference=run.measured("reference")[part],
        sample_rate=window.rate,
        start=window.start,
    )
