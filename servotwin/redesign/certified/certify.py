"""Search for a setting that is verified by simulation on the machines within the uncertainty.

Candidates are simulated on machines drawn from everything that is uncertain: the plant's parameters, the gap within the
estimate's interval, the size of the steps, the rest of the input bias. A few machines rank the candidates; the best is
then simulated on many others, drawn anew, and sent only if these settle. Nothing is extrapolated from the estimate's
point value.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np

from servotwin.control.controller import Controller
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import COUNTS, MachineMeasures, assess, left_over
from servotwin.redesign.certified.bounds import share_at_least
from servotwin.redesign.certified.certificate import BeyondResult, Certificate, Demands, LoopMargins, NotVerified
from servotwin.redesign.certified.margins import laws_within, margins_in_every_zone, unfed, widened, with_margins
from servotwin.redesign.certified.tracking import follow_ramp
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty, draw, draw_independently
from servotwin.redesign.design import Design

# Where the band of measurement noise begins and ends, in units of 1 / Tf: well above the crossover, and where a sampled
# loop of that speed has half its rate.
_NOISE_BAND = (6.0, 1600.0)
# Gains with which integral action is tried: the best so many without it.
_GAINS_WITH_INTEGRAL = 3
# Ticks per sample of the trial, from which on a sampled loop is ranked as a continuous one.
_FAST = 10.0
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
    candidates = [_with_feedforward(setting, feedforward) for setting in laws]
    search = _Search(servo, uncertainty, _for_disturbance(demands, disturbed), trial, noise)
    best: Certificate | None = None
    for setting in _shortlist(search.ranked_in_stages(candidates), demands.attempts):
        tried = replace(search.verified(setting), looked_at=len(candidates), seconds=clock() - begin)
        if not search.shortcoming(tried):
            return tried
        best = tried if best is None or tried.settled > best.settled else best
    assert best is not None
    return NotVerified(f"none of {len(candidates)} candidates is verified: the best {search.shortcoming(best)}", best)


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
    search = _Search(servo, uncertainty, _for_disturbance(demands, disturbed), trial, noise)
    tried = replace(search.verified(setting), looked_at=1, seconds=clock() - begin)
    missing = search.shortcoming(tried)
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


def _with_feedforward(setting: Design, feedforward: float) -> Design:
    return Design(setting.controller.replace(feedforward=feedforward), setting.tolerance)


class _Search:
    """Ranking and verification of settings for one question."""

    def __init__(self, servo: Servo, uncertainty: Uncertainty, demands: Demands, trial: Trial, noise: float) -> None:
        self.servo, self.uncertainty, self.demands = servo, uncertainty, demands
        self.trial, self.noise = trial, noise

    def ranked_in_stages(self, candidates: list[Design]) -> list[Design]:
        """Candidates in the order of `ranked`: integral action is tried with the best gains without it only."""
        plain = [setting for setting in candidates if not setting.controller.Ki]
        if not plain or len(plain) == len(candidates):
            return self.ranked(candidates)
        gains = {_gains(setting.controller) for setting in self.ranked(plain)[:_GAINS_WITH_INTEGRAL]}
        with_integral = [each for each in candidates if each.controller.Ki and _gains(each.controller) in gains]
        return self.ranked(plain + with_integral)

    def ranked(self, candidates: list[Design]) -> list[Design]:
        """Candidates that meet the demands on a few machines first, then by cost."""
        demands = self.demands
        members = draw(self.servo, self.uncertainty, demands.screened, demands.conditions, demands.seed)
        measures = assess([self._quick(setting) for setting in candidates], members, self.trial.half)

        def rank(k: int) -> tuple[bool, float]:
            few = measures[k]
            fails = float(np.mean(few.settled)) < demands.settled or few.overshoot.max() > demands.overshoot
            fails = fails or bool(few.tail.max() > _ROUNDED * self._largest_error(candidates[k]))
            return fails, self._cost(candidates[k], few)

        return [candidates[k] for k in sorted(range(len(candidates)), key=rank)]

    def _quick(self, setting: Design) -> Design:
        """The setting as it is ranked: in continuous time where the rate is so high that the order is the same there.

        The verification is at the rate in any case.
        """
        rate = setting.controller.sample_rate
        if rate is None or rate < _FAST * self.trial.rate:
            return setting
        return Design(setting.controller.replace(sample_rate=None), setting.tolerance)

    def verified(self, setting: Design) -> Certificate:
        """Certificate of a setting, on machines drawn for it alone."""
        demands, known = self.demands, self.uncertainty
        seed = _seed(self.servo, known, setting, demands.seed)
        members = draw_independently(self.servo, known, demands.machines, seed)
        (measures,) = assess([setting], members, self.trial)
        law = unfed(setting.controller)
        loop = margins_in_every_zone(self.servo, widened(known, demands), setting.controller)
        settled = int(measures.settled.sum())
        ends = (np.array(known.input_bias), np.array(known.friction), known.step[1])
        return Certificate(
            setting=setting,
            gap=known.gap,
            input_bias=known.input_bias,
            step=known.step,
            friction=known.friction,
            members=members.count,
            settled=settled / members.count,
            cost=self._cost(setting, measures),
            tail=float(measures.tail.max()),
            tail_p95=float(np.percentile(measures.tail, 95.0)),
            error_rms=float(measures.error_rms.max()),
            effort=float(measures.effort.max()),
            overshoot=float(measures.overshoot.max()),
            settling=float(np.percentile(measures.settling, 95.0)),
            settling_worst=float(measures.settling.max()),
            within=float(np.max(left_over(setting, self.servo, *ends))),
            Ms=loop.Ms,
            crossover=loop.crossover,
            phase_margin=loop.phase_margin,
            saturated=bool(measures.saturated.any()),
            looked_at=0,
            seconds=0.0,
            settled_least=share_at_least(settled, members.count, demands.confidence),
            confidence=demands.confidence,
            loop=loop,
            beyond=self._beyond(setting, seed),
            ramp=follow_ramp(self.servo, known, setting, self.trial, demands.seed),
            rate=law.sample_rate,
            delay=0 if law.sample_rate is None else known.delay,
            error_per_volt=0.0 if law.Ki else 1.0 / abs(law.Kp),
            lag=_lag(self.servo, law),
        )

    def shortcoming(self, tried: Certificate) -> str:
        """Name the demand that is not met; empty where all are met."""
        demands, loop = self.demands, tried.loop
        assert loop is not None
        if missing := _margins_missing(loop, tried.rate, demands):
            return missing
        if tried.crossover == 0.0:
            return "has no gain crossover: its loop gain is below one at every frequency"
        if tried.settled_least < demands.settled:
            return (
                f"settles on {100.0 * tried.settled:.1f} % of {tried.members} simulated machines, so that with "
                f"{100.0 * tried.confidence:g} % confidence at least {100.0 * tried.settled_least:.1f} % settle, and "
                f"{100.0 * demands.settled:g} % are demanded"
            )
        allowed = self._largest_error(tried.setting)
        if tried.tail > _ROUNDED * allowed:
            return f"is off by {1e3 * tried.tail:.3g} mm in the end, and {1e3 * allowed:.3g} mm are allowed"
        if tried.overshoot > demands.overshoot:
            return f"overshoots by {100.0 * tried.overshoot:.0f} %, and {100.0 * demands.overshoot:.0f} % are allowed"
        if tried.ramp is not None and tried.ramp.settled < 1.0:
            share = 100.0 * tried.ramp.settled
            return f"settles after a ramp and its reversal on {share:.0f} % of {tried.ramp.machines} machines only"
        if tried.beyond is not None and tried.beyond.settled < 1.0:
            share = 100.0 * tried.beyond.settled
            return f"comes to rest on {share:.1f} % of {tried.beyond.machines} machines beyond the stated ranges only"
        return ""

    def _largest_error(self, setting: Design) -> float:
        """m, that may be left in the end."""
        sensor = setting.controller.leave * setting.tolerance + COUNTS * self.servo.position_resolution
        return min(self.demands.tail, self.demands.error * self.uncertainty.step[1] + sensor)

    def _cost(self, setting: Design, measures: MachineMeasures) -> float:
        return float(np.percentile(measures.cost, 95.0)) + self._price(setting)

    def _price(self, setting: Design) -> float:
        """s, price of the noise in the voltage."""
        law = setting.controller
        if not self.noise:
            return 0.0
        begin, end = (edge / (2.0 * math.pi * self.servo.controller.Tf) for edge in _NOISE_BAND)
        end = end if law.sample_rate is None else 0.5 * law.sample_rate
        effort = setting.noise_effort(self.noise, (min(begin, 0.1 * end), end))
        authority = abs(self.servo.controller.Kp) * self.uncertainty.step[1]
        return self.demands.effort_weight * self.trial.unit * effort / authority

    def _beyond(self, setting: Design, seed: int) -> BeyondResult | None:
        """Result in the ranges that nobody stated."""
        beyond, servo, known = self.demands.beyond, self.servo, self.uncertainty
        if beyond.machines == 0:
            return None
        force = beyond.friction * abs(servo.controller.Kp) * known.step[0] * servo.k_T / servo.R
        force = max(known.friction[1], force) if servo.rigid else known.friction[1]
        wide = widened(known, self.demands)
        ranges = known.replace(k_T=wide.k_T, delay=wide.delay, friction=(known.friction[0], force))
        members = draw_independently(servo, ranges, beyond.machines, seed + 1)
        (measures,) = assess([setting], members, self.trial)
        return BeyondResult(
            k_T=wide.k_T,
            delay=wide.delay,
            friction=force,
            machines=members.count,
            settled=float(np.mean(measures.at_rest)),
            tail=float(measures.tail.max()),
        )


def _margins_missing(loop: LoopMargins, rate: float | None, demands: Demands) -> str:
    """Name the demand on margins that is not met; empty where all are met."""
    at = "" if rate is None else f" at {rate:g} Hz with up to {loop.delay} samples of delay"
    if not math.isfinite(loop.Ms_worst):
        return f"is unstable{at} on a plant of the stated ranges even without a gap"
    if loop.Ms > _ROUNDED * demands.Ms:
        return f"has Ms = {loop.Ms:.3g} on the model, and {demands.Ms:g} is allowed"
    if loop.Ms_worst > _ROUNDED * demands.Ms_worst:
        return f"has Ms = {loop.Ms_worst:.3g}{at} on a plant of the stated ranges, and {demands.Ms_worst:g} is allowed"
    return ""


def _lag(servo: Servo, law: Controller) -> float:
    """s: steady error behind a ramp, per speed; the motor integrates, so a law without integral action lags."""
    if law.Ki:
        return 0.0
    plant = servo.plant()
    corners = np.abs(plant.poles())
    slow = 1e-4 * float(corners[corners > 1e-9 * corners.max()].min())
    return 1.0 / (abs(law.Kp) * slow * float(np.abs(plant.response(slow))))


def _seed(servo: Servo, uncertainty: Uncertainty, setting: Design, seed: int) -> int:
    """Seed that depends on the whole question: equal ones are answered equally, others by other machines.

    A feedforward counts by what it leaves of the bias.
    """
    fed = setting.controller.feedforward
    left = [f"{bias + fed:.9g}" for bias in uncertainty.input_bias]
    rest = _with_feedforward(setting, 0.0), uncertainty.replace(input_bias=(0.0, 0.0))
    question = repr((servo.version, rest, left, seed))
    return int.from_bytes(hashlib.sha256(question.encode()).digest()[:7], "big")
