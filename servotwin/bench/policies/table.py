"""The table: every policy on every machine of every block, and the best constant controller beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import joblib
import numpy as np

from servotwin.bench.policies.contenders import POLICIES, constants, contender
from servotwin.bench.policies.machines import BLOCKS, Machine, machines
from servotwin.bench.policies.trial import Scores, Told, run_machine
from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo
from servotwin.redesign.uncertainty import Uncertainty

LEAST_SETTLED = 0.99
_SCREENED = 0.2


@dataclass(frozen=True, eq=False)
class Row:
    """One contender in one block; arrays have a value per machine.

    Attributes
    ----------
    block, name : str
    scores : Scores
        Of arrays.
    """

    block: str
    name: str
    scores: Scores

    @property
    def settled(self) -> float:
        """Share of the machines that settled."""
        return float(np.mean(np.asarray(self.scores.ripple) < 1e-6))

    def p95(self, measure: str) -> float:
        """95th percentile of a measure."""
        return float(np.percentile(getattr(self.scores, measure), 95.0))


def compare(
    model: Servo,
    known: Uncertainty,
    count: int,
    seed: int = 2026,
    blocks: Sequence[str] = BLOCKS,
    jobs: int = 2,
    notice: Callable[[str], None] = lambda _: None,
) -> list[Row]:
    """All rows, in the order of blocks and contenders; the last of each block is the best constant controller."""
    rows = []
    with joblib.Parallel(n_jobs=jobs) as pool:
        for block in blocks:
            those = machines(model, known, block, count, seed)
            for name in POLICIES:
                notice(f"{block}: {name}")
                rows.append(_row(pool, block, name, those, model, contender(name, model, known)))
            notice(f"{block}: constant controllers")
            rows.append(_best_constant(pool, block, those, model, known))
    return rows


def _row(pool: joblib.Parallel, block: str, name: str, those: Sequence[Machine], model: Servo, told: Told) -> Row:
    found = pool(joblib.delayed(run_machine)(machine, block, model, told) for machine in those)
    return Row(block, name, Scores(*np.array(found).T))


def _best_constant(
    pool: joblib.Parallel, block: str, those: Sequence[Machine], model: Servo, known: Uncertainty
) -> Row:
    """The best of those that would be best on a fifth of the machines, on all of them: with hindsight."""
    few = those[: max(20, round(_SCREENED * len(those)))]
    tried = [
        (_row(pool, block, f"constant: {name}", few, model, Told(None, setting)), setting)
        for name, setting in constants(model, known).items()
    ]
    tried.sort(key=lambda pair: _rank(pair[0]))
    finals = [_row(pool, block, row.name, those, model, Told(None, setting)) for row, setting in tried[:4]]
    return min(finals, key=_rank)


def _rank(row: Row) -> tuple[bool, float]:
    """Cheapest of those that settle, where settling is asked; noise never does."""
    return row.block != "noise" and row.settled < LEAST_SETTLED, row.p95("cost")


def quantiles(values: Array) -> tuple[float, float]:
    """Median and 95th percentile."""
    low, high = np.percentile(values, [50.0, 95.0])
    return float(low), float(high)
