"""How one servo's agent works."""

import re
from dataclasses import dataclass, field
from math import inf, isfinite

from servotwin.control.controller import Controller
from servotwin.edge.limits import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.watch import WatchSettings
from servotwin.edge.window_filter import WindowFilterSettings
from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN, Gains
from servotwin.runtime.retry import Retry


@dataclass(frozen=True, slots=True)
class Supervision:
    """How the edge looks after itself.

    Parameters
    ----------
    fallback : FallbackSet, optional
        What it falls back to; None: it does not.
    watch : WatchSettings, optional
        What counts as evidence against the parameters in force; None: nothing that the loop does.
    period_s : float
        How often it looks; a whole number of the watch's slots, at least one.
    """

    fallback: FallbackSet | None = None
    watch: WatchSettings | None = field(default_factory=WatchSettings)
    period_s: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 < self.period_s < inf:
            raise InvalidInput(f"supervision period_s = {self.period_s!r} s: must be finite and greater than 0")

    def period_samples(self, rate: float) -> int:
        """Samples from one look to the next, at `rate` Hz."""
        slot = 1 if self.watch is None else max(1, round(self.watch.slot_s * rate))
        return slot * max(1, round(self.period_s * rate / slot))


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """How one servo's agent works.

    Parameters
    ----------
    servo, boot : str
        Names; a new boot name for each start of the edge.
    sample_rate : float
        Hz.
    window_s, pre_trigger_s : float
        Length of a window, and how much of it lies before the change of the reference; whole samples.
    longest_window_s, longest_pre_trigger_s : float, optional
        What the twin may request instead; None: no more than that.
    probe : ProbeLimits, optional
        Which probing moves of the reference the twin may request; None: none.
    retry : Retry
        When to repeat an unacknowledged window.
    limits : Limits
        What updates must respect.
    parameters : Parameters
        In force at the start.
    fine_angle : bool
        Whether theta_m is sent with 32 bits instead of 16 (as a second channel).
    reference : float
        Before the first sample, m; the first sample is a change when it differs.
    model_version : str
        Description of the servo the edge runs on.
    controller : Controller, optional
        As configured: what updates start from, and the limits and filters that they do not change. None: updates set
        the tolerance only.
    own : Gains, optional
        The servo's own gains, in the middle of the box that updates must stay in; None: the controller's.
    supervision : Supervision
    window_filter : WindowFilterSettings, optional
        Chooses which windows are sent; None: all are.
    """

    servo: str
    boot: str
    sample_rate: float
    window_s: float = 1.0
    pre_trigger_s: float = 0.0
    retry: Retry = field(default_factory=Retry)
    limits: Limits = field(default_factory=Limits)
    parameters: Parameters = field(default_factory=Parameters)
    fine_angle: bool = False
    reference: float = 0.0
    model_version: str = ""
    controller: Controller | None = None
    own: Gains | None = None
    supervision: Supervision = field(default_factory=Supervision)
    longest_window_s: float | None = None
    longest_pre_trigger_s: float | None = None
    probe: ProbeLimits | None = None
    window_filter: WindowFilterSettings | None = None

    def __post_init__(self) -> None:
        for key in ("servo", "boot"):
            if not re.fullmatch(NAME_PATTERN, getattr(self, key)):
                raise InvalidInput(f"agent {key} = {getattr(self, key)!r}: 1 to 64 of A-Z a-z 0-9 . _ - are allowed")
        if not 0.0 < self.sample_rate < inf:
            raise InvalidInput(f"agent sample_rate = {self.sample_rate!r} Hz: must be greater than 0")
        for key in ("window_s", "pre_trigger_s"):
            _check_whole(key, getattr(self, key), self.sample_rate)
        if self.window_samples < 1:
            raise InvalidInput(f"agent window_s = {self.window_s!r} s: must be at least one sample")
        if not 0 <= self.pre_trigger_samples < self.window_samples:
            allowed = f"must be at least 0 and below window_s = {self.window_s!r} s"
            raise InvalidInput(f"agent pre_trigger_s = {self.pre_trigger_s!r} s: {allowed}")
        self._check_longest()
        if self.window_filter is not None:
            self.window_filter.check(self.sample_rate)
        fallback = self.supervision.fallback
        if self.controller is None and fallback is not None and fallback.setting.gains is not None:
            raise InvalidInput("agent fallback has gains: the agent needs a controller to set them in")

    def _check_longest(self) -> None:
        """What may be requested is at least what is configured, and fits together."""
        for key in ("window_s", "pre_trigger_s"):
            longest, configured = getattr(self, f"longest_{key}"), getattr(self, key)
            if longest is None:
                continue
            _check_whole(f"longest_{key}", longest, self.sample_rate)
            if longest < configured:
                allowed = f"must be at least {key} = {configured!r} s"
                raise InvalidInput(f"agent longest_{key} = {longest!r} s: {allowed}")
        if not self.longest_pre_trigger_samples < self.longest_samples:
            allowed = f"must be below the longest window, {self.longest_samples / self.sample_rate!r} s"
            raise InvalidInput(f"agent longest_pre_trigger_s = {self.longest_pre_trigger_s!r} s: {allowed}")

    @property
    def longest_samples(self) -> int:
        """Samples of the longest window."""
        longest = self.longest_window_s
        return self.window_samples if longest is None else round(longest * self.sample_rate)

    @property
    def longest_pre_trigger_samples(self) -> int:
        """Samples of the longest pre-trigger."""
        longest = self.longest_pre_trigger_s
        return self.pre_trigger_samples if longest is None else round(longest * self.sample_rate)

    @property
    def rest_samples(self) -> int:
        """Samples for which the reference rests before a probing move."""
        return 0 if self.probe is None else max(1, round(self.probe.rest_s * self.sample_rate))

    @property
    def look_samples(self) -> float:
        """Samples after a window at which one is cut where nothing else leads to one; inf: never."""
        if self.window_filter is None:
            return inf
        return max(self.window_samples, self.window_filter.longest_pause_s * self.sample_rate)

    @property
    def window_samples(self) -> int:
        """Samples per window."""
        return round(self.window_s * self.sample_rate)

    @property
    def pre_trigger_samples(self) -> int:
        """Samples before the change."""
        return round(self.pre_trigger_s * self.sample_rate)

    @property
    def period_samples(self) -> int:
        """Samples from one look of the supervisor to the next."""
        return self.supervision.period_samples(self.sample_rate)


def _check_whole(key: str, seconds: float, rate: float) -> None:
    """A duration must be a whole number of samples."""
    samples = seconds * rate
    if not isfinite(samples) or abs(samples - round(samples)) > 1e-6:
        raise InvalidInput(f"agent {key} = {seconds!r} s: must be a whole number of samples at {rate!r} Hz")
