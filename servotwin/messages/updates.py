"""Updates of the parameters, to the edge; receipts and fallbacks, back."""

from enum import StrEnum
from math import isfinite
from typing import Annotated

from msgspec import Meta, Struct

from servotwin.messages.checks import Count, Name, Reported, Text, all_finite, require
from servotwin.messages.setting import Gains, Setting


class Reason(StrEnum):
    """Decision of the edge about an update."""

    APPLIED = "applied"
    WRONG_SERVO = "wrong servo"
    OTHER_BOOT = "stands on a window of another boot"
    OLD_VERSION = "version not newer than the one in force"
    BASE_MISMATCH = "base is not the version in force"
    OLD_DATA = "data not newer than that of the version in force"
    FUTURE_DATA = "data from the future"
    EXPIRED = "expired"
    OUT_OF_BOUNDS = "tolerance out of bounds"
    STEP_TOO_LARGE = "tolerance changes too much at once"
    TOO_SOON = "too soon after the previous update"
    GAINS_OUT_OF_BOUNDS = "gains out of bounds"
    GAINS_STEP_TOO_LARGE = "gains change too much at once"
    NO_GAINS = "this edge changes no gains"
    SUPERSEDED = "a newer update came before it could be applied"
    AFTER_FALLBACK = "too soon after a fallback"
    FELL_BACK = "the edge fell back meanwhile"
    TAKEN_OVER = "another edge of the servo has taken over"
    NOT_KNOWN = "needs what this edge does not know"


class Cause(StrEnum):
    """Cause of a fallback."""

    LIMIT_CYCLE = "limit cycle"
    ERROR = "error outside the predicted band"
    ERROR_ENERGY = "error energy outside the predicted band"
    EFFORT = "effort outside the predicted band"
    SILENCE = "the twin is silent"
    DRIVE = "the drive does not take the parameters"
    CONFLICT = "another edge of the servo has taken over"


class Verification(Struct, frozen=True):
    """Result of simulating a setting before it is sent; another twin computes the same numbers.

    Attributes
    ----------
    members, looked_at : int
        Machines that the setting was tried on; settings simulated until this one was chosen.
    settled : float
        Share of the machines that settled.
    tail, overshoot : float
        Largest of all machines: error at the end, m; overshoot as a share of the step.
    Ms, crossover, phase_margin : float
        Of the model without a gap: the sensitivity's peak; rad/s and rad.
    saturated : bool
        True where a machine reached the voltage limit.
    settled_least, confidence : float
        Lower bound of the share that settles, and its confidence; 0 in those of versions that had none.
    Ms_worst, phase_margin_worst : float
        Worst of all plants in the uncertainty, at the controller's own rate: peak, and rad; 0 in those of versions that
        had none.
    """

    members: Count
    looked_at: Count
    settled: float
    tail: float
    overshoot: float
    Ms: float
    crossover: float
    phase_margin: float
    saturated: bool
    settled_least: float = 0.0
    confidence: float = 0.0
    Ms_worst: float = 0.0
    phase_margin_worst: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require(isfinite(getattr(self, name)), f"verification {name} {getattr(self, name)} is not finite")
        require(0.0 <= self.settled <= 1.0, f"verification settled {self.settled} is no share")


class Update(Struct, frozen=True, omit_defaults=True, tag="update/2"):
    """New parameters for the edge, and the estimate that they are based on.

    Attributes
    ----------
    version, base_version : int
        Number of the update, and of the version that it replaces (compare-and-swap).
    window : (str, int)
        (boot, sequence) of the window that it is based on.
    data_time : float
        Sample time of that window's first sample, s.
    gap, std, interval : float, float, (float, float)
        The estimate, rad; None where unknown or unbounded.
    status : str
        The estimate's status.
    setting : Setting
        Dead zone, gains and predicted band; gains None: the gains stay.
    not_after : float
        Sample time of the edge, s, from which on the update must not be applied.
    verification : Verification, optional
        Result of simulating the setting; None: it was not verified.
    needs : tuple of str
        Fields of the gains that an edge has to know to apply them: `needed_fields` of the setting. An update with some
        travels as update/3, which edges that do not read this list take for a message that they do not know.
    """

    servo: Name
    version: Annotated[int, Meta(ge=1, le=2**53)]
    base_version: Count
    window: tuple[Name, Count]
    data_time: float
    gap: float | None
    std: float | None
    interval: tuple[float | None, float | None]
    status: Text
    setting: Setting
    not_after: float
    verification: Verification | None = None
    needs: Annotated[tuple[Annotated[str, Meta(max_length=64)], ...], Meta(max_length=64)] = ()

    def __post_init__(self) -> None:
        require(isfinite(self.data_time), f"update data_time {self.data_time} s is not finite")
        require(isfinite(self.not_after), f"update not_after {self.not_after} s is not finite")
        tolerance = self.setting.tolerance
        require(self.setting.has_valid_tolerance(), f"update tolerance {tolerance} m is not allowed")
        known = (x for x in (self.gap, self.std, *self.interval) if x is not None)
        require(all_finite(known), "update gap, std and interval must be finite, or None where unknown or unbounded")


class UpdateWithNeeds(Update, frozen=True, omit_defaults=True, tag="update/3"):
    """An update whose `needs` are not empty, as it travels; `servotwin.messages.codec` alone makes and reads it."""


_EVERY_VERSION = frozenset(
    ("Kp", "Ki", "Kd", "Tf", "enter", "leave", "feedforward", "integral_only", "velocity_feedforward", "velocity_time")
)
"""Fields of the gains that edges of every version know."""
_LAW = "law"
"""Gains of a law other than the filtered PID: edges of versions before would set the dead zone alone."""
KNOWN_FIELDS = frozenset((*Gains.__struct_fields__, _LAW))
"""Fields of a setting that this version knows."""


def needed_fields(setting: Setting) -> tuple[str, ...]:
    """Fields without which the gains of a setting would be others: all that not every version knows, and that count."""
    gains = setting.gains
    if not isinstance(gains, Gains):
        return () if gains is None else (_LAW,)
    first = len(gains.__struct_fields__) - len(gains.__struct_defaults__)
    defaults = dict(zip(gains.__struct_fields__[first:], gains.__struct_defaults__, strict=True))
    later = (name for name in gains.__struct_fields__ if name not in _EVERY_VERSION)
    return tuple(name for name in later if getattr(gains, name) != defaults.get(name))


class Receipt(Struct, frozen=True, omit_defaults=True, tag="receipt/1"):
    """Receipt for an update: applied or refused.

    Attributes
    ----------
    version : int
        The update's.
    applied : bool
    sample : int
        First sample under the new parameters, or the sample at which it was refused.
    reason : Reason
    parameter_version : int
        Version in force after the decision, on which the twin has to base its next update.
    boot : str
    detail : str
        The number that is out of bounds, and what is allowed; empty: the reason says it all.
    """

    servo: Name
    version: Count
    applied: bool
    sample: Count
    reason: Reason
    parameter_version: Reported
    boot: Name
    detail: Annotated[str, Meta(max_length=256, pattern=r"\A[ -~]*\Z")] = ""


class Fallback(Struct, frozen=True, tag="fallback/2"):
    """Notice that the edge left the parameters in force for its fallback set, on its own evidence.

    Attributes
    ----------
    sample : int
        First sample under the fallback set.
    cause : Cause
    measured, allowed : float
        The measured and the allowed value: m, V or s, as the cause says; 0 where a drive refused the parameters.
    replaced : int
        The version that was in force.
    parameter_version : int
        Version of the fallback set, on which the twin has to base its next update.
    setting : Setting
        The fallback set; gains None: the gains stayed.
    """

    servo: Name
    boot: Name
    sample: Count
    cause: Cause
    measured: float
    allowed: float
    replaced: Count
    parameter_version: Reported
    setting: Setting

    def __post_init__(self) -> None:
        require(all_finite((self.measured, self.allowed)), "fallback measured and allowed must be finite")
        require(self.setting.has_valid_tolerance(), f"fallback tolerance {self.setting.tolerance} m is not allowed")
