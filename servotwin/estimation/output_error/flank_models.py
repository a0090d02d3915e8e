"""Models of a window by the place of one flank, in place of the offset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from servotwin.estimation.output_error.held_chain import HeldChainModel
from servotwin.estimation.output_error.models import HALF, OFFSET, RATIO, Motion, ShaftModel
from servotwin.plant.signals import Array


class Flank(NamedTuple):
    """A flank in place of the offset, as the second unknown of a model.

    Attributes
    ----------
    side : float
        1: the flank on which the motor pushes the load forwards; -1: backwards.
    at : float
        Motor at the load (m or rad) for which the place is that of the driven end, unloaded on that flank.
    """

    side: float = 1.0
    at: float = 0.0

    def less_offset(self, values: Array) -> float:
        """Place of the flank less the offset, for unknowns (u,)."""
        return math.exp(float(values[RATIO])) * (self.at - self.side * float(values[HALF]))

    def with_offset(self, values: Array) -> Array:
        """The unknowns (u,) with the offset as the second one."""
        own = values.copy()
        own[OFFSET] -= self.less_offset(values)
        return own


_UPPER = Flank()


@dataclass(frozen=True)
class FlankOfShaft(ShaftModel):
    """A shaft that is free in the gap, by one of its flanks."""

    flank: Flank = _UPPER

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion:
        """As that of `ShaftModel`."""
        return super().simulate(drive, measured, interval, self.flank.with_offset(values), rate)


@dataclass(frozen=True)
class FlankOfChain(HeldChainModel):
    """A chain behind a screw that the gap holds, by one of its flanks."""

    flank: Flank = _UPPER

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion:
        """As that of `HeldChainModel`."""
        return super().simulate(drive, measured, interval, self.flank.with_offset(values), rate)


OwnModel: TypeAlias = ShaftModel | HeldChainModel
FlankModel: TypeAlias = FlankOfShaft | FlankOfChain


def by_flank(model: OwnModel, flank: Flank) -> FlankModel:
    """The model with a flank in place of its offset."""
    if isinstance(model, ShaftModel):
        return FlankOfShaft(model.axis, model.priors, model.learnt, model.friction, flank)
    return FlankOfChain(model.axis, model.priors, model.friction, flank)
