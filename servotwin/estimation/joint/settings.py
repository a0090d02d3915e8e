"""What the joint estimator can be told."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType

from servotwin.errors import InvalidInput
from servotwin.estimation.core.family import Hold
from servotwin.estimation.settings_check import check_number

SPREADS: Mapping[str, float] = MappingProxyType(
    {"k/m": 0.1, "c/m": 0.5, "pitch": 0.03, "k_B": 0.1, "gap rate": math.radians(0.5)}
)


@dataclass(frozen=True)
class JointSettings:
    """Settings of the joint estimator.

    Parameters
    ----------
    spreads : mapping
        What is known of each free parameter beforehand: standard deviation, of the logarithm for "k/m", "c/m", "pitch"
        and "k_B" (0.1: about 10 %), in rad/s for "gap rate". A parameter may move by four of them.
    largest_delay_s : float
        Position and angle (or voltage) may be out of step by up to this; 0: they are known to be in step.
    largest_gap_rad : float
        End of the search.
    hold : Hold, optional
        What the voltage does between samples, where the angle is computed from it. By default it is held when the
        servo's controller is sampled, and linear when it is continuous.
    contact_travel_rad : float
        How far the fitted screw must be pushed in each contact.
    largest_std_rad : float
        Estimates with a larger statistical spread are refused.
    model_error_rad : float
        What the model's remaining error is taken to add to the spread, in `std_total`.
    numeric_error_rad : float
        What sampling and rounding leave, in `std` already: it counts where there is next to no noise.
    unexplained : float
        Residual over variation of the position (rms both) above which the model does not belong to the window.
    inflation : float
        Standard deviations are multiplied by this: the noise's own model is estimated from the same window.
    noise_order : int
        Most coefficients of the autoregression that whitens.
    whitenings : int
        How often noise and parameters are estimated in turn.
    """

    spreads: Mapping[str, float] = field(default_factory=lambda: SPREADS)
    largest_delay_s: float = 2e-3
    largest_gap_rad: float = math.radians(60.0)
    hold: Hold | None = None
    contact_travel_rad: float = math.radians(0.5)
    largest_std_rad: float = math.radians(0.25)
    model_error_rad: float = math.radians(0.02)
    numeric_error_rad: float = math.radians(2e-4)
    unexplained: float = 0.5
    inflation: float = 1.2
    noise_order: int = 30
    whitenings: int = 3

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.name not in ("spreads", "hold"):
                check_number(f"joint {item.name}", getattr(self, item.name), item.name in _WHOLE)
        for name, value in self.spreads.items():
            if name not in SPREADS:
                raise InvalidInput(f"joint spreads {name!r}: allowed are {', '.join(SPREADS)}")
            check_number(f"joint spreads {name!r}", value)
            if value == 0.0:
                raise InvalidInput(f"joint spreads {name!r} = 0: must be above 0; leave out of `free` what is known")

    def spread(self, name: str) -> float:
        """Of a free parameter."""
        return self.spreads.get(name, SPREADS[name])


_WHOLE = ("noise_order", "whitenings")
