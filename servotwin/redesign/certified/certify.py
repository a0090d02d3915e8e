"""Search for a setting that is verified by simulation on the machines within the uncertainty.

Candidates are simulated on machines drawn from everything that is uncertain: the plant's parameters, the gap within the
estimate's interval, the size of the steps, the rest of the input bias. A few machines rank the candidates; the best is
then simulated on many others, drawn anew, and sent only if these settle. Nothing is extrapolated from the estimate's
point value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from time import perf_counter

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.retuning import integrates
from servotwin.plant.plants import Plant, check_gap_in_loop
from servotwin.plant.signals import check_gap
from servotwin.redesign.certified.attempt import Attempt, Question
from servotwin.redesign.certified.candidates import candidates_of, last_resort
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import has_slow_integral, own_static_gain
from servotwin.redesign.certified.machines import SimulatedMachines
from servotwin.redesign.certified.screening import Screening, has_widest_integral_zone, is_plain, opens_in_zone
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design, with_feedforward

_Gains = tuple[float, ...]
# Gains with which integral action is tried: the best so many without it.
_GAINS_WITH_INTEGRAL = 3
# Candidates that fail at little expense before all count as attempts.
_LEFT_OUT = 64
# Candidates that are compared on a machine that was observed.
_MOVED = 12
# The same where each law with integral action has six zones.
_MOVED_IN_ZONES = 36
# Cost of a running setting with velocity feedforward over that of the cheapest one, up to which it stays. Where the
# usual steps are known, these factors are on what a law can change of a cost.
_WORTH = 1.03
# Cost of a law without velocity feedforward over the same law with it, up to which the plain one is better: it
# overshoots less and comes to rest sooner. In force it stays a little longer, so that the two do not take turns.
_ALIKE, _ALIKE_IN_FORCE = 1.03, 1.045


def certify(
    servo: Plant,
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
    servo : Servo or Axis
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
        In force: it stays where it is verified too and at most 3 % (4.5 % without velocity feedforward) dearer than
        the cheapest.

    Raises
    ------
    InvalidInput
        No candidate is within the bounds on Ms.
    """
    begin = clock()
    check_gap_in_loop(servo)
    check_gap(uncertainty.gap[1], "uncertainty gap", servo.largest_gap)
    demands = demands or Demands()
    trial = trial or trial_for(servo, uncertainty, demands)
    disturbed = is_disturbed(servo, uncertainty, demands, feedforward)
    laws = candidates_of(servo, uncertainty, demands, disturbed, noise > 0.0)
    question = Question(servo, uncertainty, _for_disturbance(demands, disturbed), trial, noise)
    running = None if running is None else with_feedforward(running, feedforward)
    attempts: list[Attempt] = []
    looked_at = 0
    for group in (laws, last_resort(servo, uncertainty, demands, laws)):
        candidates = [with_feedforward(setting, feedforward) for setting in group]
        looked_at += len(candidates)
        found = _first_verified(question, candidates, running, attempts)
        if found is not None:
            return replace(found, looked_at=looked_at, seconds=clock() - begin)
    # Only where all fail do the figures of one count: the rest of its machines are simulated now.
    furthest = max(attempts or [Attempt(question, with_feedforward(laws[0], feedforward))], key=Attempt.reached)
    best = replace(furthest.certificate(), looked_at=looked_at, seconds=clock() - begin)
    return NotVerified(f"none of {looked_at} candidates is verified: the best {question.shortcoming(best)}", best)


def _first_verified(
    question: Question, candidates: list[Design], running: Design | None, attempts: list[Attempt]
) -> Certificate | None:
    """The cheapest of the candidates that is verified; `attempts` receives those that are tried."""
    if not candidates:
        return None
    screening = Screening(question)
    hard = list[SimulatedMachines]()
    likely = _likely(question, hard, _ranked_in_stages(question, screening, candidates, running))
    for attempt in _shortlist(screening, likely, has_widest_integral_zone(candidates), question.demands.attempts):
        attempts.append(attempt)
        if not attempt.cannot_pass():
            # Before the rest of the attempt's machines, which are needed only where this is none.
            verified = _plainer(question, screening, attempt.setting) or attempt.verified()
            if verified is not None:
                return verified
        hard += attempt.missed()
    return None


def confirm(
    servo: Plant,
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
    tried = replace(Attempt(question, setting).decided(), looked_at=1, seconds=clock() - begin)
    missing = question.shortcoming(tried)
    return NotVerified(f"the setting {missing}", tried) if missing else tried


def _plainer(question: Question, screening: Screening, found: Design) -> Certificate | None:
    """On a machine that was observed: the setting without its velocity feedforward, where that costs hardly more there
    and is verified too. On any other one the costs of a few machines do not tell the two apart."""
    law, own = found.controller, question.servo.controller
    if not (isinstance(law, Controller) and isinstance(own, Controller) and law.velocity_feedforward):
        return None
    if question.uncertainty.usual_step is None:
        return None
    plain = replace(found, controller=law.replace(velocity_feedforward=0.0, velocity_time=own.velocity_time))
    if screening.fails(plain):
        return None
    costs = screening.expected_costs([found, plain])
    if _reduced(costs[plain], screening.least_cost, _ALIKE) > costs[found]:
        return None
    attempt = Attempt(question, plain)
    return None if attempt.cannot_pass() else attempt.verified()


def _likely(question: Question, hard: list[SimulatedMachines], ranked: Iterator[Design]) -> Iterator[Attempt]:
    """Candidates without those that fail at little expense, some of them on the `hard` machines: where others failed.

    `hard` may grow meanwhile. After so many that fail nothing is left out: all may.
    """
    left_out = 0
    for setting in ranked:
        attempt = Attempt(question, setting)
        if left_out < _LEFT_OUT and attempt.fails_early(hard):
            left_out += 1
        else:
            yield attempt


def _shortlist(
    screening: Screening, likely: Iterator[Attempt], widest: Callable[[Design], bool], attempts: int
) -> Iterator[Attempt]:
    """The first candidates, then as many of each kind that settles most surely: those whose integral stops the furthest
    from the reference, those without integral action and dead zone, and those whose dead zone opens the loop."""
    kinds = (widest, is_plain, opens_in_zone)
    yielded = [0] * len(kinds)
    for place, attempt in enumerate(likely):
        kind = next((k for k, of_kind in enumerate(kinds) if of_kind(attempt.setting)), None)
        if place < attempts or (kind is not None and yielded[kind] < attempts):
            yield attempt
        if kind is not None:
            yielded[kind] += 1
        if place + 1 >= attempts:
            left = [of_kind for of_kind, count in zip(kinds, yielded, strict=True) if count < attempts]
            if not left:
                return
            screening.only = _any_of(left)


def _any_of(kinds: Sequence[Callable[[Design], bool]]) -> Callable[[Design], bool]:
    return lambda setting: any(of_kind(setting) for of_kind in kinds)


def known_bias(servo: Plant, uncertainty: Uncertainty, demands: Demands) -> float:
    """V: an input bias up to this counts as known, since the error that it leaves is a small share of the smallest
    step."""
    return demands.known * own_static_gain(servo) * uncertainty.step[0]


def is_disturbed(servo: Plant, uncertainty: Uncertainty, demands: Demands, feedforward: float) -> bool:
    """True where friction acts, or a bias that is not known."""
    low, high = (bias + feedforward for bias in uncertainty.input_bias)
    return (
        max(abs(low), abs(high)) > known_bias(servo, uncertainty, demands)
        or uncertainty.friction[1] + servo.own_friction > 0.0
    )


def _for_disturbance(demands: Demands, disturbed: bool) -> Demands:
    """Demands for machines on which friction or bias act.

    In the simulation the bias sets in together with the step, so the overshoot that it adds means nothing.
    """
    return replace(demands, overshoot=math.inf) if disturbed else demands


def _gains(law: AnyController) -> _Gains:
    """Numbers that tell laws with and without integral action apart from others."""
    gains = gains_of(law)
    return (*(getattr(gains, name) for name in gains.scaled), getattr(gains, "notch_hz", 0.0))


def _velocity(law: AnyController) -> float:
    return law.velocity_feedforward if isinstance(law, Controller) else 0.0


def _ranked_in_stages(
    question: Question, screening: Screening, candidates: list[Design], running: Design | None
) -> Iterator[Design]:
    """Candidates in the order of their costs: integral action is tried with the own gains and the best laws without it.

    The running setting comes first, unless it fails or another one is worth the change: two settings that are as good
    would otherwise take turns, whenever the evidence moves a little.
    """
    own = _gains(question.servo.controller)
    plain = [setting for setting in candidates if not integrates(setting.controller)]
    if plain and len(plain) < len(candidates):
        fed = _velocities(screening.ranked(plain), own)
        candidates = plain + [
            each
            for each in candidates
            if integrates(each.controller) and fed.get(_gains(each.controller)) == _velocity(each.controller)
        ]
    if question.uncertainty.usual_step is None:
        return _with_running(screening, candidates, running)
    always = [each for each in candidates if _gains(each.controller) == own]
    return _by_moves(screening, candidates, [*always, running] if running is not None else always, running)


def _velocities(ranked: Iterator[Design], own: _Gains) -> dict[_Gains, float]:
    """Velocity feedforwards with which integral action is tried, by gains: the best for each of the best gains; for the
    own gains that of the best of all."""
    fed, best = dict[_Gains, float](), math.nan
    for setting in ranked:
        law = setting.controller
        best = _velocity(law) if math.isnan(best) else best
        fed.setdefault(_gains(law), _velocity(law))
        if len(fed) == _GAINS_WITH_INTEGRAL:
            break
    return {own: best} | fed


def _worth(running: Design) -> float:
    """Cost of the running setting over that of the cheapest one, up to which the running one stays."""
    return _WORTH if _velocity(running.controller) else _ALIKE_IN_FORCE


def _reduced(cost: float, least: float, factor: float) -> float:
    """A cost whose part beyond the least that any law has is divided by a factor.

    On a motor that runs at its limit most of the way the least is nearly all of it: a few percent of the whole would be
    more than the candidates differ by.
    """
    return cost if cost <= least else least + (cost - least) / factor


def _with_running(screening: Screening, candidates: list[Design], running: Design | None) -> Iterator[Design]:
    """Candidates by their cost over all steps, the running setting where it is hardly dearer than the next one."""
    waits = running is not None and not screening.fails(running)
    for setting in screening.ranked(candidates):
        if waits and running is not None and screening.cost(running) <= _worth(running) * screening.cost(setting):
            waits = False
            yield running
        if setting != running:
            yield setting


def _by_moves(
    screening: Screening, candidates: list[Design], always: list[Design], running: Design | None
) -> Iterator[Design]:
    """The first candidates and those of `always` by their cost while they move to and fro, then the others."""
    moved = _MOVED_IN_ZONES if has_slow_integral(screening.question.servo) else _MOVED
    settings = dict.fromkeys([*islice(screening.ranked(candidates, passing=True), moved), *always])
    costs = screening.expected_costs([each for each in settings if not screening.fails(each)])
    least = screening.least_cost
    yield from sorted(
        costs, key=lambda each: _reduced(costs[each], least, _worth(each)) if each == running else costs[each]
    )
    yield from (each for each in screening.ranked(candidates) if each not in costs)
