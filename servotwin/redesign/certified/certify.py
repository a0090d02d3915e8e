"""Search for a setting that is verified by simulation on the machines within the uncertainty.

Candidates are simulated on machines drawn from everything that is uncertain: the plant's parameters, the gap within the
estimate's interval, the size of the steps, the rest of the input bias. A few machines rank the candidates; the best is
then simulated on many others, drawn anew, and sent only if these settle. Nothing is extrapolated from the estimate's
point value.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from servotwin.control.controller import Controller
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import COUNTS, MachineMeasures, assess, costs_to_and_fro
from servotwin.redesign.certified.attempt import ROUNDED, Attempt, Question, with_feedforward
from servotwin.redesign.certified.certificate import Certificate, Demands, NotVerified
from servotwin.redesign.certified.margins import laws_within, widened, with_margins
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty, draw
from servotwin.redesign.design import Design

# Gains with which integral action is tried: the best so many without it.
_GAINS_WITH_INTEGRAL = 3
# Ticks per sample of the trial, from which on a sampled loop is ranked as a continuous one.
_FAST = 10.0
# Candidates that are compared on a machine that was observed.
_MOVED = 8
# Cost of the running setting over that of the cheapest one, up to which the running one stays.
_WORTH = 1.03


class _Ranked(NamedTuple):
    """A candidate with its cost (s) on a few machines, and whether it misses a demand on them."""

    setting: Design
    fails: bool
    cost: float


def certify(
    servo: Servo,
    uncertainty: Uncertainty,
    demands: Demands | None = None,
    trial: Trial | None = None,
    feedforward: float = 0.0,
    noise: float = 0.0,
    clock: Callable[[], float] = perf_counter,
    running: Design | None = None,
) -> Certificate | NotVerified:
    """Find the cheapest setting that meets the demands on all simulated machines that the uncertainty allows.

    Costs are compared on the steps that the machine usually makes, where these are known.

    Parameters
    ----------
    servo : Servo
        The model; candidates are its own controller with scaled gains, at its sample rate if it has one.
    uncertainty : Uncertainty
    demands : Demands, optional
    trial : Trial, optional
        Made for the servo by default.
    feedforward : float
        V, part of every candidate.
    noise : float
        m rms on the measured position.
    clock : callable
        s, from which the certificate's computing time is taken.
    running : Design, optional
        In force: it stays where it is verified too and at most a tenth dearer than the cheapest.

    Raises
    ------
    InvalidInput
        No candidate is within the bounds on Ms.
    """
    begin = clock()
    demands = demands or Demands()
    trial = trial or trial_for(servo, uncertainty, demands)
    disturbed = is_disturbed(servo, uncertainty, demands, feedforward)
    laws = candidates_of(servo, uncertainty, demands, disturbed, noise > 0.0)
    candidates = [with_feedforward(setting, feedforward) for setting in laws]
    in_force = None if running is None else with_feedforward(running, feedforward)
    question = Question(servo, uncertainty, _for_disturbance(demands, disturbed), trial, noise)
    attempts: list[Attempt] = []
    for setting in _shortlist(_ranked_in_stages(question, candidates, in_force), demands.attempts):
        attempt = Attempt(question, setting)
        attempts.append(attempt)
        if attempt.cannot_pass():
            continue
        tried = replace(attempt.certificate(), looked_at=len(candidates), seconds=clock() - begin)
        if not question.shortcoming(tried):
            return tried
    # Only where all fail do the figures of each count: the rest of their machines are simulated now.
    failed = [attempt.certificate() for attempt in attempts]
    best = replace(max(failed, key=lambda each: each.settled), looked_at=len(candidates), seconds=clock() - begin)
    return NotVerified(f"none of {len(candidates)} candidates is verified: the best {question.shortcoming(best)}", best)


def confirm(
    servo: Servo,
    uncertainty: Uncertainty,
    setting: Design,
    demands: Demands,
    trial: Trial | None = None,
    noise: float = 0.0,
    clock: Callable[[], float] = perf_counter,
) -> Certificate | NotVerified:
    """Verify one given setting on the simulated machines within the uncertainty.

    Parameters
    ----------
    servo, uncertainty, demands, trial, noise, clock
        As for `certify`.
    setting : Design
        With its feedforward.
    """
    begin = clock()
    disturbed = is_disturbed(servo, uncertainty, demands, setting.controller.feedforward)
    trial = trial or trial_for(servo, uncertainty, demands)
    question = Question(servo, uncertainty, _for_disturbance(demands, disturbed), trial, noise)
    tried = replace(Attempt(question, setting).certificate(), looked_at=1, seconds=clock() - begin)
    missing = question.shortcoming(tried)
    return NotVerified(f"the setting {missing}", tried) if missing else tried


def _shortlist(ranked: list[Design], attempts: int) -> list[Design]:
    """The first candidates, then as many without integral action and dead zone, which settle most surely."""
    plain = [setting for setting in ranked if not setting.controller.Ki and not setting.tolerance]
    return list(dict.fromkeys([*ranked[:attempts], *plain[:attempts]]))


def known_bias(servo: Servo, uncertainty: Uncertainty, demands: Demands) -> float:
    """V: an input bias up to this counts as known, since the error that it leaves is a small share of the smallest
    step."""
    return demands.known * abs(servo.controller.Kp) * uncertainty.step[0]


def is_disturbed(servo: Servo, uncertainty: Uncertainty, demands: Demands, feedforward: float) -> bool:
    """True where friction acts, or a bias that is not known."""
    low, high = (bias + feedforward for bias in uncertainty.input_bias)
    return max(abs(low), abs(high)) > known_bias(servo, uncertainty, demands) or uncertainty.friction[1] > 0.0


def _for_disturbance(demands: Demands, disturbed: bool) -> Demands:
    """Demands for machines on which friction or bias act.

    In the simulation the bias sets in together with the step, so the overshoot that it adds means nothing.
    """
    return replace(demands, overshoot=math.inf) if disturbed else demands


def candidates_of(
    servo: Servo, uncertainty: Uncertainty, demands: Demands, disturbed: bool, noisy: bool
) -> list[Design]:
    """Every combination of scales, shapes, integral action and dead zone within the bounds on Ms.

    Integral action is for friction and for an unknown input bias, a dead zone keeps noise out of the voltage: they are
    candidates only where there is friction or bias, or noise. Integral action comes with and without a zone about the
    reference that stops the integral only.

    Raises
    ------
    InvalidInput
        No scaled controller is within the bounds on Ms.
    """
    integral = demands.integral if disturbed else (0.0,)
    laws = laws_within(servo, widened(uncertainty, demands), with_margins(demands), integral)
    plain = [Design(law) for law in laws]
    plain += [stopped for law in laws if law.Ki for stopped in _stopped(servo, law, uncertainty.step[0], demands)]
    zone = servo.tolerance_for(uncertainty.gap[1])
    hysteretic = [
        Design(law.replace(enter=enter, leave=leave), zone) for law in laws for enter, leave in demands.hysteresis
    ]
    return plain + hysteretic if 0.0 < zone <= demands.tolerance and noisy else plain


def _stopped(servo: Servo, law: Controller, step: float, demands: Demands) -> list[Design]:
    """A law with dead zones that stop its integral only, for a smallest step (m)."""
    counts = COUNTS * servo.position_resolution
    zones = [(share * step + counts, leave) for share, leave in demands.stops]
    return [
        Design(law.replace(integral_only=True, enter=1.0, leave=leave), tolerance)
        for tolerance, leave in zones
        if tolerance <= demands.tolerance
    ]


def _gains(law: Controller) -> tuple[float, float, float]:
    return law.Kp, law.Kd, law.Tf


def _ranked_in_stages(question: Question, candidates: list[Design], running: Design | None) -> list[Design]:
    """Candidates in the order of `_ranked`: integral action is tried with the best gains without it only.

    The running setting comes first, unless it fails or another one is worth the change: two settings that are as good
    would otherwise take turns, whenever the evidence moves a little.
    """
    plain = [setting for setting in candidates if not setting.controller.Ki]
    if plain and len(plain) < len(candidates):
        gains = {_gains(each.setting.controller) for each in _ranked(question, plain)[:_GAINS_WITH_INTEGRAL]}
        gains.add(_gains(question.servo.controller))
        candidates = plain + [c for c in candidates if c.controller.Ki and _gains(c.controller) in gains]
    if running is not None:
        candidates = list(dict.fromkeys([running, *candidates]))
    ranked = _ranked(question, candidates)
    if question.uncertainty.usual_step is not None:
        ranked = _compared(question, ranked, running)
    stays = [e for e in ranked if e.setting == running and not e.fails and e.cost <= _WORTH * ranked[0].cost]
    return [each.setting for each in dict.fromkeys([*stays, *ranked])]


def _compared(question: Question, ranked: list[_Ranked], running: Design | None) -> list[_Ranked]:
    """The first candidates and the running one in the order of their expected cost on the machine that was observed.

    This is one machine, so that what is open about it averages; and it moves to and fro: where a law leaves the motor
    in the gap decides the cost of the next move.
    """
    demands, known = question.demands, question.uncertainty
    own = _gains(question.servo.controller)
    always = [each.setting == running or _gains(each.setting.controller) == own for each in ranked]
    shown = [k for k, each in enumerate(ranked) if not each.fails and (k < _MOVED or always[k])]
    if not shown:
        return ranked
    known = known.replace(step=known.usual_step)
    members = draw(question.servo, known, demands.screened, demands.conditions // 2, demands.seed)
    moves = costs_to_and_fro([_quick(question, ranked[k].setting) for k in shown], members, question.trial.half.half)
    costs = [float(cost.mean()) + question.price(ranked[k].setting) for k, cost in zip(shown, moves, strict=True)]
    first = [ranked[k]._replace(cost=cost) for k, cost in zip(shown, costs, strict=True)]
    return sorted(first, key=lambda each: each.cost) + [each for k, each in enumerate(ranked) if k not in shown]


def _ranked(question: Question, candidates: list[Design]) -> list[_Ranked]:
    """Candidates that meet the demands on a few machines first, then by cost."""
    demands, known = question.demands, question.uncertainty
    known = known.replace(step=known.usual_step or known.step)
    members = draw(question.servo, known, demands.screened, demands.conditions, demands.seed)
    measures = assess([_quick(question, setting) for setting in candidates], members, question.trial.half)

    def ranked(setting: Design, few: MachineMeasures) -> _Ranked:
        fails = float(np.mean(few.settled)) < demands.settled or few.overshoot.max() > demands.overshoot
        fails = fails or bool(few.tail.max() > ROUNDED * question.largest_error(setting))
        return _Ranked(setting, fails, question.cost(setting, few))

    every = [ranked(setting, few) for setting, few in zip(candidates, measures, strict=True)]
    return sorted(every, key=lambda each: (each.fails, each.cost))


def _quick(question: Question, setting: Design) -> Design:
    """The setting as it is ranked: in continuous time where the rate is so high that the order is the same there.

    The verification is at the rate in any case.
    """
    rate = setting.controller.sample_rate
    if rate is None or rate < _FAST * question.trial.rate:
        return setting
    return Design(setting.controller.replace(sample_rate=None), setting.tolerance)
