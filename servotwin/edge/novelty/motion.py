"""The screw behind a gap, from the motor's angle: the play operator in plain floats, contacts, how far it was pushed.

Both sensitivities, by the gap and by where the screw began, are constant from one contact to the next.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

Steps = list[tuple[int, float]]
"""(sample, size) of each jump of a piecewise constant signal."""


class Place(NamedTuple):
    """A total gap (rad), and where in it the screw began: -1 behind the motor by half the gap .. 1 ahead of it."""

    gap: float
    place: float

    @property
    def screw(self) -> float:
        """rad from the motor, at the first sample."""
        return 0.5 * self.gap * self.place


class Motion(NamedTuple):
    """The screw behind a gap.

    Attributes
    ----------
    angle : list of float
        (n,) rad.
    contacts : list of (int, int)
        First sample and side (1 forwards, -1 backwards) of each contact on another side than the last.
    """

    angle: list[float]
    contacts: list[tuple[int, int]]

    @property
    def by_start(self) -> Steps:
        """Derivative by the screw's first angle, but for a constant: it ends with the first contact."""
        return [(self.contacts[0][0], -1.0)] if self.contacts else []

    @property
    def by_gap(self) -> Steps:
        """Derivative by the gap: minus a half while pushed forwards, plus a half while pushed backwards."""
        sides = [0, *(side for _, side in self.contacts)]
        return [(at, 0.5 * (old - new)) for (at, _), (old, new) in zip(self.contacts, pairwise(sides), strict=True)]

    def travel(self, unseen: int) -> tuple[float, float]:
        """How far (rad) it went forwards and backwards, but for the last `unseen` samples."""
        return travel(self.angle[: max(1, len(self.angle) - unseen)])


def travel(angle: Sequence[float]) -> tuple[float, float]:
    """How far an angle went up, and how far down."""
    whole, net = sum(map(abs, map(float.__sub__, angle[1:], angle[:-1]))), angle[-1] - angle[0]
    return 0.5 * (whole + net), 0.5 * (whole - net)


def play(theta_m: Sequence[float], place: Place) -> Motion:
    """The screw for the motor's angle (n,) rad, the first of which is 0."""
    gap, half = place.gap, 0.5 * place.gap
    screw, side = place.screw, 0
    low, high = screw - half, screw + half
    angle: list[float] = []
    contacts: list[tuple[int, int]] = []
    for x in theta_m:
        if x > high:
            high, low, screw = x, x - gap, x - half
            if side != 1:
                side = 1
                contacts.append((len(angle), 1))
        elif x < low:
            low, high, screw = x, x + gap, x + half
            if side != -1:
                side = -1
                contacts.append((len(angle), -1))
        angle.append(screw)
    return Motion(angle, contacts)
