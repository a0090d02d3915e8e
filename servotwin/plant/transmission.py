"""Transmission from the motor's shaft to the load: ratio, backlash, and the shaft's or screw's own elasticity."""

from __future__ import annotations

import math
from dataclasses import dataclass

from servotwin.errors import InvalidInput
from servotwin.plant.basis import BacklashKind
from servotwin.plant.numbers import a_number

HELD, FREE = BacklashKind.HELD.value, BacklashKind.FREE.value


@dataclass(frozen=True)
class Transmission:
    """Screw or gear with backlash between the motor and its elastic part.

    Parameters
    ----------
    p : float
        Travel of the load per angle of the motor: m/rad of a linear axis, rad/rad of a rotary one. The total gap counts
        at the motor; divide one that was measured at the load by p.
    k_d, c_d : float
        Stiffness and damping between the driven end and the first mass, seen from the load: N/m and N s/m, of a rotary
        axis N m/rad and N m s/rad. Where the gap holds the driven end, both act on the load at all times, and on the
        motor in contact. Infinite stiffness: the first mass is the driven end, and its load does not act back on the
        motor.
    in_gap : {"held", "free"}
        The driven end inside the gap: "held" where it is by its own friction (the paper's screw), or "free" to follow
        the load, with no force through the gap (the two-mass system with a dead zone).

    Raises
    ------
    InvalidInput
        A value out of its range, a rigid transmission that is free in the gap, or damping of a rigid one.
    """

    p: float
    k_d: float = math.inf
    c_d: float = 0.0
    in_gap: str = HELD

    def __post_init__(self) -> None:
        for name in ("p", "k_d", "c_d"):
            object.__setattr__(self, name, a_number("transmission", name, getattr(self, name)))
        for name, value, finite in (("p", self.p, True), ("k_d", self.k_d, False)):
            if not value > 0.0 or (finite and math.isinf(value)):
                allowed = "positive and finite" if finite else "positive; inf means rigid"
                raise InvalidInput(f"transmission {name} = {value!r}: must be {allowed}")
        if not (math.isfinite(self.c_d) and self.c_d >= 0.0):
            raise InvalidInput(f"transmission c_d = {self.c_d!r}: must be finite and 0 or more")
        if self.in_gap not in (HELD, FREE):
            raise InvalidInput(f'transmission in_gap = {self.in_gap!r}: must be "held" or "free"')
        if self.in_gap == FREE and self.rigid:
            raise InvalidInput(
                'transmission in_gap = "free": needs a finite stiffness k_d; a rigid transmission is held in the gap'
            )
        if self.c_d > 0.0 and self.rigid:
            raise InvalidInput(
                f"transmission damping (c_d) = {self.c_d!r}: needs a finite k_d; a rigid transmission has none"
            )

    @property
    def rigid(self) -> bool:
        """True where the first mass is the driven end."""
        return math.isinf(self.k_d)

    @property
    def backlash_kind(self) -> BacklashKind:
        """Kind of the backlash."""
        if self.in_gap == FREE:
            return BacklashKind.FREE
        return BacklashKind.RIGID if self.rigid else BacklashKind.HELD
