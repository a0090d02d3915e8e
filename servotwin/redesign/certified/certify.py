"""Search for a setting that is verified by simulation on the machines within the uncertainty.

Candidates are simulated on machines drawn from everything that is uncertain: the plant's parameters, the gap within the
estimate's interval, the size of the steps, the rest of the input bias. A few machines rank the candidates; the best is
then simulated on many, and sent only if these settle. Nothing is extrapolated from the estimate's point value.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from time import perf_counter

import numpy as np

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.margins import GainCrossover, Margins
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import MachineMeasures, Trial, assess, nearness
from servotwin.redesign.certified.certificate import Certificate, Demands, NotVerified
from servotwin.redesign.certified.uncertainty import SimulatedMachines, Uncertainty, draw
from servotwin.redesign.design import Design

# Measurement noise reaches from well above the crossover to half the rate at which it is sampled.
_NOISE_BAND = (10.0, 2500.0)
# The error that an input bias leaves is the same number on every plant, but for rounding.
_ROUNDED = 1.0 + 1e-6


def certify(
    servo: Servo,
    uncertainty: Uncertainty,
    demands: Demands | None = None,
    trial: Trial | None = None,
    feedforward: float = 0.0,
    noise: float = 0.0,
    clock: Callable[[], float] = perf_counter,
) -> Certificate | NotVerified:
    """Find the cheapest setting that meets the demands on all simulated machines that the uncertainty allows.

    Parameters
    ----------
    servo : Servo
        The model; candidates are its own controller with scaled gains.
    uncertainty : Uncertainty
    demands : Demands, optional
    trial : Trial, optional
    feedforward : float
        V, part of every candidate.
    noise : float
        m rms on the measured position.
    clock : callable
        s, from which the certificate's computing time is taken.

    Raises
    ------
    InvalidInput
        No candidate is within the bound on Ms.
    """
    begin = clock()
    demands, trial = demands or Demands(), trial or Trial()
    demands, disturbed = _for_disturbance(demands, uncertainty, feedforward)
    laws = candidates_of(servo, demands, uncertainty.gap[1], disturbed, noise > 0.0)
    candidates = [_with_feedforward(setting, feedforward) for setting in laws]
    ranked = _ranked(
        candidates, draw(servo, uncertainty, demands.screened, demands.conditions, demands.seed), trial, demands, noise
    )
    members = draw(servo, uncertainty, demands.plants, demands.conditions, demands.seed)
    best: Certificate | None = None
    for setting in ranked[: demands.attempts]:
        (measures,) = assess([setting], members, trial)
        tried = _certificate(servo, setting, members, uncertainty, measures, demands, noise)
        tried = replace(tried, looked_at=len(candidates), seconds=clock() - begin)
        if not _shortcoming(tried, demands):
            return tried
        best = tried if best is None or tried.settled > best.settled else best
    assert best is not None
    return NotVerified(
        f"none of {len(candidates)} candidates is verified: the best {_shortcoming(best, demands)}", best
    )


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
    begin, fed = clock(), setting.controller.feedforward
    demands = _for_disturbance(demands, uncertainty, fed)[0]
    members = draw(servo, uncertainty, demands.plants, demands.conditions, demands.seed)
    (measures,) = assess([setting], members, trial or Trial())
    tried = _certificate(servo, setting, members, uncertainty, measures, demands, noise)
    tried = replace(tried, looked_at=1, seconds=clock() - begin)
    missing = _shortcoming(tried, demands)
    return NotVerified(f"the setting {missing}", tried) if missing else tried


def _for_disturbance(demands: Demands, uncertainty: Uncertainty, feedforward: float) -> tuple[Demands, bool]:
    """Demands for machines on which friction or bias act, and True where they act.

    In the simulation the bias sets in together with the step, so the overshoot that it adds means nothing.
    """
    low, high = (bias + feedforward for bias in uncertainty.input_bias)
    disturbed = max(abs(low), abs(high)) > demands.bias_known or uncertainty.friction[1] > 0.0
    return (replace(demands, overshoot=math.inf) if disturbed else demands), disturbed


def candidates_of(servo: Servo, demands: Demands, gap: float, disturbed: bool, noisy: bool) -> list[Design]:
    """Every combination of scales, integral action and dead zone within the bound on Ms.

    Integral action is for friction and for an unknown input bias, a dead zone keeps noise out of the voltage: they are
    candidates only where there is friction or bias, or noise.

    Raises
    ------
    InvalidInput
        No scaled controller is within the bound on Ms.
    """
    laws = _laws(servo, demands, demands.integral if disturbed else (0.0,))
    if not laws:
        raise InvalidInput(
            f"no candidate has Ms <= {demands.Ms:g} on this servo: raise the bound or allow smaller scales than "
            f"{min(demands.scales):g}"
        )
    plain = [Design(law) for law in laws]
    zone = servo.tolerance_for(gap)
    hysteretic = [
        Design(law.replace(enter=enter, leave=leave), zone) for law in laws for enter, leave in demands.hysteresis
    ]
    return plain + hysteretic if 0.0 < zone <= demands.tolerance and noisy else plain


@lru_cache(maxsize=16)
def _laws(servo: Servo, demands: Demands, integral: tuple[float, ...]) -> list[Controller]:
    """Scaled controllers whose loops keep to the bound on Ms."""
    own = servo.controller
    laws = [
        own.replace(Kp=own.Kp * scale, Kd=own.Kd * scale, Ki=own.Ki * share)
        for share in integral
        for scale in demands.scales
    ]
    return [law for law in dict.fromkeys(laws) if _margins(servo, law).Ms <= demands.Ms]


@lru_cache(maxsize=256)
def _margins(servo: Servo, law: Controller) -> Margins:
    return servo.margins(law)


def _with_feedforward(setting: Design, feedforward: float) -> Design:
    return Design(setting.controller.replace(feedforward=feedforward), setting.tolerance)


def _ranked(
    candidates: list[Design], members: SimulatedMachines, trial: Trial, demands: Demands, noise: float
) -> list[Design]:
    """Candidates that meet the demands on these members first, then by cost."""
    measures = assess(candidates, members, trial)

    def rank(k: int) -> tuple[bool, float]:
        fails = float(np.mean(measures[k].settled)) < demands.settled or measures[k].overshoot.max() > demands.overshoot
        fails = fails or bool(measures[k].tail.max() > _ROUNDED * demands.tail)
        return fails, _cost(candidates[k], measures[k], demands, noise)

    return [candidates[k] for k in sorted(range(len(candidates)), key=rank)]


def _cost(setting: Design, measures: MachineMeasures, demands: Demands, noise: float) -> float:
    price = demands.effort_weight * setting.noise_effort(noise, _NOISE_BAND) if noise else 0.0
    return float(np.percentile(measures.cost, 95.0)) + price


def _certificate(
    servo: Servo,
    setting: Design,
    members: SimulatedMachines,
    uncertainty: Uncertainty,
    measures: MachineMeasures,
    demands: Demands,
    noise: float,
) -> Certificate:
    # Margins do not depend on these three: equal ones share a cached result.
    loop = _margins(servo, setting.controller.replace(feedforward=0.0, enter=1.0, leave=1.0))
    crossover = loop.gain_crossovers[-1] if loop.gain_crossovers else GainCrossover(0.0, math.pi)
    return Certificate(
        setting=setting,
        gap=uncertainty.gap,
        input_bias=uncertainty.input_bias,
        step=uncertainty.step,
        friction=uncertainty.friction,
        members=members.count,
        settled=float(np.mean(measures.settled)),
        cost=_cost(setting, measures, demands, noise),
        tail=float(measures.tail.max()),
        tail_p95=float(np.percentile(measures.tail, 95.0)),
        error_rms=float(measures.error_rms.max()),
        effort=float(measures.effort.max()),
        overshoot=float(measures.overshoot.max()),
        settling=float(np.percentile(measures.settling, 95.0)),
        settling_worst=float(measures.settling.max()),
        within=float(np.max(nearness(setting, np.array(uncertainty.input_bias), uncertainty.step[1]))),
        Ms=loop.Ms,
        crossover=crossover.omega,
        phase_margin=crossover.phase_margin,
        saturated=bool(measures.saturated.any()),
        looked_at=0,
        seconds=0.0,
    )


def _shortcoming(tried: Certificate, demands: Demands) -> str:
    """Name the demand that is not met; empty where all are met."""
    if tried.crossover == 0.0:
        return "has no gain crossover: its loop gain is below one at every frequency"
    if tried.settled < demands.settled:
        share, least = 100.0 * tried.settled, 100.0 * demands.settled
        return f"settles on {share:.1f} % of the simulated machines, and {least:g} % are demanded"
    if tried.tail > _ROUNDED * demands.tail:
        return f"is off by {1e3 * tried.tail:.3g} mm in the end, and {1e3 * demands.tail:.3g} mm are allowed"
    if tried.overshoot > demands.overshoot:
        return f"overshoots by {100.0 * tried.overshoot:.0f} %, and {100.0 * demands.overshoot:.0f} % are allowed"
    return ""
