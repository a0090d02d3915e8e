"""Verification of one setting, in parts: what is cheap and refuses most comes first, and each part is computed once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servotwin.control.laws import AnyController, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.control.retuning import filter_time, integrates, law_for_margins, only_integrates, rest_gain, static_gain
from servotwin.plant.display_units import position_unit
from servotwin.plant.law_loop import law_response
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array
from servotwin.redesign.certified.assess import (
    COUNTS,
    MachineMeasures,
    arrival_error,
    assess,
    joined,
    steady_error,
    unseen_error,
)
from servotwin.redesign.certified.certificate import BeyondResult, Certificate, LongResult, LoopMargins, RampResult
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import own_static_gain, slow_response
from servotwin.redesign.certified.machines import SimulatedMachines, draw_independently
from servotwin.redesign.certified.margins import margins_in_every_zone, widened
from servotwin.redesign.certified.seeds import seed_of
from servotwin.redesign.certified.settling_test import SettlingTest
from servotwin.redesign.certified.tracking import follow_ramp
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design

# Where the band of measurement noise begins and ends, in units of 1 / Tf: well above the crossover, and where a sampled
# loop of that speed has half its rate.
_NOISE_BAND = (6.0, 1600.0)
# The error that an input bias leaves is the same number on every plant, but for rounding.
ROUNDED = 1.0 + 1e-6

# Machines that are simulated before the rest, in lots: a setting that leaves some of the gaps oscillating shows it on
# them, and mostly on the first few.
_LOTS = (12, 36, 75, 150)
# Share of the machines beyond the stated ranges that comes to rest at least: 60 that all do show it with 95 %
# confidence.
_SETTLED_BEYOND = 0.95
# Machines that a failed attempt leaves for the next candidates, and the share of them that a candidate may miss.
_HARD, _MOST_HARD = 4, 0.5
# Long runs where an integral may wind up against friction: machines, of which the first show most failures, and length
# in that of the other runs.
_LONG_MACHINES, _LONG = (12, 60), 20.0


@dataclass(frozen=True)
class Question:
    """Conditions of a verification: the model and its uncertainty, demands, simulations, noise (m rms)."""

    servo: Plant
    uncertainty: Uncertainty
    demands: Demands
    trial: Trial
    noise: float

    @cached_property
    def settling(self) -> SettlingTest:
        """Test of the share that settles."""
        demands = self.demands
        return SettlingTest(demands.settled, demands.confidence, demands.machines, demands.failures)

    @cached_property
    def settling_beyond(self) -> SettlingTest:
        """Test of the share that comes to rest beyond the stated ranges."""
        return SettlingTest(_SETTLED_BEYOND, self.demands.confidence, self.demands.beyond.machines)

    @property
    def is_held(self) -> bool:
        """True where friction may hold the motor."""
        return self.uncertainty.friction[1] + self.servo.own_friction > 0.0

    def shortcoming(self, tried: Certificate) -> str:
        """Name the demand that is not met; empty where all are met."""
        demands, loop = self.demands, tried.loop
        assert loop is not None
        if missing := margins_missing(loop, tried.rate, demands):
            return missing
        if tried.crossover == 0.0:
            return "has no gain crossover: its loop gain is below one at every frequency"
        if tried.settled_least < demands.settled:
            return (
                f"settles on {100.0 * tried.settled:.1f} % of {tried.members} simulated machines, so that with "
                f"{100.0 * tried.confidence:g} % confidence at least {100.0 * tried.settled_least:.1f} % settle, and "
                f"{100.0 * demands.settled:g} % are demanded"
            )
        allowed = self.largest_error(tried.setting)
        if tried.tail > ROUNDED * allowed:
            unit = position_unit(self.servo)
            off, most = (f"{unit.factor * error:.3g} {unit.name}" for error in (tried.tail, allowed))
            return f"is off by {off} in the end, and {most} are allowed{self._larger_step(tried.setting)}"
        if tried.overshoot > demands.overshoot:
            return f"overshoots by {100.0 * tried.overshoot:.0f} %, and {100.0 * demands.overshoot:.0f} % are allowed"
        if tried.ramp is not None and tried.ramp.settled < 1.0:
            share = 100.0 * tried.ramp.settled
            return f"settles after a ramp and its reversal on {share:.0f} % of {tried.ramp.machines} machines only"
        if tried.long is not None and tried.long.settled < 1.0:
            share, long = 100.0 * tried.long.settled, tried.long
            return f"stays at rest for {long.duration:.3g} s on {share:.1f} % of {long.machines} machines only"
        if tried.beyond is not None and self.misses_beyond(tried.beyond):
            share, least = 100.0 * tried.beyond.settled, 100.0 * tried.beyond.settled_least
            return (
                f"comes to rest on {share:.1f} % of {tried.beyond.machines} machines beyond the stated ranges only, so "
                f"that at least {least:.1f} % do, and {100.0 * _SETTLED_BEYOND:g} % are demanded"
            )
        return ""

    def misses_beyond(self, found: BeyondResult) -> bool:
        """True where too few machines come to rest beyond the stated ranges; all must of so few that none may fail."""
        test = self.settling_beyond
        return found.settled < 1.0 if test.allowed_first < 0 else found.settled_least < test.share

    def largest_error(self, setting: Design) -> float:
        """m, that may be left in the end."""
        sensor = setting.controller.leave * setting.tolerance + COUNTS * self.servo.position_resolution
        known = self.uncertainty
        unseen = float(unseen_error(self.servo, known.gap[1], 1.0 + known.own_friction))
        return min(self.demands.tail, self.demands.error * known.step[1] + sensor + unseen)

    def _larger_step(self, setting: Design) -> str:
        """Name the largest step for which the steady error of a setting would be allowed; empty where it is."""
        left, allowed = steady_error(setting, self.servo, self.uncertainty), self.largest_error(setting)
        share, step = self.demands.error, self.uncertainty.step[1]
        if left <= ROUNDED * allowed or allowed == self.demands.tail:
            return ""
        unit = position_unit(self.servo)
        held, needed, most = (
            f"{unit.factor * x:.3g} {unit.name}" for x in (left, step + (left - allowed) / share, step)
        )
        return (
            f": bias and friction may hold it {held} off, which is allowed where the largest stated step is at least "
            f"{needed}, not {most}"
        )

    def margins(self, setting: Design, between: bool = True) -> LoopMargins:
        """Margins of a setting on the plants of the stated ranges and beyond, for all delays or the ends alone."""
        return margins_in_every_zone(self.servo, widened(self.uncertainty, self.demands), setting.controller, between)

    def missed(self, setting: Design, few: MachineMeasures) -> NDArray[np.bool_]:
        """True for machines on which a setting misses a demand: it does not settle, is off in the end or overshoots."""
        off = few.tail > ROUNDED * self.largest_error(setting)
        return np.asarray(~few.settled | off | (few.overshoot > self.demands.overshoot))

    def cost(self, setting: Design, costs: Array) -> float:
        """s: 95th percentile of the error's integral per step (s, of each machine), plus the price of the noise."""
        return _percentile_95(costs) + self.price(setting)

    def price(self, setting: Design) -> float:
        """s, price of the noise in the voltage."""
        law = setting.controller
        if not self.noise:
            return 0.0
        time = filter_time(self.servo.controller) or self.trial.unit
        begin, end = (edge / (2.0 * math.pi * time) for edge in _NOISE_BAND)
        end = end if law.sample_rate is None else 0.5 * law.sample_rate
        effort = setting.noise_effort(self.noise, (min(begin, 0.1 * end), end))
        authority = own_static_gain(self.servo) * self.uncertainty.step[1]
        return self.demands.effort_weight * self.trial.unit * effort / authority


def _percentile_95(values: Array) -> float:
    """95th percentile, inf where it lies among values without end: numpy's interpolation of these is no number."""
    with np.errstate(invalid="ignore"):
        found = float(np.percentile(values, 95.0))
    return math.inf if math.isnan(found) else found


class Attempt:
    """One setting, verified on machines drawn for it alone."""

    def __init__(self, question: Question, setting: Design) -> None:
        self.question, self.setting = question, setting
        self._seed = seed_of(question.servo, question.uncertainty, setting, question.demands.seed)
        self._measures: MachineMeasures | None = None

    def fails_early(self, hard: Sequence[SimulatedMachines]) -> bool:
        """True where what is cheap shows that the demands are not met: margins, `hard` machines and a ramp."""
        question, setting = self.question, self.setting
        if margins_missing(self._loop, setting.controller.sample_rate, question.demands):
            return True
        count, missed = sum(machines.count for machines in hard), 0
        for machines in hard:
            (few,) = assess([setting], machines, question.trial)
            missed += int(question.missed(setting, few).sum())
            if missed > (_MOST_HARD * count if question.demands.failures else 0):
                return True
        return self._ramp.settled < 1.0

    def cannot_pass(self) -> bool:
        """True where a part shows already that the certificate would not meet the demands."""
        demands, rate = self.question.demands, self.setting.controller.sample_rate
        if margins_missing(self._loop, rate, demands) or self._loop.crossover == 0.0:
            return True
        if any(self._refused_by(self._measured(lot)) for lot in _LOTS):
            return True
        if self._ramp.settled < 1.0 or (self._long is not None and self._long.settled < 1.0):
            return True
        return self._beyond is not None and self.question.misses_beyond(self._beyond)

    def _refused_by(self, few: MachineMeasures) -> bool:
        """True where some of the machines show already that a demand is not met."""
        demands, allowed = self.question.demands, self.question.largest_error(self.setting)
        if self.question.settling.is_refused(int(np.sum(~few.settled))):
            return True
        return bool(few.tail.max() > ROUNDED * allowed or few.overshoot.max() > demands.overshoot)

    def verified(self) -> Certificate | None:
        """Certificate of the setting, where it meets the demands."""
        tried = self.decided()
        return None if self.question.shortcoming(tried) else tried

    def decided(self) -> Certificate:
        """Certificate of the setting, on further machines where the first ones leave open whether enough settle."""
        first, test = self._measured(self.question.demands.machines), self.question.settling
        if test.is_open(int(np.sum(~first.settled))) and not self.cannot_pass():
            self._go_on()
        return self.certificate()

    def reached(self) -> tuple[int, float]:
        """Machines on which the setting was simulated, and the share of these that settled."""
        measures = self._measures
        return (0, 0.0) if measures is None else (len(measures.cost), float(np.mean(measures.settled)))

    def missed(self) -> list[SimulatedMachines]:
        """Machines on which the setting was simulated so far and missed a demand: the first few; none where the demands
        allow in the first sample that one does."""
        if self._measures is None or self.question.settling.allowed_first > 0:
            return []
        places = np.flatnonzero(self.question.missed(self.setting, self._measures)[: self._members.count])[:_HARD]
        return [self._members.each(places)] if places.size else []

    def certificate(self) -> Certificate:
        """Certificate of the setting, whether or not it meets the demands."""
        question, setting = self.question, self.setting
        loop = question.margins(setting)
        known, law = question.uncertainty, law_for_margins(setting.controller)
        measures = self._measured(question.demands.machines)
        members, failures = len(measures.cost), int(np.sum(~measures.settled))
        friction = np.array(known.friction) + np.array(known.own_friction_of(question.servo))
        ends = (np.array(known.input_bias), friction, known.step[1])
        return Certificate(
            setting=setting,
            gap=known.gap,
            input_bias=known.input_bias,
            step=known.step,
            friction=known.friction,
            members=members,
            settled=1.0 - failures / members,
            cost=question.cost(setting, measures.cost),
            tail=float(measures.tail.max()),
            tail_p95=_percentile_95(measures.tail),
            error_rms=float(measures.error_rms.max()),
            effort=float(measures.effort.max()),
            overshoot=float(measures.overshoot.max()),
            settling=_percentile_95(measures.settling),
            settling_worst=float(measures.settling.max()),
            within=float(np.max(arrival_error(setting, question.servo, *ends))),
            Ms=loop.Ms,
            crossover=loop.crossover,
            phase_margin=loop.phase_margin,
            saturated=bool(measures.saturated.any()),
            looked_at=0,
            seconds=0.0,
            settled_least=question.settling.at_least(failures, members),
            confidence=question.demands.confidence,
            loop=loop,
            beyond=self._beyond,
            ramp=self._ramp,
            long=self._long,
            rate=law.sample_rate,
            delay=0 if law.sample_rate is None else known.delay,
            error_per_volt=0.0 if integrates(law) else 1.0 / rest_gain(law),
            lag=_lag(question.servo, setting.controller),
            own_friction=known.own_friction if question.servo.own_friction else 0.0,
        )

    @cached_property
    def _loop(self) -> LoopMargins:
        return self.question.margins(self.setting, between=False)

    @cached_property
    def _members(self) -> SimulatedMachines:
        question = self.question
        return draw_independently(question.servo, question.uncertainty, question.demands.machines, self._seed)

    def _measured(self, count: int) -> MachineMeasures:
        """Measures of the first machines, at least so many or all; each is simulated once."""
        before, members = self._measures, self._members
        done, last = (0 if before is None else len(before.cost)), min(count, members.count)
        if before is not None and last <= done:
            return before
        largest = float(members.step.max())
        (new,) = assess([self.setting], members.part(done, last), self.question.trial, largest)
        self._measures = new if before is None else joined(before, new)
        return self._measures

    def _go_on(self) -> None:
        """Simulate further machines, in lots, until enough settle or too many do not."""
        question, test, found = self.question, self.question.settling, self._measured(self.question.demands.machines)
        largest = float(self._members.step.max())
        further = draw_independently(question.servo, question.uncertainty, test.whole - test.first, self._seed + 2)
        for begin in range(0, further.count, test.first):
            part = further.part(begin, min(begin + test.first, further.count))
            (new,) = assess([self.setting], part, question.trial, largest)
            self._measures = found = joined(found, new)
            if self._refused_by(found):
                return

    @cached_property
    def _ramp(self) -> RampResult:
        question = self.question
        return follow_ramp(question.servo, question.uncertainty, self.setting, question.trial, question.demands.seed)

    @cached_property
    def _long(self) -> LongResult | None:
        """Result of long runs; None where no integral winds up against friction."""
        question = self.question
        if not question.is_held or not integrates(self.setting.controller):
            return None
        duration = _LONG * question.trial.duration
        trial = replace(question.trial, duration=duration, last=0.5 * duration)
        settled = np.empty(0, dtype=bool)
        for last in sorted({min(count, self._members.count) for count in _LONG_MACHINES}):
            (measures,) = assess([self.setting], self._members.part(settled.size, last), trial)
            settled = np.concatenate([settled, measures.settled.ravel()])
            if not settled.all():
                break
        return LongResult(settled.size, duration, float(np.mean(settled)))

    @cached_property
    def _beyond(self) -> BeyondResult | None:
        """Result in the ranges that nobody stated."""
        question = self.question
        beyond, servo, known = question.demands.beyond, question.servo, question.uncertainty
        if beyond.machines == 0:
            return None
        force = servo.torque_of(beyond.friction * own_static_gain(servo) * known.step[0])
        force = max(known.friction[1], force) if servo.takes_friction else known.friction[1]
        wide = widened(known, question.demands)
        ranges = known.replace(k_T=wide.k_T, delay=wide.delay, friction=(known.friction[0], force))
        test = question.settling_beyond
        members = draw_independently(servo, ranges, test.whole, self._seed + 1)
        (measures,) = assess([self.setting], members.part(0, test.first), question.trial)
        if test.is_open(int(np.sum(~measures.at_rest))):
            (further,) = assess([self.setting], members.part(test.first, test.whole), question.trial)
            measures = joined(measures, further)
        return BeyondResult(
            k_T=wide.k_T,
            delay=wide.delay,
            friction=force,
            machines=len(measures.cost),
            settled=float(np.mean(measures.at_rest)),
            tail=float(measures.tail.max()),
            settled_least=test.at_least(int(np.sum(~measures.at_rest)), len(measures.cost)),
        )


def margins_missing(loop: LoopMargins, rate: float | None, demands: Demands) -> str:
    """Name the demand on margins that is not met; empty where all are met."""
    at = "" if rate is None else f" at {rate:g} Hz with up to {loop.delay} samples of delay"
    if not math.isfinite(loop.Ms_worst):
        return f"is unstable{at} on a plant of the stated ranges even without a gap"
    if loop.Ms > ROUNDED * demands.Ms:
        return f"has Ms = {loop.Ms:.3g} on the model, and {demands.Ms:g} is allowed"
    if loop.Ms_worst > ROUNDED * demands.Ms_worst:
        return f"has Ms = {loop.Ms_worst:.3g}{at} on a plant of the stated ranges, and {demands.Ms_worst:g} is allowed"
    return ""


def _lag(servo: Plant, law: AnyController) -> float:
    """s: steady error behind a ramp, per speed, of a machine whose motor integrates.

    The integral of a filtered PID takes it to zero, unless it moves the motor itself; that of a cascade integrates the
    speed's error and need not.
    """
    running = law_of(law)
    slow, gain = slow_response(servo)
    if isinstance(running, LinearLaw):
        reference, motor, load = law_response(running, slow)
        followed = gain * reference / (1.0 - gain * (motor / servo.p + load))
        return float(abs((1.0 - followed) / slow))
    if only_integrates(running):
        return 1.0 / abs(gain * running.Ki)
    if integrates(law):
        return 0.0
    return abs(1.0 / (slow * abs(gain)) - running.velocity_feedforward) / abs(static_gain(law))
