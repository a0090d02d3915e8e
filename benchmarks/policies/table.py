"""The table: every policy on every machine of every block, and the best constant controller beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.policies.contenders import POLICIES, constants, contender
from benchmarks.policies.machines import BLOCKS, TrialMachine, machines
from benchmarks.policies.trial import Contender, Scores, run_machine
from servotwin.analysis.maps.pool import shared
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.uncertainty import Uncertainty

LEAST_SETTLED = 0.99
STILL = 1e-6
"""m: half peak-to-peak of the error below which a machine counts as settled in this table."""
_SCREENED, _FEWEST, _FINALISTS = 0.2, 20, 4


@dataclass(frozen=True, eq=False)
class PolicyScores:
    """One contender in one block.

    Attributes
    ----------
    block, name : str
    scores : Scores
        Of (N,) arrays, a value per machine.
    machines : tuple of N TrialMachine
    """

    block: str
    name: str
    scores: Scores
    machines: tuple[TrialMachine, ...]

    @property
    def settled(self) -> float:
        """Share of the machines whose error's half peak-to-peak ends below 1 um."""
        return float(np.mean(np.asarray(self.scores.ripple) < STILL))

    def at(self, measure: str, percent: float) -> float:
        """A percentile of a measure."""
        return float(np.percentile(getattr(self.scores, measure), percent))


class _Task(NamedTuple):
    place: int
    machine: TrialMachine
    block: str
    model: Servo
    competitor: Contender


def compare(
    model: Servo, known: Uncertainty, count: int, seed: int = 2026, blocks: Sequence[str] = BLOCKS
) -> Iterator[PolicyScores]:
    """All rows, in the order of blocks and contenders; the last of each block is the best constant controller.

    Parameters
    ----------
    model : Servo
        What policies know.
    known : Uncertainty
        Of which the machines are drawn, and which the certified policy is competitor.
    count, seed : int
        Machines of each block.
    blocks : sequence of str
    """
    for block in blocks:
        those = machines(model, known, block, count, seed)
        for name in POLICIES:
            yield _row(block, name, those, model, contender(name, model, known))
        yield _best_constant(block, those, model, known)


def _row(block: str, name: str, those: Sequence[TrialMachine], model: Servo, competitor: Contender) -> PolicyScores:
    tasks = [_Task(place, machine, block, model, competitor) for place, machine in enumerate(those)]
    ordered = sorted((task.place, scores) for task, scores in shared(_tried, tasks))
    return PolicyScores(block, name, Scores(*np.array([scores for _, scores in ordered]).T), tuple(those))


def _tried(task: _Task) -> Scores:
    return run_machine(task.machine, task.block, task.model, task.competitor)


def _best_constant(block: str, those: Sequence[TrialMachine], model: Servo, known: Uncertainty) -> PolicyScores:
    """Select, with hindsight, the best on all machines among those that are best on a fifth of them."""
    few = those[: max(_FEWEST, round(_SCREENED * len(those)))]
    settings = {f"constant: {name}": setting for name, setting in constants(model, known).items()}
    tried = [_row(block, name, few, model, Contender(None, setting)) for name, setting in settings.items()]
    finalists = [row.name for row in sorted(tried, key=_rank)[:_FINALISTS]]
    return min((_row(block, name, those, model, Contender(None, settings[name])) for name in finalists), key=_rank)


def _rank(row: PolicyScores) -> tuple[bool, float]:
    """Select the cheapest of those that settle; in noise none does."""
    return row.block != "noise" and row.settled < LEAST_SETTLED, row.at("cost", 95.0)
