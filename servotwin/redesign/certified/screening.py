"""Ranking of candidates on a few machines, in the order of their costs and only as far as it is asked for.

A candidate is simulated on the costliest few of the machines first. What it costs on all of them is at least what it
would cost if the rest cost nothing, so that one whose least cost is beyond the costs of others waits, mostly for ever.
Next come the machines on which other candidates failed: one that fails there is behind all that do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servotwin.control.controller import Controller
from servotwin.control.retuning import friction_feedforward, integrates
from servotwin.redesign.certified.assess import MachineMeasures, assess, costs_to_and_fro, joined, steady_error
from servotwin.redesign.certified.attempt import ROUNDED, Question
from servotwin.redesign.certified.integral_action import has_slow_integral
from servotwin.redesign.certified.machines import SimulatedMachines, draw
from servotwin.redesign.design import Design

# Ticks per sample of the trial, from which on a sampled loop is ranked as a continuous one.
_FAST = 10.0
# Of the machines, those on which every candidate is simulated: the percentile of the cost needs the two or three worst.
_FIRST = 0.125
# Candidates that are simulated on the other machines at once, and machines on which others failed, before the rest.
_AT_ONCE, _HARDEST = 2, 4
# Of the largest step: steps from there on count as the largest.
_LARGEST = 0.8


def is_plain(setting: Design) -> bool:
    """True without integral action and dead zone."""
    return not integrates(setting.controller) and not setting.tolerance


def opens_in_zone(setting: Design) -> bool:
    """True where a dead zone opens the whole loop."""
    return setting.tolerance > 0.0 and not setting.controller.integral_only


def has_widest_integral_zone(candidates: Sequence[Design]) -> Callable[[Design], bool]:
    """Predicate of the settings whose integral stops the furthest from the reference: of those with integral action
    they settle most surely."""
    widest = max((each.tolerance for each in candidates if _stops(each)), default=math.inf)
    return lambda each: _stops(each) and each.tolerance >= widest


def _stops(setting: Design) -> bool:
    """True where a dead zone stops the integral only."""
    return setting.controller.integral_only and (setting.tolerance > 0.0 or isinstance(setting.controller, Controller))


def exceeds_error_limit(question: Question, setting: Design) -> bool:
    """True where nothing integrates, and bias and friction may leave a larger error than is allowed.

    The few machines that rank may stop nearer by chance.
    """
    left = steady_error(setting, question.servo, question.uncertainty)
    return left > ROUNDED * question.largest_error(setting)


@dataclass(frozen=True, order=True)
class _Rank:
    """Place of a candidate, or the best that it may have; candidates that are alike stand as they were listed."""

    fails: bool
    cost: float
    place: int


class Screening:
    """Candidates of one question on the few machines that rank them; each is simulated once on each of them.

    Attributes
    ----------
    only : callable, optional
        Set to a predicate while candidates are ranked, it drops those that do not satisfy it.
    """

    def __init__(self, question: Question) -> None:
        demands, known = question.demands, question.uncertainty
        self.question = question
        # Cost is decided soon after the step, but where a slow integral works against friction.
        whole = question.is_held and has_slow_integral(question.servo)
        self._trial = question.trial if whole else question.trial.half
        self.only: Callable[[Design], bool] | None = None
        self._moves = known.replace(step=known.usual_step or known.step)
        self._members = draw(question.servo, self._moves, demands.screened, demands.conditions, demands.seed)
        self._largest = float(self._members.step.max())
        self._first = max(1, round(_FIRST * self._members.count))
        self._order: NDArray[np.int64] | None = None
        self._known: dict[Design, MachineMeasures] = {}
        # Of settings with a friction feedforward: whether they are off in the end after the largest steps.
        self._far: dict[Design, bool] = {}
        # Machines on which each setting was simulated; settings that missed a demand on each machine.
        self._places: dict[Design, NDArray[np.int64]] = {}
        self._misses = np.zeros(self._members.count, dtype=np.int64)

    def ranked(self, candidates: Sequence[Design], passing: bool = False) -> Iterator[Design]:
        """Candidates, each once: first those that meet the demands on the machines, by cost; `passing`: no others."""
        candidates = list(dict.fromkeys(candidates))
        self._start(candidates)
        waiting = [(self._rank(setting, place), setting) for place, setting in enumerate(candidates)]
        while waiting:
            if self.only is not None:
                waiting = [each for each in waiting if self.only(each[1])]
            waiting.sort()
            if passing and waiting and waiting[0][0].fails:
                return
            if waiting and self._is_whole(waiting[0][1]):
                yield waiting.pop(0)[1]
                continue
            due = [each for _, each in waiting[:1]]
            due += [each for _, each in waiting[1:_AT_ONCE] if not self._is_whole(each)]
            self._finish(due)
            waiting = [(self._rank(each, rank.place) if each in due else rank, each) for rank, each in waiting]

    def fails(self, setting: Design) -> bool:
        """True where a setting misses a demand on the machines."""
        self._start([setting])
        while not (self._is_whole(setting) or self._rank(setting, 0).fails):
            self._finish([setting])
        return self._rank(setting, 0).fails

    def cost(self, setting: Design) -> float:
        """s: 95th percentile over the machines."""
        self._start([setting])
        while not self._is_whole(setting):
            self._finish([setting])
        return self._rank(setting, 0).cost

    def expected_costs(self, settings: Sequence[Design]) -> dict[Design, float]:
        """s: mean cost of a move to or fro, for settings on the machine that was observed.

        It is one machine, so that what is open about it averages; and it moves to and fro: where a law leaves the motor
        in the gap decides the cost of the next move.
        """
        if not settings:
            return {}
        question = self.question
        moves = costs_to_and_fro([self._quick(each) for each in settings], self._moving, question.trial.half.half)
        costs = [float(cost.mean()) + question.price(each) for each, cost in zip(settings, moves, strict=True)]
        return dict(zip(settings, costs, strict=True))

    @cached_property
    def least_cost(self) -> float:
        """s: mean cost of a move whose motor runs at the limit of its command all the way; 0 where nothing limits it.

        This part of the expected costs is the same whatever the law. It counts as 0 too where such a move takes longer
        than it is simulated: the next one begins on the way then.
        """
        servo = self.question.servo
        limit = min(servo.controller.voltage_limit or math.inf, servo.command_limit or math.inf)
        full = np.array([[plant.command_per_speed / plant.p] for plant in self._moving.plants])
        times = full * self._moving.step / limit
        return 0.5 * float(times.mean()) if times.max() < self.question.trial.half.half.duration else 0.0

    @cached_property
    def _moving(self) -> SimulatedMachines:
        """Machines that move to and fro."""
        demands = self.question.demands
        return draw(self.question.servo, self._moves, demands.screened, demands.conditions // 2, demands.seed)

    def _start(self, candidates: Sequence[Design]) -> None:
        """Simulate the candidates that are new: the first of all on every machine, which tells the costliest ones."""
        new = [setting for setting in dict.fromkeys(candidates) if setting not in self._known]
        if new and self._order is None:
            every = np.arange(self._members.count)
            self._simulate(new[:1], every)
            self._order = np.argsort(-self._known[new[0]].cost.ravel(), kind="stable")
            self._try_largest_steps(new[:1])
            new = new[1:]
        if new:
            assert self._order is not None
            self._simulate(new, self._order[: self._first])
            self._try_largest_steps(new)

    def _try_largest_steps(self, settings: list[Design]) -> None:
        """Simulate settings with a friction feedforward on the largest stated steps, where the usual ones rank.

        Friction holds what they overshoot, which grows with the step.
        """
        question, known = self.question, self.question.uncertainty
        pushed = [each for each in settings if friction_feedforward(each.controller)]
        if not pushed or known.usual_step is None:
            return
        largest = known.replace(step=(_LARGEST * known.step[1], known.step[1]))
        machines = draw(question.servo, largest, question.demands.screened, 2, question.demands.seed)
        tried = assess([self._quick(each) for each in pushed], machines, self._trial)
        self._far |= {each: bool(self._is_off(each, few).any()) for each, few in zip(pushed, tried, strict=True)}

    def _finish(self, settings: list[Design]) -> None:
        """Simulate settings on machines on which they were not yet: those on which most others failed, then the
        rest."""
        alike: dict[bytes, list[Design]] = {}
        for setting in settings:
            alike.setdefault(self._places[setting].tobytes(), []).append(setting)
        for group in alike.values():
            done = self._places[group[0]]
            rest = np.setdiff1d(np.arange(self._members.count), done)
            hard = rest[np.argsort(-self._misses[rest], kind="stable")][:_HARDEST]
            hard = hard[self._misses[hard] > 0]
            # Every call has costs of its own: two stages, not more.
            self._simulate(group, hard if hard.size and done.size == self._first else rest)

    def _simulate(self, settings: list[Design], places: NDArray[np.int64]) -> None:
        """Simulate settings on the machines at these places."""
        machines = self._members.each(places)
        quick = [self._quick(each) for each in settings]
        for setting, new in zip(settings, assess(quick, machines, self._trial, self._largest), strict=True):
            before = self._known.get(setting)
            self._known[setting] = new if before is None else joined(before, new)
            self._places[setting] = places if before is None else np.concatenate([self._places[setting], places])
            self._misses[places] += (~new.settled | self._is_off(setting, new)).ravel()

    def _is_off(self, setting: Design, few: MachineMeasures) -> NDArray[np.bool_]:
        """True for machines on which the error in the end or the overshoot is larger than demanded."""
        off = few.tail > ROUNDED * self.question.largest_error(setting)
        return np.asarray(off | (few.overshoot > self.question.demands.overshoot))

    def _quick(self, setting: Design) -> Design:
        """The setting as it is ranked: in continuous time where the rate is so high that the order is the same there.

        The verification is at the rate in any case.
        """
        law = setting.controller
        # Only the filtered PID is simulated faster in continuous time.
        if not isinstance(law, Controller):
            return setting
        rate = law.sample_rate
        if rate is None or rate < _FAST * self.question.trial.rate:
            return setting
        return Design(law.replace(sample_rate=None), setting.tolerance)

    def _is_whole(self, setting: Design) -> bool:
        return self._known[setting].cost.size == self._members.count

    def _rank(self, setting: Design, place: int) -> _Rank:
        demands, few = self.question.demands, self._known[setting]
        most = self._members.count - int(np.sum(~few.settled))
        fails = most / self._members.count < demands.settled or bool(self._is_off(setting, few).any())
        fails = fails or exceeds_error_limit(self.question, setting) or self._far.get(setting, False)
        missing = self._members.count - few.cost.size
        costs = np.concatenate([few.cost.ravel(), np.zeros(missing)])
        return _Rank(fails, self.question.cost(setting, costs), place)
