"""What a setting has to hold for, as the evidence leaves it open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from servotwin.messages import Setting
from servotwin.redesign.certified.certificate import Certificate, Refusal
from servotwin.redesign.certified.uncertainty import Range, Uncertainty


@dataclass(frozen=True)
class Region:
    """The machines that evidence allows, but for what is known of them before any.

    Attributes
    ----------
    gap : (float, float)
        rad, total.
    feedforward : float
        V: part of the setting.
    input_bias, friction : (float, float)
        V, N m.
    noise : float
        m rms of the measured position; 0 where nobody could tell.
    """

    gap: Range
    feedforward: float
    input_bias: Range
    friction: Range
    noise: float

    def within(self, known: Uncertainty) -> Uncertainty:
        """What is known before, narrowed to the region."""
        return known.replace(gap=self.gap, input_bias=self.input_bias, friction=self.friction)

    @property
    def largest_bias(self) -> float:
        """V: the most that input bias and feedforward leave together."""
        return max(abs(bias + self.feedforward) for bias in self.input_bias)


class Prover(Protocol):
    """Knows what holds in a region.

    Attributes
    ----------
    owes : bool
        Whether what it knows stands on wider regions, and the exact proof is still to come.
    """

    @property
    def owes(self) -> bool: ...

    def prove(self, region: Region, running: Setting | None) -> Certificate | Refusal:
        """A setting that holds there, or why there is none; `running` is in force, where that is known."""
        ...

    def fallback(self) -> Certificate:
        """What holds for the whole stated range."""
        ...
