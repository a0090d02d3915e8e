"""Ranking of candidates on a few machines, in the order of their costs and only as far as it is asked for.

A candidate is simulated on the costliest few of the machines first. What it costs on all of them is at least what it
would cost if the rest cost nothing, so that one whose least cost is beyond the costs of others waits, mostly for ever.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servotwin.redesign.certified.assess import MachineMeasures, assess, costs_to_and_fro, joined
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
class _Rank:
    """Place of a candidate, or the best that it may have; candidates that are alike stand as they were listed."""

    fails: bool
    cost: float
    place: int


class Screening:
    """Candidates of one question on the few machines that rank them; each is simulated once on each of them."""

    def __init__(self, question: Question) -> None:
        demands, known = question.demands, question.uncertainty
        self.question = question
        self._moves = known.replace(step=known.usual_step or known.step)
        self._members = draw(question.servo, self._moves, demands.screened, demands.conditions, demands.seed)
        self._largest = float(self._members.step.max())
        self._order: NDArray[np.int64] | None = None
        self._known: dict[Design, MachineMeasures] = {}

    def ranked(self, candidates: Sequence[Design]) -> Iterator[Design]:
        """Candidates that meet the demands on the machines first, then by cost."""
        self._start(candidates)
        waiting = [(self._rank(setting, place), setting) for place, setting in enumerate(candidates)]
        heapq.heapify(waiting)
        while waiting:
            _, setting = waiting[0]
            if self._is_whole(setting):
                heapq.heappop(waiting)
                yield setting
                continue
            due = [waiting[0][1]]
            due += [each for _, each in heapq.nsmallest(_AT_ONCE, waiting)[1:] if not self._is_whole(each)]
            self._finish(due)
            waiting = [(self._rank(each, rank.place) if each in due else rank, each) for rank, each in waiting]
            heapq.heapify(waiting)

    def fails(self, setting: Design) -> bool:
        """True where a setting misses a demand on the machines."""
        self._complete(setting)
        return self._rank(setting, 0).fails

    def cost(self, setting: Design) -> float:
        """s: 95th percentile over the machines."""
        self._complete(setting)
        return self._rank(setting, 0).cost

    def expected_costs(self, settings: Sequence[Design]) -> dict[Design, float]:
        """s: mean cost of a move to or fro, for settings on the machine that was observed.

        It is one machine, so that what is open about it averages; and it moves to and fro: where a law leaves the motor
        in the gap decides the cost of the next move.
        """
        if not settings:
            return {}
        question, demands = self.question, self.question.demands
        members = draw(question.servo, self._moves, demands.screened, demands.conditions // 2, demands.seed)
        moves = costs_to_and_fro([self._quick(each) for each in settings], members, question.trial.half.half)
        costs = [float(cost.mean()) + question.price(each) for each, cost in zip(settings, moves, strict=True)]
        return dict(zip(settings, costs, strict=True))

    def _complete(self, setting: Design) -> None:
        self._start([setting])
        if not self._is_whole(setting):
            self._finish([setting])

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
        return assess([self._quick(each) for each in settings], machines, self.question.trial.half, self._largest)

    def _quick(self, setting: Design) -> Design:
        """The setting as it is ranked: in continuous time where the rate is so high that the order is the same there.

        The verification is at the rate in any case.
        """
        rate = setting.controller.sample_rate
        if rate is None or rate < _FAST * self.question.trial.rate:
            return setting
        return Design(setting.controller.replace(sample_rate=None), setting.tolerance)

    def _is_whole(self, setting: Design) -> bool:
        return self._known[setting].cost.size == self._members.count

    def _rank(self, setting: Design, place: int) -> _Rank:
        demands, few = self.question.demands, self._known[setting]
        most = self._members.count - int(np.sum(~few.settled))
        fails = most / self._members.count < demands.settled or bool(few.overshoot.max() > demands.overshoot)
        fails = fails or bool(few.tail.max() > ROUNDED * self.question.largest_error(setting))
        missing = self._members.count - few.cost.size
        costs = np.concatenate([few.cost.ravel(), np.zeros(missing)])
        return _Rank(fails, self.question.cost(setting, costs), place)
