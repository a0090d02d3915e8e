"""What a twin can be told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.estimation.gap import settings_of
from servotwin.estimation.trend import TrendSettings
from servotwin.redesign.certified.certificate import Demands
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.triage_settings import TriageSettings

POLICIES = ("certified", "margin", "hysteresis", "paper")
_OWNERS = {"table": "certified", "k_dz": "paper", "smoothing": "paper", "k_noise": "margin"}


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
    policy : str
        What makes a setting of an estimate: "certified" sends what it has proved, "margin" and "hysteresis" set a dead
        zone, "paper" is Eq 21.
    uncertainty : Uncertainty
        How wrong the model may be, and the stated range of gaps, steps and input bias: what "certified" proves settings
        for. "margin" needs the steps.
    demands : Demands
        What a certified setting must show.
    table : str, optional
        Of "certified": file of settings that were proved beforehand (`servotwin certify`). They are looked up, and the
        proof for the exact evidence follows; None: it is made before anything is sent.
    k_dz, smoothing : float, optional
        Of "paper": the dead-zone gain of Eq 21, 1 unless given; the share of the previous gap that is kept at each
        update, 0 unless given, below 1.
    k_noise : float, optional
        Of "margin": tolerances per standard deviation of the measurement's noise.
    excitation : ExcitationSettings, optional
        What is asked of the edge when windows tell too little of the gap; None: nothing.
    triage : TriageSettings, optional
        When a glance at a window is enough; None: every window is estimated.
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
        A value is not a finite number in its range, the method or the policy does not exist, the settings are another
        method's or another policy's.
    """

    enabled: bool = True
    method: str = whitened.METHOD
    estimator: Any = None
    policy: str = POLICIES[0]
    uncertainty: Uncertainty = field(default_factory=lambda: Uncertainty(input_bias=(-0.1, 0.1)))
    demands: Demands = field(default_factory=Demands)
    table: str | None = None
    k_dz: float | None = None
    smoothing: float | None = None
    k_noise: float | None = None
    excitation: ExcitationSettings | None = None
    triage: TriageSettings | None = None
    initial_gap: float = 0.0
    trend: TrendSettings = field(default_factory=TrendSettings)
    gap_limit: float | None = None
    processing: float = 0.0
    validity: float = 60.0
    retry: float = 5.0
    attempts: int = 4

    def __post_init__(self) -> None:
        self._check_policy()
        for name, unit in {"initial_gap": " rad", "processing": " s"}.items():
            _check(name, getattr(self, name), unit, "finite and 0 or more", lambda x: x >= 0.0)
        for name, unit in {"validity": " s", "retry": " s"}.items():
            _check(name, getattr(self, name), unit, "finite and greater than 0", lambda x: x > 0.0)
        if isinstance(self.attempts, bool) or not isinstance(self.attempts, int) or self.attempts < 1:
            raise InvalidInput(f"twin attempts = {self.attempts!r}: must be an integer of 1 or more")
        if self.gap_limit is not None:
            _check("gap_limit", self.gap_limit, " rad", "finite and 0 or more", lambda x: x >= 0.0)
        if getattr(settings_of(self.method, self.estimator), "combine", False):
            raise InvalidInput("twin estimator combine = True: must be False, as the trend already joins the windows")

    def _check_policy(self) -> None:
        """The policy exists, and has what is set of it."""
        if self.policy not in POLICIES:
            hint = did_you_mean(str(self.policy), POLICIES)
            raise InvalidInput(f"twin policy = {self.policy!r} does not exist{hint}; give one of {', '.join(POLICIES)}")
        for name, owner in _OWNERS.items():
            value = getattr(self, name)
            if value is None:
                continue
            if owner != self.policy:
                raise InvalidInput(f"twin {name} = {value!r}: belongs to policy {owner!r}, and this is {self.policy!r}")
            if name != "table":
                _check(name, value, "", "finite and 0 or more", lambda x: x >= 0.0)

    def replace(self, **changes: Any) -> TwinSettings:
        """A copy with some values changed, validated again."""
        return replace(self, **changes)


def _check(name: str, value: float, unit: str, allowed: str, accepts: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (math.isfinite(value) and accepts(value)):
        raise InvalidInput(f"twin {name} = {value!r}{unit}: must be {allowed}")
