"""What the paper's estimator can be told."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from servotwin.errors import InvalidInput
from servotwin.estimation.paper.zero_phase import PADDINGS
from servotwin.estimation.settings_check import check_number

ORIGINS = ("absolute", "first")


@dataclass(frozen=True)
class Settings:
    """Settings of the paper's estimator.

    Parameters
    ----------
    alpha : float
        Observer poles at -alpha, rad/s.
    settle_s : float
        k_s T_s: what the cost leaves out at the start of a window, s.
    lowpass_hz : float, optional
        Cut-off of the zero-phase Butterworth on both channels, Hz (20 for noisy windows, section 4.3); None: none.
    lowpass_order : int
        Order of one pass; run forwards and backwards it counts twice (erratum E18).
    padding : "odd" or "even"
        How a window goes on beyond its ends for the low-pass: turned about its last sample, or mirrored.
    padding_samples : int, optional
        For how long; None: three times the order, as MATLAB's filtfilt does. Even padding of one period of the cut-off
        (250 samples at 5 kHz) lowers the scatter in the paper's noise from 0.2 to 0.05 deg: tests/test_paper_loop.py.
    iterations : int
        At most as many.
    origin : "absolute" or "first"
        Where both angles and lengths are counted from. The observer starts from zero, so what lies between zero and the
        window's first position is its initial error: with "absolute", the published reading, that error is what biases
        the gap, the more the farther from zero the machine works; with "first" the bias nearly vanishes
        (tests/test_paper_loop.py).
    reversals : int
        How often the motor must change direction. This and `rest_speed` carry names of ours (erratum E14).
    rest_speed : float
        rad/s; slower counts as rest.
    contact_travel : float
        rad: how far the fitted screw must be pushed in each contact.
    method_error : float
        rad: standard deviation taken for the method's own bias, in `std_total`. Measured: tests/test_paper_loop.py.
    largest_std : float
        rad: estimates with a larger statistical spread are refused.
    unexplained : float
        Residual over variation of the position (rms both) above which the model does not belong to the window.
    """

    alpha: float = 40.0
    settle_s: float = 0.25
    lowpass_hz: float | None = None
    lowpass_order: int = 10
    padding: str = "odd"
    padding_samples: int | None = None
    iterations: int = 100
    origin: str = "absolute"
    reversals: int = 1
    rest_speed: float = 0.1
    contact_travel: float = math.radians(0.5)
    method_error: float = math.radians(0.5)
    largest_std: float = math.radians(2.0)
    unexplained: float = 0.5

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise InvalidInput(f"estimator {name} = {getattr(self, name)!r}: must be {' or '.join(choices)}")
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name not in _CHOICES and not (value is None and item.default is None):
                check_number(f"estimator {item.name}", value, item.name in _WHOLE, item.name in _POSITIVE)


_CHOICES = {"padding": PADDINGS, "origin": ORIGINS}
_POSITIVE = ("alpha", "lowpass_hz", "lowpass_order", "iterations")
_WHOLE = ("lowpass_order", "padding_samples", "iterations", "reversals")
