"""Settings of the joint estimator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated

from servotwin.config.keys import check, settings, value
from servotwin.errors import InvalidInput
from servotwin.estimation.core.family import InputHold

_LARGEST_DELAY = 2e-3  # s of the paper's servo
SPREADS: Mapping[str, float] = MappingProxyType(
    {"k/m": 0.1, "c/m": 0.5, "pitch": 0.03, "k_d": 0.2, "k_B": 0.1, "gap rate": math.radians(0.5)}
)


@settings("joint")
@dataclass(frozen=True)
class JointSettings:
    """Settings of the joint estimator.

    Parameters
    ----------
    spreads : mapping
        Prior standard deviation of each free parameter, of the logarithm for "k/m", "c/m", "pitch", "k_d"
        and "k_B" (0.1: about 10 %), in rad/s for "gap rate" (by default on the paper's servo, and as much in its own
        time on another). A parameter may move by four of them.
    hold : InputHold, optional
        Course of the voltage between samples, where the angle is computed from it. By default it is held when the
        servo's controller is sampled, and linear when it is continuous.
    """

    spreads: Mapping[str, float] = field(default_factory=lambda: SPREADS)
    largest_delay_s: Annotated[
        float | None,
        value(
            minimum=0.0,
            help="Largest delay between position and angle (or voltage); 0: they are synchronous; None: 2 ms on the "
            "paper's servo and as much of its own time on another.",
        ),
    ] = None
    largest_gap_rad: Annotated[float, value(minimum=0.0, help="Largest gap of the search.")] = math.radians(60.0)
    hold: InputHold | None = None
    contact_travel_rad: Annotated[
        float | None,
        value(
            minimum=0.0,
            help="Least travel of the fitted screw in each contact; None: 0.5 deg, or, where the servo states the "
            "encoder's resolution, a third of the gap and at least 100 counts, if that is less.",
        ),
    ] = None
    largest_std_rad: Annotated[
        float, value(minimum=0.0, help="Largest statistical standard deviation of an estimate that is accepted.")
    ] = math.radians(0.25)
    model_error_rad: Annotated[
        float, value(minimum=0.0, help="Standard deviation of unmodelled effects, part of std_total.")
    ] = math.radians(0.02)
    numeric_error_rad: Annotated[
        float,
        value(
            minimum=0.0,
            help="Error of sampling and rounding, part of std; it matters only where the noise is very small.",
        ),
    ] = math.radians(2e-4)
    unexplained: Annotated[
        float,
        value(
            minimum=0.0,
            help="Residual over variation of the position (rms both) above which the model does not fit the window.",
        ),
    ] = 0.5
    inflation: Annotated[
        float,
        value(
            minimum=0.0,
            help="Factor on standard deviations: the noise's own model is estimated from the same window.",
        ),
    ] = 1.2
    noise_order: Annotated[int, value(minimum=0, help="Largest order of the whitening autoregression.")] = 30
    whitenings: Annotated[int, value(minimum=0, help="Rounds of estimating noise and parameters in turn.")] = 3

    def __post_init__(self) -> None:
        check(self)
        for name, spread in self.spreads.items():
            if name not in SPREADS:
                raise InvalidInput(f"joint spreads {name!r}: allowed are {', '.join(SPREADS)}")
            if isinstance(spread, bool) or not isinstance(spread, int | float) or not 0.0 < spread < math.inf:
                allowed = "must be finite and positive; leave known parameters out of `free`"
                raise InvalidInput(f"joint spreads {name!r} = {spread!r}: {allowed}")

    @property
    def delay_limit(self) -> float:
        """Largest delay, s."""
        return _LARGEST_DELAY if self.largest_delay_s is None else self.largest_delay_s

    def on(self, second: float) -> JointSettings:
        """The settings for a servo whose own second (`plant.scales`) is so many seconds."""
        own = {} if self.spreads is SPREADS else self.spreads
        spreads = {**SPREADS, "gap rate": SPREADS["gap rate"] / second, **own}
        delay = _LARGEST_DELAY * second if self.largest_delay_s is None else self.largest_delay_s
        return replace(self, spreads=spreads, largest_delay_s=delay)

    def spread(self, name: str) -> float:
        """Prior standard deviation of a free parameter."""
        return self.spreads.get(name, SPREADS[name])
