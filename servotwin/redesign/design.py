"""Designs: controllers with a dead zone, as they are simulated and certified."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController, StoredController, filtered_pid, kind_of_stored, law_of
from servotwin.messages import Band, Setting
from servotwin.plant.law_loop import law_response

_GRID = 512


@dataclass(frozen=True)
class Design:
    """A whole controller and the half-width of its dead zone.

    Attributes
    ----------
    controller : Controller, Cascade or LinearLaw
    tolerance : float
        m; 0: no dead zone.
    """

    controller: StoredController
    tolerance: float = 0.0

    @property
    def pid(self) -> Controller:
        """The controller, where it is a filtered PID.

        Raises
        ------
        InvalidInput
            It is another one.
        """
        return filtered_pid(self.controller)

    def setting(self, band: Band | None = None) -> Setting:
        """Setting of an update: tolerance and gains, with the band predicted for them."""
        return Setting.of(self.tolerance, gains_of(self.controller), band)

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
        return noise * _noise_gain(self.controller, band)


@lru_cache(maxsize=1024)
def _noise_gain(controller: AnyController, band: tuple[float, float]) -> float:
    """Root mean square of a law's gain (V/m) within a band (Hz)."""
    hertz, law = np.geomspace(*band, _GRID), law_of(controller)
    if not isinstance(law, Controller):
        gain = np.array([law_response(law, 2.0 * math.pi * each)[2] for each in hertz.tolist()])
        return float(np.sqrt(np.trapezoid(np.abs(gain) ** 2, hertz) / (band[1] - band[0])))
    s = 2j * math.pi * hertz
    gain = law.Kp + law.Ki / s + law.Kd * s / (law.Tf * s + 1.0)
    if law.notch_hz:
        relative = s / (2.0 * math.pi * law.notch_hz)
        gain = gain * (1.0 - law.notch_gain * relative / (relative**2 + 2.0 * law.notch_damping * relative + 1.0))
    if law.loop_filter_hz is not None:
        gain = gain / (s / (2.0 * math.pi * law.loop_filter_hz) + 1.0)
    return float(np.sqrt(np.trapezoid(np.abs(gain) ** 2, hertz) / (band[1] - band[0])))


def decoded_part(kind: type, values: Any) -> Any:
    """Hook of decoders: the controller of a design, of the class that its fields name.

    Raises
    ------
    NotImplementedError
        For any other type.
    """
    if kind is StoredController:  # type: ignore[comparison-overlap]
        return msgspec.convert(values, kind_of_stored(values))
    raise NotImplementedError(f"{kind} is not stored")


def with_feedforward(setting: Design, feedforward: float) -> Design:
    """The setting with another feedforward, V."""
    if setting.controller.feedforward == feedforward:
        return setting
    return Design(setting.controller.replace(feedforward=feedforward), setting.tolerance)
