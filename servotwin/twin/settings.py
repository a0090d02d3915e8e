"""What a twin can be told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.identify import whitened
from servotwin.identify.gap import settings_of
from servotwin.identify.trend import TrendSettings


@dataclass(frozen=True)
class TwinSettings:
    """How a twin estimates, redesigns and insists.

    Parameters
    ----------
    enabled : bool
        False: nobody answers the edge's windows.
    method : str
        Estimator, as `identify.estimate_gap` names them.
    estimator : object, optional
        Settings of that estimator; None: its defaults. Those of "whitened" must leave `combine` off, as the trend joins
        the windows already; where their `gap_rate` is 0, it is taken from the trend.
    k_dz : float
        Dead-zone gain of Eq 21.
    smoothing : float
        Share of the previous gap that the policy keeps at each update, 0 up to, but not including, 1.
    initial_gap : float
        rad; what is believed before the first estimate (section 4.2: zero).
    trend : TrendSettings
        What is assumed of wear.
    gap_limit : float, optional
        rad; the gap that is one too many: the time until then is told.
    processing : float
        s from a window's arrival to the update's departure; the acknowledgement does not wait for it.
    validity : float
        s after a window's first sample for which an update that stands on it may still be applied.
    retry : float
        s without a receipt after which an update is sent again; longer than a round trip, or each goes out twice.
    attempts : int
        How often one update is sent before the twin gives it up.

    Raises
    ------
    InvalidInput
        A value is not a finite number in its range, the method does not exist, the settings are another method's.
    """

    enabled: bool = True
    method: str = whitened.METHOD
    estimator: Any = None
    k_dz: float = 1.0
    smoothing: float = 0.0
    initial_gap: float = 0.0
    trend: TrendSettings = field(default_factory=TrendSettings)
    gap_limit: float | None = None
    processing: float = 0.0
    validity: float = 60.0
    retry: float = 5.0
    attempts: int = 4

    def __post_init__(self) -> None:
        for name, unit in {"k_dz": "", "initial_gap": " rad", "processing": " s"}.items():
            _check(name, getattr(self, name), unit, "finite and 0 or more", lambda x: x >= 0.0)
        for name, unit in {"validity": " s", "retry": " s"}.items():
            _check(name, getattr(self, name), unit, "finite and greater than 0", lambda x: x > 0.0)
        if isinstance(self.attempts, bool) or not isinstance(self.attempts, int) or self.attempts < 1:
            raise InvalidInput(f"twin attempts = {self.attempts!r}: must be an integer of 1 or more")
        if self.gap_limit is not None:
            _check("gap_limit", self.gap_limit, " rad", "finite and 0 or more", lambda x: x >= 0.0)
        if getattr(settings_of(self.method, self.estimator), "combine", False):
            raise InvalidInput("twin estimator combine = True: must be False, as the trend already joins the windows")

    def replace(self, **changes: Any) -> TwinSettings:
        """A copy with some values changed, validated again."""
        return replace(self, **changes)


def _check(name: str, value: float, unit: str, allowed: str, accepts: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (math.isfinite(value) and accepts(value)):
        raise InvalidInput(f"twin {name} = {value!r}{unit}: must be {allowed}")
