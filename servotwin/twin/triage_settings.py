"""When a glance at a window is enough."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from servotwin.estimation.settings_check import check_number


@dataclass(frozen=True)
class TriageSettings:
    """When a glance is enough.

    Parameters
    ----------
    gap : float
        rad: a gap that moved by less is no news.
    deviations : float
        Standard deviations by which gap and input bias have to be off to have moved.
    widest : float
        rad: a glance with a larger spread does not show the gap.
    misfit : float
        Times as much as usual is unusual.
    least_misfit : float
        m: no misfit below is unusual.
    bias : float
        V: an input bias that moved by less is no news.
    every : int
        At least every so many windows one is estimated,
    longest : float
        and at least every so many s.

    Raises
    ------
    InvalidInput
        A value is not finite and above 0, or `every` is not a whole number.
    """

    gap: float = math.radians(0.1)
    deviations: float = 3.0
    widest: float = math.radians(0.1)
    misfit: float = 3.0
    least_misfit: float = 1e-7
    bias: float = 2e-3
    every: int = 50
    longest: float = 3600.0

    def __post_init__(self) -> None:
        for item in fields(self):
            check_number(f"triage {item.name}", getattr(self, item.name), item.name == "every", True)
