"""Setting of a controller: the dead zone, gains and predicted band that messages carry."""

from math import isfinite

from msgspec import Struct

from servotwin.messages.checks import require


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

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require(isfinite(getattr(self, name)), f"gains {name} {getattr(self, name)} is not finite")
        for name in ("Tf", "velocity_time"):
            require(getattr(self, name) > 0.0, f"gains {name} {getattr(self, name)} s is not positive")
        require(self.notch_hz >= 0.0, f"gains notch_hz {self.notch_hz} Hz is negative")
        require(0.0 < self.notch_damping <= 1.0, f"gains notch_damping {self.notch_damping} is not within 0 and 1")
        require(0.0 <= self.notch_depth < 1.0, f"gains notch_depth {self.notch_depth} is not within 0 and 1")
        require(0.0 <= self.enter <= self.leave, f"gains enter {self.enter}, leave {self.leave}: not in order")


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
    gains : Gains, optional
        None: not set here; the gains stay as they are.
    band : Band, optional
        None: nothing is predicted.
    """

    tolerance: float
    gains: Gains | None = None
    band: Band | None = None

    def has_valid_tolerance(self) -> bool:
        """True where the tolerance is finite and not negative."""
        return isfinite(self.tolerance) and self.tolerance >= 0.0

    def same_loop(self, other: "Setting") -> bool:
        """True where gains and dead zone are known and equal; the bands may differ."""
        return self.gains is not None and self.gains == other.gains and self.tolerance == other.tolerance
