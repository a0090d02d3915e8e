"""The structure's response as the twin has learnt it, to edges whose windows say that they can use one."""

from math import hypot, isfinite
from typing import Annotated

from msgspec import Meta, Struct

from servotwin.messages.checks import Name, all_finite, require


class LearntResponse(Struct, frozen=True, tag="response/1"):
    """Response of the structure, screw angle to position of the last mass, at one sample rate.

    Attributes
    ----------
    version : int
        Number of the response, above those before it; a window names the one that its filter used.
    rate : float
        Hz.
    modes : tuple of (float, float, float, float)
        Of one of each conjugate pair: real and imaginary part of exp(pole T), and of the gain that reads the position
        off its state, m/rad.
    direct, static_gain : float
        m/rad: position over angle at once, and at rest.
    unseen : float
        s: motion of the screw so late in a window has not reached the last mass.
    gap : float
        rad, total, of the window from which it was learnt: where the search of the next one begins.
    gap_std : float
        rad, standard deviation of a window's gap that is due to what is not known of the structure.
    """

    servo: Name
    version: Annotated[int, Meta(ge=1, le=2**53)]
    rate: float
    modes: Annotated[tuple[tuple[float, float, float, float], ...], Meta(min_length=1, max_length=64)]
    direct: float
    static_gain: float
    unseen: float
    gap: float
    gap_std: float

    def __post_init__(self) -> None:
        require(isfinite(self.rate) and self.rate > 0.0, f"response rate {self.rate} Hz is not positive")
        numbers = (self.direct, self.static_gain, *(value for mode in self.modes for value in mode))
        require(all_finite(numbers), "response modes and gains must be finite")
        require(all(hypot(*mode[:2]) < 1.0 for mode in self.modes), "response modes must all decay")
        require(self.static_gain != 0.0, "response static_gain 0 m/rad is not allowed")
        require(isfinite(self.unseen) and self.unseen >= 0.0, f"response unseen {self.unseen} s is not allowed")
        require(isfinite(self.gap) and self.gap >= 0.0, f"response gap {self.gap} rad is not allowed")
        require(isfinite(self.gap_std) and self.gap_std >= 0.0, f"response gap_std {self.gap_std} rad is not allowed")
