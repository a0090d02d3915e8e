"""Limits of updates: pure checks of tolerance and gains against those in force and the servo's own."""

from dataclasses import dataclass
from math import inf

from servotwin.errors import InvalidInput
from servotwin.messages import Gains

_SCALED = ("Kp", "Ki", "Kd", "Tf")
_POSITIVE = ("max_step", "max_rate", "lifetime_s")
_FACTORS = ("gain_factor", "gain_step", "gain_rate")
_TIMES = ("interval_s", "patience_s")


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that an update must respect.

    Parameters
    ----------
    minimum, maximum : float
        Tolerance, m.
    max_step : float
        Largest change of the tolerance by one update, m.
    lifetime_s : float
        The data may be this old when the update is applied, whatever the update itself says.
    interval_s : float
        Shortest time between two applied updates.
    max_rate : float
        Largest change of the tolerance per second since the last update, m/s.
    gain_factor : float
        Kp, Kd and Tf stay within this factor of the servo's own, either way; `leave` from above.
    integral_factor : float
        Largest Ki, in the servo's own: integral action is what makes a loop with a gap cycle. 0: none.
    gain_step, gain_rate : float
        Largest factor by which one update may change a gain, and by how much per second since the last update. Ki may
        fall at once. A gain counts as at least the box's lower edge, so that Ki can leave zero.
    feedforward : float
        Largest feedforward, V, either sign.
    patience_s : float
        How long an update waits for an instant at which the change of the dead zone neither opens nor closes the loop;
        after that it is applied wherever the error is. 0: at once.
    """

    minimum: float = 0.0
    maximum: float = inf
    max_step: float = inf
    lifetime_s: float = inf
    interval_s: float = 0.0
    max_rate: float = inf
    gain_factor: float = 4.0
    integral_factor: float = 1.0
    gain_step: float = inf
    gain_rate: float = inf
    feedforward: float = 0.25
    patience_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.minimum <= self.maximum or self.minimum == inf:
            raise InvalidInput(
                f"limits on the tolerance {self.minimum!r} m to {self.maximum!r} m: must be 0 or more and in order"
            )
        for name in _POSITIVE:
            if not getattr(self, name) > 0.0:
                raise InvalidInput(f"limits {name} = {getattr(self, name)!r}: must be greater than 0")
        for name in _FACTORS:
            if not getattr(self, name) >= 1.0:
                raise InvalidInput(f"limits {name} = {getattr(self, name)!r}: must be at least 1")
        for name in _TIMES:
            if not 0.0 <= getattr(self, name) < inf:
                raise InvalidInput(f"limits {name} = {getattr(self, name)!r} s: must be at least 0")
        for name in ("integral_factor", "feedforward"):
            if not getattr(self, name) >= 0.0:
                raise InvalidInput(f"limits {name} = {getattr(self, name)!r}: must be at least 0")

    def allows_tolerance(self, tolerance: float) -> bool:
        """True where a tolerance (m) is in bounds."""
        return self.minimum <= tolerance <= self.maximum

    def allows_tolerance_step(self, old: float, new: float, since: float) -> bool:
        """True where the tolerance (m) may change so far, `since` seconds after the last change."""
        return abs(new - old) <= self.max_step and (self.max_rate == inf or abs(new - old) <= self.max_rate * since)

    def allows_gains(self, gains: Gains, own: Gains) -> bool:
        """True where gains lie in the box around the servo's own."""
        scaled = all(self._in_box(name, getattr(gains, name), getattr(own, name)) for name in _SCALED)
        return scaled and gains.leave <= self.gain_factor * own.leave and abs(gains.feedforward) <= self.feedforward

    def allows_gains_step(self, old: Gains, new: Gains, own: Gains, since: float) -> bool:
        """True where gains may change so far, `since` seconds after the last change."""
        factor = self.gain_step if self.gain_rate == inf else min(self.gain_step, _power(self.gain_rate, since))
        if factor == inf:
            return True
        return all(
            _in_step(name, getattr(old, name), getattr(new, name), abs(getattr(own, name)) / self.gain_factor, factor)
            for name in _SCALED
        )

    def _in_box(self, name: str, value: float, own: float) -> bool:
        if name == "Ki":
            return value * own >= 0.0 and abs(value) <= abs(own) * self.integral_factor
        return value * own >= 0.0 and abs(own) <= self.gain_factor * abs(value) <= self.gain_factor**2 * abs(own)


def _in_step(name: str, old: float, new: float, smallest: float, factor: float) -> bool:
    rises_little = abs(new) <= factor * max(abs(old), smallest)
    return rises_little and (name == "Ki" or abs(new) * factor >= abs(old))


def _power(base: float, exponent: float) -> float:
    try:
        return base**exponent
    except OverflowError:
        return inf
