"""What the whitened estimator can be told."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from servotwin.errors import InvalidInput
from servotwin.estimation.settings_check import check_number


@dataclass(frozen=True)
class Settings:
    """Settings of the whitened estimator.

    Parameters
    ----------
    passes : int
        Fits, each in the noise that the one before left.
    order : int
        Largest order of the noise's autoregression, at the decimated rate.
    starts : int
        Gaps of the first search, from zero to the motor's range.
    kept : int
        How many minima of the first search, at a low rate, are followed at the full rate.
    skew : bool
        Whether a delay between the channels is estimated. Leave it on unless one clock samples both: a fifth of a
        millisecond, not accounted for, is 0.4 deg. Off, the spread falls by a fifth.
    largest_skew : float
        s: a larger delay is a fault.
    gap_rate : float
        rad/s: standard deviation of the gap's rate of growth within the window, which is then estimated beside the gap
        and counts in `std`; 0: the gap is constant. What is estimated is the gap in the middle of the window.
    offset : (float, float), optional
        rad: expected encoder offset, position / (p static gain) less screw angle, and its standard deviation, from
        earlier windows. With it one contact can be enough; None: nothing is known.
    prefilter_hz : float, optional
        Cut-off of the zero-phase low-pass on theta_m, Hz; 0: none; None: decided from the encoder's noise.
    contact_travel : float
        rad: how far the fitted screw must be pushed in each contact.
    largest_std : float
        rad: estimates with a larger statistical spread are refused.
    largest_shift : float
        rad: when the gap would move by more than this if stiffness, damping, pitch and the screw's compliance were
        free, the model does not belong to the window.
    model_error : float
        rad: standard deviation taken for what the model leaves out, in `std_total`.
    calibration : float
        Reported over computed standard deviation, so that the 95 % interval holds 95 %: docs/estimator.md.
    combine : bool
        Whether an OK estimate is merged with a prior estimate by their `std_total`. Not for a filter across windows,
        whose own prediction would then be counted twice.
    """

    passes: int = 4
    order: int = 60
    starts: int = 13
    kept: int = 4
    skew: bool = True
    largest_skew: float = 5e-3
    gap_rate: float = 0.0
    offset: tuple[float, float] | None = None
    prefilter_hz: float | None = None
    contact_travel: float = math.radians(0.5)
    largest_std: float = math.radians(0.05)
    largest_shift: float = math.radians(0.05)
    model_error: float = math.radians(0.02)
    calibration: float = 1.1
    combine: bool = False

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "offset":
                _check_offset(value)
            elif not (value is None and item.default is None):
                _check(item.name, value, item.type)


_POSITIVE = ("passes", "order", "starts", "kept", "largest_std", "calibration")


def _check(name: str, value: object, kind: object) -> None:
    if kind == "bool":
        if not isinstance(value, bool):
            raise InvalidInput(f"estimator {name} = {value!r}: must be True or False")
        return
    check_number(f"estimator {name}", value, kind == "int", name in _POSITIVE)


def _check_offset(value: object) -> None:
    if value is None:
        return
    numbers = value if isinstance(value, tuple) and len(value) == 2 else (math.nan, math.nan)
    if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers) or numbers[1] <= 0.0:
        raise InvalidInput(f"estimator offset = {value!r}: must be (mean, standard deviation above 0), in rad")
