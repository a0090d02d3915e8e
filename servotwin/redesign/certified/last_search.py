"""Memory of the last search: the ranges that it was asked about, and its result.

Where it found nothing, another search for nearly the same ranges, or for wider ones, would take as long and find
nothing either, or a setting that passes by chance: the more often one is drawn anew, the more likely is a draw without
its failures. Where it found a setting, this is still the cheapest for nearly the same ranges, or hardly dearer.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import replace

from msgspec import Struct

import servotwin
from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.learning.motor import BACK_EMF, LAG, LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.assess import NEAR
from servotwin.redesign.certified.certify import known_bias
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.fallback import flattened
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import LearntFactors, Range, Region, Uncertainty
from servotwin.redesign.design import Design

# A range is as wide as one whose ends are further out by up to that much of the largest end, or of the unit.
_NOTICEABLE = 0.1


class Asked(Struct, frozen=True):
    """Question of a search.

    Attributes
    ----------
    of : str
        Digest of everything else on which the result depends: model, stated ranges, demands, trial, version.
    ranges : dict of str to (float, float)
        Ranges that the evidence leaves, by name, each in a unit below which it does not matter.
    """

    of: str
    ranges: dict[str, Range]

    def contains(self, other: Asked) -> bool:
        """True where these ranges contain those of another question, but for what is not noticeable."""
        return (
            self.of == other.of
            and self.ranges.keys() == other.ranges.keys()
            and all(_contains(mine, other.ranges[name]) for name, mine in self.ranges.items())
        )

    def alike(self, other: Asked) -> bool:
        """True where another question is nearly the same."""
        return self.contains(other) and other.contains(self)


class LastSearch(Struct, frozen=True):
    """Question of the last search, the setting that it found, and the reason where it found none."""

    asked: Asked
    found: Design | None = None
    reason: str = ""

    def fails(self, asked: Asked) -> bool:
        """True where it found nothing, and this question is no narrower."""
        return self.found is None and asked.contains(self.asked)

    def finds(self, asked: Asked) -> Design | None:
        """The setting that it found, where this question is nearly the same."""
        return self.found if asked.alike(self.asked) else None


def digest_of(servo: Plant, uncertainty: Uncertainty, demands: Demands, trial: Trial) -> str:
    """Digest of the constant parts of a question."""
    values = {"servo": servo, "uncertainty": uncertainty, "demands": demands, "trial": replace(trial, threads=None)}
    parts = [part for name, value in values.items() for part in flattened(name, value)]
    return hashlib.sha256(repr((servotwin.__version__, parts)).encode()).hexdigest()[:16]


def ranges_of(servo: Plant, known: Uncertainty, demands: Demands, region: Region) -> dict[str, Range]:
    """Ranges of a region: lost motion in what counts as arrived after the smallest step, bias and friction in what
    counts as a known bias, usual steps in the smallest one; of the noise it counts only if there is any.

    Friction counts where a command holds a torque, which it does not of a drive in velocity mode or a stepper.
    """
    bias, least = known_bias(servo, known, demands), known.step[0]
    torque = float(servo.torque_of(bias))
    low, high = (end + region.feedforward for end in region.input_bias)
    return {
        "gap": _in(NEAR * least / servo.p, region.gap),
        "bias": _in(bias, (low, high)),
        **({"friction": _in(torque, region.friction)} if torque else {}),
        **({"noise": (1.0, 1.0)} if region.noise else {}),
        **({} if region.usual_step is None else {"step": _in(least, region.usual_step)}),
    }


def learnt_ranges(
    learnt: LearntFactors, machine: FactorPrior | None, motor: LearntMotor | None
) -> Iterator[tuple[str, Range]]:
    """Ranges of the learnt numbers over the model's, by name."""
    means = {} if machine is None else dict(zip(("k", "c", "p"), machine.mean.tolist(), strict=False))
    means |= {} if motor is None else {"k_B": motor.mean[BACK_EMF], "k_T": motor.mean[LAG]}
    for place, name in enumerate(learnt.names):
        spread = NORMAL_95 * math.sqrt(learnt.covariance[place][place])
        yield name, (1.0 + means[name] - spread, 1.0 + means[name] + spread)


def _in(unit: float, ends: Range) -> Range:
    return ends[0] / unit, ends[1] / unit


def _contains(mine: Range, other: Range) -> bool:
    room = _NOTICEABLE * max(1.0, *map(abs, other))
    return mine[0] <= other[0] + room and other[1] - room <= mine[1]
