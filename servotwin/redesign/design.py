"""Designs: controllers with a dead zone, as they are simulated and certified."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.messages import Band, Setting

_GRID = 512


@dataclass(frozen=True)
class Design:
    """A whole controller and the half-width of its dead zone.

    Attributes
    ----------
    controller : Controller
    tolerance : float
        m; 0: no dead zone.
    """

    controller: Controller
    tolerance: float = 0.0

    def setting(self, band: Band | None = None) -> Setting:
        """Setting of an update: tolerance and gains, with the band predicted for them."""
        return Setting(self.tolerance, gains_of(self.controller), band)

    @property
    def simulated(self) -> Design:
        """The design as it is simulated: as it runs, but that a law in continuous time has no rate limit."""
        law = self.controller
        if law.sample_rate is not None or law.rate_limit is None:
            return self
        return Design(law.replace(rate_limit=None), self.tolerance)

    def noise_effort(self, noise: float, band: tuple[float, float]) -> float:
        """Voltage (V rms) caused by white measurement noise of `noise` (m rms) within `band` (Hz).

        The loop is left out: it does not answer at frequencies far above its crossover. Gains as in Eq 14, behind the
        loop filter, and the notch.
        """
        law = self.controller
        hertz = np.geomspace(*band, _GRID)
        s = 2j * math.pi * hertz
        gain = law.Kp + law.Ki / s + law.Kd * s / (law.Tf * s + 1.0)
        if law.notch_hz:
            relative = s / (2.0 * math.pi * law.notch_hz)
            gain = gain * (1.0 - law.notch_gain * relative / (relative**2 + 2.0 * law.notch_damping * relative + 1.0))
        if law.loop_filter_hz is not None:
            gain = gain / (s / (2.0 * math.pi * law.loop_filter_hz) + 1.0)
        return noise * float(np.sqrt(np.trapezoid(np.abs(gain) ** 2, hertz) / (band[1] - band[0])))
