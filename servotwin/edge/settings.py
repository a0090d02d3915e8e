"""Settings of one servo's agent and of its supervision."""

import re
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Annotated

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import check, key, settings
from servotwin.config.own_units import VOLTS_METRES, OwnUnits
from servotwin.control.cascade import Cascade
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.watch import WatchSettings
from servotwin.edge.window_filter import WindowFilterSettings
from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN, AnyGains
from servotwin.runtime.retry import Retry

_MOST_SAMPLES = 10_000_000
"""Samples in the ring buffer; of four channels 320 MB."""
_LONGEST_VERSION = 256
"""Characters that a message allows."""


@settings("supervision")
@dataclass(frozen=True, slots=True)
class Supervision:
    """Supervision of the control loop by the edge, and its fallback set.

    Parameters
    ----------
    fallback : FallbackSet, optional
        Setting that it falls back to; None: it does not.
    """

    fallback: FallbackSet | None = None
    watch: Annotated[
        WatchSettings | None,
        key(
            switch="watched",
            help="What counts as evidence against the parameters in force; watched = false: nothing that the loop "
            "does.",
        ),
    ] = field(default_factory=WatchSettings)
    period_s: Annotated[
        float, key(above=0.0, help="Period of the supervisor; a whole number of the watch's slots, at least one.")
    ] = 0.05

    def __post_init__(self) -> None:
        check(self)

    def period_samples(self, rate: float) -> int:
        """Samples from one look to the next, at `rate` Hz."""
        slot = 1 if self.watch is None else max(1, round(self.watch.slot_s * rate))
        return slot * max(1, round(self.period_s * rate / slot))


@settings("agent")
@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Settings of one servo's agent.

    Parameters
    ----------
    boot : str
        Name of the boot; a new one for each start of the edge.
    parameters : Parameters
        In force at the start.
    controller : Controller, Cascade or LinearLaw, optional
        As configured: what updates start from, and the limits and filters that they do not change. None: updates set
        the tolerance only.
    own : gains, optional
        The servo's own gains, from which the limits of updates count; None: the controller's.
    supervision : Supervision
    window_filter : WindowFilterSettings, optional
        Chooses which windows are sent; None: all are.
    units : OwnUnits
        Of the machine, for what is said of refused gains.
    """

    servo: Annotated[str, key(help="Name of the servo.")]
    boot: str
    sample_rate: Annotated[float, key("sample_rate_hz", above=0.0, help="Rate of the samples.")]
    window_s: Annotated[
        float, key(table="window", above=0.0, help="Length of a window, a whole number of samples.")
    ] = 1.0
    pre_trigger_s: Annotated[
        float,
        key(
            table="window",
            minimum=0.0,
            help="Part of a window before the change of the reference, a whole number of samples below window_s.",
        ),
    ] = 0.0
    retry: Annotated[Retry, key(help="When an unacknowledged window is sent again.")] = field(default_factory=Retry)
    limits: Annotated[Limits, key(help="Limits that updates must respect.")] = field(default_factory=Limits)
    parameters: Parameters = field(default_factory=Parameters)
    fine_angle: Annotated[
        bool, key(table="window", help="Send theta_m with 32 bits instead of 16 (as a second channel).")
    ] = False
    reference: Annotated[
        float,
        key(
            "reference_mm",
            "reference_m",
            help="Reference before the first sample; the first sample is a change when it differs.",
        ),
    ] = 0.0
    model_version: Annotated[str, key(help="Version of the servo's model, as `Servo.version`.")] = ""
    controller: AnyController | None = None
    own: AnyGains | None = None
    supervision: Supervision = field(default_factory=Supervision)
    longest_window_s: Annotated[
        float | None,
        key(table="window", above=0.0, help="Longest window that the twin may request; window_s where absent."),
    ] = None
    longest_pre_trigger_s: Annotated[
        float | None,
        key(table="window", minimum=0.0, help="Longest pre-trigger that it may request; pre_trigger_s where absent."),
    ] = None
    probe: Annotated[
        ProbeLimits | None,
        key(help="Probing moves of the reference that the twin may request; none where absent."),
    ] = None
    window_filter: WindowFilterSettings | None = None
    motor_encoder: Annotated[
        bool,
        key(
            later=True,
            help="false: the motor has no encoder, and windows have no theta_m; the command is then sent with 32 bits.",
        ),
    ] = True
    units: OwnUnits = field(default=VOLTS_METRES, compare=False)

    def __post_init__(self) -> None:
        for name in ("servo", "boot"):
            if not re.fullmatch(NAME_PATTERN, getattr(self, name)):
                raise InvalidInput(f"agent {name} = {getattr(self, name)!r}: 1 to 64 of A-Z a-z 0-9 . _ - are allowed")
        check(self)
        if len(self.model_version) > _LONGEST_VERSION:
            raise InvalidInput(f"agent model_version: must be at most {_LONGEST_VERSION} characters")
        for name in ("window_s", "pre_trigger_s"):
            _check_whole(name, getattr(self, name), self.sample_rate)
        if self.window_samples < 1:
            raise InvalidInput(f"agent window_s = {self.window_s!r} s: must be at least one sample")
        if not self.pre_trigger_samples < self.window_samples:
            raise contradiction(self, "{0}: must be below {1}", "pre_trigger_s", "window_s")
        self._check_longest()
        self._check_memory()
        self._check_notch()
        self._check_ranges()
        if self.window_filter is not None:
            if not self.motor_encoder:
                raise InvalidInput(
                    "agent motor_encoder = false: [novelty], which compares the motor's angle with the load, needs an "
                    "encoder of the motor; leave it out"
                )
            self.window_filter.check(self.sample_rate)
        fallback = self.supervision.fallback
        if self.controller is None and fallback is not None and fallback.setting.gains is not None:
            raise InvalidInput("agent fallback has gains: the agent needs a controller to set them in")

    def _check_notch(self) -> None:
        """Check that no update may set a notch that the controller cannot have."""
        law = self.controller
        if not isinstance(law, Cascade) or law.sample_rate is None:
            return
        if not self.limits.notch_max_hz < 0.5 * law.sample_rate:
            rule = f"{{0}}: must be below half of the controller's {law.sample_rate!r} Hz"
            raise contradiction(self, rule, "limits.notch_max_hz")

    def _check_ranges(self) -> None:
        """Check that the ranges of gains are for numbers of the controller, and leave each of them some room."""
        if self.controller is None:
            return
        own = self.own or gains_of(self.controller)
        for name in self.limits.ranges:
            if name not in own.scaled:
                rule = f"{{0}}: the controller has no {name}; give ranges of {', '.join(own.scaled)}"
                raise contradiction(self, rule, f"limits.{name}")
            lowest, highest = self.limits.range_of(name, own)
            if lowest > highest:
                rule = f"{{0}}: must reach to the side of zero of the servo's own {getattr(own, name)!r}"
                raise contradiction(self, rule, f"limits.{name}")

    def _check_longest(self) -> None:
        """Check that the longest window and pre-trigger are at least the configured ones, and fit together."""
        for name in ("window_s", "pre_trigger_s"):
            longest, configured = getattr(self, f"longest_{name}"), getattr(self, name)
            if longest is None:
                continue
            _check_whole(f"longest_{name}", longest, self.sample_rate)
            if longest < configured:
                raise contradiction(self, "{0}: must be at least {1}", f"longest_{name}", name)
        if not self.longest_pre_trigger_samples < self.longest_samples:
            allowed = f"must be below the longest window, {self.longest_samples / self.sample_rate!r} s"
            raise InvalidInput(f"agent longest_pre_trigger_s = {self.longest_pre_trigger_s!r} s: {allowed}")

    def _check_memory(self) -> None:
        """Check that the samples that are kept fit into memory."""
        if self.kept_samples > _MOST_SAMPLES:
            raise InvalidInput(
                f"agent window_s, longest_window_s, rest_s of a probe or period_s of the supervision keep "
                f"{self.kept_samples:g} samples at {self.sample_rate!r} Hz: must be at most {_MOST_SAMPLES}"
            )

    @property
    def kept_samples(self) -> int:
        """Number of the last samples that the agent keeps."""
        return max(self.longest_samples + 1, self.period_samples, self.rest_samples)

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


def _check_whole(name: str, seconds: float, rate: float) -> None:
    """A duration must be a whole number of samples."""
    samples = seconds * rate
    if not isfinite(samples) or abs(samples - round(samples)) > 1e-6:
        raise InvalidInput(f"agent {name} = {seconds!r} s: must be a whole number of samples at {rate!r} Hz")
