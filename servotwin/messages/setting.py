"""Setting of a controller: the dead zone, gains and predicted band that messages carry."""

from math import isfinite
from typing import ClassVar, TypeAlias

import msgspec
from msgspec import Struct

from servotwin.messages.checks import InvalidMessage, require


class Gains(Struct, frozen=True):
    """Gains and thresholds of a controller; its limits and rates stay the edge's.

    Attributes
    ----------
    Kp, Ki, Kd, Tf : float
        V/m, V/(m s), V s/m, s.
    enter, leave : float
        Thresholds of the dead zone, in tolerances.
    feedforward : float
        V.
    integral_only : bool
        True: inside the dead zone only the integral stops; otherwise the loop opens there.
    velocity_feedforward, velocity_time : float
        V s/m, and s of its low-pass filter.
    friction_feedforward : float
        V, with the sign of the reference's last change.
    notch_hz, notch_damping, notch_depth : float
        Centre of the notch (Hz; 0: none), damping ratio of its poles, gain at its centre.
    """

    Kp: float
    Ki: float
    Kd: float
    Tf: float
    enter: float = 1.0
    leave: float = 1.0
    feedforward: float = 0.0
    integral_only: bool = False
    velocity_feedforward: float = 0.0
    velocity_time: float = 0.1
    friction_feedforward: float = 0.0
    notch_hz: float = 0.0
    notch_damping: float = 0.5
    notch_depth: float = 0.1

    scaled: ClassVar[tuple[str, ...]] = ("Kp", "Kd", "Tf")
    """Names of what an edge bounds from below and above; `integral` from above; `fed` by a command."""
    integral: ClassVar[str] = "Ki"
    fed: ClassVar[tuple[str, ...]] = ("feedforward", "friction_feedforward")

    def __post_init__(self) -> None:
        _check_numbers(self, positive=("Tf", "velocity_time"))
        _check_notch(self)


class CascadeGains(Struct, frozen=True, tag="cascade"):
    """Tunable numbers of a cascade; its limits, filters of the reference and low-pass stay the edge's.

    Attributes
    ----------
    position_gain : float
        1/s.
    velocity_gain : float
        Command per speed of the motor, V s/rad; 0: none, for a drive in velocity mode.
    integral_time : float
        s; 0: no integral action.
    speed_filter : float
        s.
    velocity_feedforward : float
        Share of the reference's speed.
    acceleration_feedforward : float
        V s2/rad.
    enter, leave, feedforward, integral_only, notch_hz, notch_damping, notch_depth
        As of `Gains`.
    """

    position_gain: float
    velocity_gain: float = 0.0
    integral_time: float = 0.0
    speed_filter: float = 1e-3
    velocity_feedforward: float = 0.0
    acceleration_feedforward: float = 0.0
    enter: float = 1.0
    leave: float = 1.0
    feedforward: float = 0.0
    integral_only: bool = True
    notch_hz: float = 0.0
    notch_damping: float = 0.5
    notch_depth: float = 0.1

    scaled: ClassVar[tuple[str, ...]] = ("position_gain", "velocity_gain", "speed_filter")
    integral: ClassVar[str] = "integral_gain"
    fed: ClassVar[tuple[str, ...]] = ("feedforward",)

    def __post_init__(self) -> None:
        _check_numbers(self, positive=("speed_filter",))
        _check_notch(self)
        for name in ("position_gain", "velocity_gain", "integral_time"):
            require(getattr(self, name) >= 0.0, f"gains {name} {getattr(self, name)} is negative")
        for name in ("velocity_feedforward", "acceleration_feedforward"):
            require(getattr(self, name) >= 0.0, f"gains {name} {getattr(self, name)} is negative")
        both = self.velocity_gain > 0.0 or self.integral_time == 0.0
        require(both, f"gains integral_time {self.integral_time} needs a velocity_gain")

    @property
    def integral_gain(self) -> float:
        """Command per angle of the motor that the velocity loop integrates, V/rad; 0: none."""
        return self.velocity_gain / self.integral_time if self.integral_time else 0.0


class LinearGains(Struct, frozen=True, tag="linear"):
    """Tunable numbers of any linear law, beside its matrices, which stay the edge's.

    Attributes
    ----------
    gain : float
        Factor on the whole law.
    integral_share : float
        Factor on what its integrators (the states that the dead zone holds) take in; 0: no integral action.
    enter, leave, feedforward, integral_only
        As of `Gains`.
    """

    gain: float = 1.0
    integral_share: float = 1.0
    enter: float = 1.0
    leave: float = 1.0
    feedforward: float = 0.0
    integral_only: bool = True

    scaled: ClassVar[tuple[str, ...]] = ("gain",)
    integral: ClassVar[str] = "integral_gain"
    fed: ClassVar[tuple[str, ...]] = ("feedforward",)

    def __post_init__(self) -> None:
        _check_numbers(self, positive=("gain",))
        require(self.integral_share >= 0.0, f"gains integral_share {self.integral_share} is negative")

    @property
    def integral_gain(self) -> float:
        """Factor on the integral action of the whole law."""
        return self.gain * self.integral_share


AnyGains: TypeAlias = Gains | CascadeGains | LinearGains
"""The numbers of a law that the twin may set."""


def _check_numbers(gains: AnyGains, positive: tuple[str, ...]) -> None:
    """Refuse numbers that are not finite, of the named ones those that are not positive, and thresholds out of
    order."""
    # Not `require`: the sentences would be made for every number of every state of a twin.
    for name in gains.__struct_fields__:
        if not isfinite(getattr(gains, name)):
            raise InvalidMessage(f"gains {name} {getattr(gains, name)} is not finite")
    for name in positive:
        if not getattr(gains, name) > 0.0:
            unit = " s" if name != "gain" else ""
            raise InvalidMessage(f"gains {name} {getattr(gains, name)}{unit} is not positive")
    require(0.0 <= gains.enter <= gains.leave, f"gains enter {gains.enter}, leave {gains.leave}: not in order")


def _check_notch(gains: Gains | CascadeGains) -> None:
    require(gains.notch_hz >= 0.0, f"gains notch_hz {gains.notch_hz} Hz is negative")
    require(0.0 < gains.notch_damping <= 1.0, f"gains notch_damping {gains.notch_damping} is not within 0 and 1")
    require(0.0 <= gains.notch_depth < 1.0, f"gains notch_depth {gains.notch_depth} is not within 0 and 1")


class Band(Struct, frozen=True):
    """Bounds that the loop is predicted to stay within while its reference rests.

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


class Setting(Struct, frozen=True, omit_defaults=True):
    """Dead zone and gains of a controller, and the band that they are predicted to keep.

    Updates, fallbacks, hellos, redesigns and the edge's parameters contain one; everywhere a tolerance of 0 means that
    there is no dead zone.

    Attributes
    ----------
    tolerance : float
        Half-width of the dead zone, m; 0: no dead zone.
    pid : Gains, optional
        Of a filtered PID; "gains" in messages. None: not set here; the gains stay as they are.
    band : Band, optional
        None: nothing is predicted.
    law : CascadeGains or LinearGains, optional
        Of any other law, in place of `pid`.
    """

    tolerance: float
    pid: Gains | None = msgspec.field(default=None, name="gains")
    band: Band | None = None
    law: CascadeGains | LinearGains | None = None

    def __post_init__(self) -> None:
        require(self.pid is None or self.law is None, "setting gains and law: only one of them is allowed")

    @classmethod
    def of(cls, tolerance: float, gains: AnyGains | None = None, band: Band | None = None) -> "Setting":
        """The setting of a law of any kind."""
        return cls(tolerance, None, band).with_gains(gains)

    @property
    def gains(self) -> AnyGains | None:
        """The numbers that it sets beside the dead zone's; None: they stay as they are."""
        return self.law if self.pid is None else self.pid

    def with_gains(self, gains: AnyGains | None) -> "Setting":
        """A copy with other gains."""
        if gains is None or isinstance(gains, Gains):
            return msgspec.structs.replace(self, pid=gains, law=None)
        return msgspec.structs.replace(self, pid=None, law=gains)

    def has_valid_tolerance(self) -> bool:
        """True where the tolerance is finite and not negative."""
        return isfinite(self.tolerance) and self.tolerance >= 0.0

    def same_loop(self, other: "Setting") -> bool:
        """True where gains and dead zone are known and equal; the bands may differ."""
        return self.gains is not None and self.gains == other.gains and self.tolerance == other.tolerance
