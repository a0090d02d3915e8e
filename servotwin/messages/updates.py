"""To the edge: updates; back: receipts, and word of a fallback."""

from enum import StrEnum
from math import isfinite
from typing import Annotated

from msgspec import Meta, Struct

from servotwin.messages.checks import Count, Name, Text, all_finite, require


class Reason(StrEnum):
    """What the edge did with an update."""

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


class Cause(StrEnum):
    """Why the edge left the twin's parameters."""

    LIMIT_CYCLE = "limit cycle"
    ERROR = "error outside the predicted band"
    ERROR_ENERGY = "error energy outside the predicted band"
    EFFORT = "effort outside the predicted band"
    SILENCE = "the twin is silent"
    DRIVE = "the drive does not take the parameters"


class Gains(Struct, frozen=True):
    """What of a controller an update may set; limits and rates stay the edge's.

    Attributes
    ----------
    Kp, Ki, Kd, Tf : float
        V/m, V/(m s), V s/m, s.
    enter, leave : float
        Thresholds of the dead zone, in tolerances.
    feedforward : float
        V.
    """

    Kp: float
    Ki: float
    Kd: float
    Tf: float
    enter: float = 1.0
    leave: float = 1.0
    feedforward: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require(isfinite(getattr(self, name)), f"gains {name} {getattr(self, name)} is not finite")
        require(self.Tf > 0.0, f"gains Tf {self.Tf} s is not positive")
        require(0.0 <= self.enter <= self.leave, f"gains enter {self.enter}, leave {self.leave}: not in order")


class Band(Struct, frozen=True):
    """What the loop is predicted to stay within while its reference rests.

    Attributes
    ----------
    error : float
        Largest tracking error, m.
    error_rms : float
        m.
    effort : float
        Root mean square of the voltage, V.
    settling : float
        s after a change of the reference from which on the band holds.
    """

    error: float
    error_rms: float
    effort: float
    settling: float

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            require(isfinite(value) and value >= 0.0, f"band {name} {value} is not allowed")


class Proof(Struct, frozen=True):
    """What a setting showed in simulation before it was sent; numbers that another twin finds again.

    Attributes
    ----------
    members, looked_at : int
        Machines that the setting was tried on; settings simulated until this one was chosen.
    settled : float
        Share of the machines that settled.
    tail, overshoot : float
        Worst of all: m, error in the end; per step.
    Ms, crossover, phase_margin : float
        Of the model without a gap: the sensitivity's peak; rad/s and rad.
    saturated : bool
        Whether a machine met the voltage limit.
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

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require(isfinite(getattr(self, name)), f"proof {name} {getattr(self, name)} is not finite")
        require(0.0 <= self.settled <= 1.0, f"proof settled {self.settled} is no share")


class Update(Struct, frozen=True, omit_defaults=True, tag="update/1"):
    """New parameters for the edge, and what they stand on.

    Attributes
    ----------
    version, base_version : int
        Its own number; the version it replaces (compare-and-swap).
    window : (str, int)
        (boot, sequence) of the window it stands on.
    data_time : float
        Sample time of that window's first sample, s.
    gap, std, interval : float, float, (float, float)
        The estimate, rad; None where unknown or unbounded.
    status : str
        The estimate's status.
    tolerance : float
        Dead-zone half-width, m; 0: no dead zone.
    not_after : float
        Sample time of the edge from which on it must not be applied, s.
    controller : Gains, optional
        None: the gains stay.
    band : Band, optional
        What the loop is predicted to stay within; None: nothing is predicted.
    proof : Proof, optional
        What the setting showed in simulation; None: nothing was proved.
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
    tolerance: float
    not_after: float
    controller: Gains | None = None
    band: Band | None = None
    proof: Proof | None = None

    def __post_init__(self) -> None:
        require(isfinite(self.data_time), f"update data_time {self.data_time} s is not finite")
        require(isfinite(self.not_after), f"update not_after {self.not_after} s is not finite")
        require(
            isfinite(self.tolerance) and self.tolerance >= 0.0, f"update tolerance {self.tolerance} m is not allowed"
        )
        known = (x for x in (self.gap, self.std, *self.interval) if x is not None)
        require(all_finite(known), "update gap, std and interval must be finite, or None where unknown or unbounded")


class Receipt(Struct, frozen=True, tag="receipt/1"):
    """What the edge did with an update.

    Attributes
    ----------
    version : int
        The update's.
    applied : bool
    sample : int
        First sample under the new parameters, or the sample at which it was refused.
    reason : Reason
    parameter_version : int
        In force after the decision: what the twin has to base its next update on.
    boot : str
    """

    servo: Name
    version: Count
    applied: bool
    sample: Count
    reason: Reason
    parameter_version: Count
    boot: Name


class Fallback(Struct, frozen=True, tag="fallback/1"):
    """The edge left the parameters in force for its own fallback set, on its own evidence.

    Attributes
    ----------
    sample : int
        First sample under the fallback set.
    cause : Cause
    measured, allowed : float
        What was seen and what was allowed: m, V or s, as the cause says; 0 where it is a drive's refusal.
    replaced : int
        The version that was in force.
    parameter_version : int
        The fallback set's: what the twin has to base its next update on.
    tolerance : float
        Of the fallback set, m.
    controller : Gains, optional
        Of the fallback set; None: the gains stayed.
    """

    servo: Name
    boot: Name
    sample: Count
    cause: Cause
    measured: float
    allowed: float
    replaced: Count
    parameter_version: Count
    tolerance: float
    controller: Gains | None = None

    def __post_init__(self) -> None:
        require(
            all_finite((self.measured, self.allowed, self.tolerance)),
            "fallback measured, allowed and tolerance must be finite",
        )
