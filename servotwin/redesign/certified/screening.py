"""Ranking of candidates on a few machines, in the order of their costs and only as far as it is asked for.

A candidate is simulated on the costliest few of the machines first. What it costs on all of them is at least what it
would cost if the rest cost nothing, so that one whose least cost is beyond the costs of others waits, mostly for ever.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servotwin.redesign.certified.assess import MachineMeasures, assess, joined
from servotwin.redesign.certified.attempt import ROUNDED, Question
from servotwin.redesign.certified.uncertainty import draw
from servotwin.redesign.design import Design

# Ticks per sample of the trial, from which on a sampled loop is ranked as a continuous one.
_FAST = 10.0
# Of the machines, those on which every candidate is simulated: the percentile of the cost needs the two or three worst.
_FIRST = 0.125
# Candidates that are simulated on the other machines at once.
_AT_ONCE = 2


@dataclass(frozen=True, order=True)
class Ranked:
    """A candidate, True where it misses a demand on the few machines, its cost (s) on them, and its place in the list.

    Before it was simulated on all of them, the cost is the least that it may be.
    """

    fails: bool
    cost: float
    place: int
    setting: Design = field(compare=False)


class Screening:
    """Candidates of one question on the few machines that rank them; each is simulated once on each of them."""

    def __init__(self, question: Question) -> None:
        demands, known = question.demands, question.uncertainty
        self.question = question
        known = known.replace(step=known.usual_step or known.step)
        self._members = draw(question.servo, known, demands.screened, demands.conditions, demands.seed)
        self._largest = float(self._members.step.max())
        self._order: NDArray[np.int64] | None = None
        self._known: dict[Design, MachineMeasures] = {}
        self._places: dict[Design, int] = {}

    def ranked(self, candidates: Sequence[Design]) -> Iterator[Ranked]:
        """Candidates that meet the demands on the machines first, then by cost, then as they are listed."""
        self._start(candidates)
        self._places = {setting: place for place, setting in enumerate(dict.fromkeys(candidates))}
        waiting = [self._rank(setting) for setting in self._places]
        heapq.heapify(waiting)
        while waiting:
            if self._is_whole(waiting[0].setting):
                rank = self._rank(waiting[0].setting)
                if heapq.heapreplace(waiting, rank) != rank:
                    continue
                yield heapq.heappop(waiting)
                continue
            due = [each.setting for each in heapq.nsmallest(_AT_ONCE, waiting)]
            self._finish([setting for setting in due if not self._is_whole(setting)])
            waiting = [self._rank(each.setting) if each.setting in due else each for each in waiting]
            heapq.heapify(waiting)

    def rank(self, setting: Design) -> Ranked:
        """One of the candidates, simulated on all machines."""
        if not self._is_whole(setting):
            self._finish([setting])
        return self._rank(setting)

    def _start(self, candidates: Sequence[Design]) -> None:
        """Simulate the candidates that are new: the first of all on every machine, which tells the costliest ones."""
        new = [setting for setting in dict.fromkeys(candidates) if setting not in self._known]
        if new and self._order is None:
            self._order = np.arange(self._members.count)
            self._finish(new[:1])
            self._order = np.argsort(-self._known[new[0]].cost.ravel(), kind="stable")
            new = new[1:]
        if new:
            first = max(1, round(_FIRST * self._members.count))
            self._known |= dict(zip(new, self._simulated(new, 0, first), strict=True))

    def _finish(self, settings: list[Design]) -> None:
        """Simulate settings on the machines on which they were not yet."""
        done = [self._known.get(setting) for setting in settings]
        first = 0 if done[0] is None else done[0].cost.size
        rest = self._simulated(settings, first, self._members.count)
        for setting, before, after in zip(settings, done, rest, strict=True):
            self._known[setting] = after if before is None else joined(before, after)

    def _simulated(self, settings: list[Design], first: int, last: int) -> list[MachineMeasures]:
        """Measures on the machines at places first .. last - 1 of the order."""
        assert self._order is not None
        machines = self._members.each(self._order[first:last])
        return assess([self.quick(each) for each in settings], machines, self.question.trial.half, self._largest)

    def quick(self, setting: Design) -> Design:
        """The setting as it is ranked: in continuous time where the rate is so high that the order is the same there.

        The verification is at the rate in any case.
        """
        rate = setting.controller.sample_rate
        if rate is None or rate < _FAST * self.question.trial.rate:
            return setting
        return Design(setting.controller.replace(sample_rate=None), setting.tolerance)

    def _is_whole(self, setting: Design) -> bool:
        return self._known[setting].cost.size == self._members.count

    def _rank(self, setting: Design) -> Ranked:
        demands, few = self.question.demands, self._known[setting]
        most = self._members.count - int(np.sum(~few.settled))
        fails = most / self._members.count < demands.settled or bool(few.overshoot.max() > demands.overshoot)
        fails = fails or bool(few.tail.max() > ROUNDED * self.question.largest_error(setting))
        missing = self._members.count - few.cost.size
        costs = np.concatenate([few.cost.ravel(), np.zeros(missing)])
        return Ranked(fails, self.question.cost(setting, costs), self._places[setting], setting)
