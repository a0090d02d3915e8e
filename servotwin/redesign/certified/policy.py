"""The default policy: send what was proved for everything the evidence allows, otherwise the fallback set."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from time import perf_counter
from typing import ClassVar

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.messages import Band, Setting
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import NEAR, Trial
from servotwin.redesign.certified.certificate import Certificate, Demands, Refusal
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.region import Prover, Region
from servotwin.redesign.certified.uncertainty import Range, Uncertainty
from servotwin.redesign.dead_zones import gap_range
from servotwin.redesign.design import Design
from servotwin.redesign.evidence import Evidence
from servotwin.redesign.policy import Redesign

# Relative, and V: nobody is troubled with an update for less.
_SAME, _SAME_FEEDFORWARD = 1e-3, 1e-3


@dataclass(frozen=True)
class CertifiedPolicy:
    """A setting proved by simulation on the joint uncertainty of gap, plant, input bias and steps.

    Parameters
    ----------
    servo : Servo
        The model.
    uncertainty : Uncertainty
        What is known before any window; its gap is the range that the fallback set is proved for.
    demands : Demands
    trial : Trial
    feedforward_limit : float
        V, either sign.
    bias_floor : float
        V: the input bias is never taken to be known better.
    bias_moved : float
        V: a voltage at rest that is that far from what was fed forward speaks of friction, which holds the motor short
        of its place.
    horizon : float
        s for which a setting is to hold: the gap may grow meanwhile as fast as the trend says.
    clock : callable
        s, for the certificates' own times.
    """

    servo: Servo
    uncertainty: Uncertainty = field(default_factory=lambda: Uncertainty(input_bias=(-0.1, 0.1)))
    demands: Demands = field(default_factory=Demands)
    trial: Trial = field(default_factory=Trial)
    feedforward_limit: float = 0.2
    bias_floor: float = 2e-4
    bias_moved: float = 5e-3
    horizon: float = 40.0
    needs_estimate: ClassVar[bool] = False
    owes: ClassVar[bool] = False
    clock: Callable[[], float] = field(default=perf_counter, compare=False)

    def redesign(self, evidence: Evidence) -> Redesign:
        """The proved setting for the evidence; without one the fallback set, and why.

        Nothing is sent that may leave the fallback set's band: that is what the edge holds the loop to. Nor is anything
        where the gap may be wider than the stated range: not even the fallback set is proved there.
        Where nothing may stand on the window's own estimate, what it says of the input bias still counts, with the gap
        as the trend knows it.
        """
        return self.decide(evidence, self)

    def decide(self, evidence: Evidence, prover: Prover) -> Redesign:
        """The same with what another has proved."""
        estimate = self._estimate(evidence)
        if estimate is None:
            return Redesign(None, math.nan, evidence.unusable)
        gap = self._gap(estimate, evidence.trend)
        if gap[1] > self.uncertainty.gap[1]:
            low, high, most = (math.degrees(x) for x in (*gap, self.uncertainty.gap[1]))
            reason = (
                f"the gap may be {low:.3g} to {high:.3g} deg, and at most {most:.3g} deg are certified: nothing is sent"
            )
            return Redesign(None, math.nan, reason)
        region = Region(gap, *self._input_bias(evidence), self._friction(evidence), _noise(evidence))
        found = prover.prove(region, evidence.setting)
        if isinstance(found, Refusal):
            return _fallen_back(prover.fallback(), region, found.reason)
        if _in_force(found.setting, evidence):
            return Redesign(None, estimate.gap, "what was proved is in force already", certificate=found)
        sent = _sent(found, region.noise, estimate.gap, "")
        return replace(sent, owed=region) if prover.owes else sent

    def prove(self, region: Region, _running: Setting | None = None) -> Certificate | Refusal:
        """The cheapest setting that holds in a region, by simulation."""
        known = region.within(self.uncertainty)
        return certify(self.servo, known, self.held(), self.trial, region.feedforward, region.noise, self.clock)

    def confirm(self, region: Region, setting: Design) -> Certificate | Refusal:
        """Whether one setting holds in a region."""
        known = region.within(self.uncertainty)
        return confirm(self.servo, known, setting, self.held(), self.trial, region.noise, self.clock)

    def held(self) -> Demands:
        """The demands, and the fallback set's band; a dead zone opens the loop inside of it only."""
        proved, leave = self.fallback(), max((leave for _, leave in self.demands.hysteresis), default=1.0)
        tolerance = min(self.demands.tolerance, band_of(proved).error / leave)
        return replace(self.demands, tail=min(self.demands.tail, proved.tail), tolerance=tolerance)

    def fallback(self) -> Certificate:
        """What holds for every gap and bias of the stated range, whatever is estimated.

        Raises
        ------
        InvalidInput
            Nothing is proved for the whole range: it has to be stated narrower, or the demands lower.
        """
        return _fallback(self.servo, self.uncertainty, self.demands, self.trial)

    def _estimate(self, evidence: Evidence) -> GapEstimate | None:
        if not evidence.unusable:
            return evidence.estimate
        trend, told = evidence.trend, math.isfinite(evidence.disturbance.bias_std)
        return trend.as_estimate() if told and trend is not None and trend.updates > 0 else None

    def _gap(self, estimate: GapEstimate, trend: Trend | None) -> Range:
        """Gaps to reckon with until `horizon` has passed; one window alone says nothing of wear."""
        low, high = gap_range(estimate)
        grows = trend is not None and trend.updates > 1
        return low, high + (self.horizon * max(0.0, trend.rate_interval[1]) if trend is not None and grows else 0.0)

    def _input_bias(self, evidence: Evidence) -> tuple[float, Range]:
        """What to feed forward (V), and the range of biases to reckon with; what cannot be told from the feedforward
        in force leaves it."""
        told = evidence.disturbance
        gains = evidence.gains
        fed = gains.feedforward if gains is not None else 0.0
        if not math.isfinite(told.bias_std):
            return fed, self.uncertainty.input_bias
        limit, spread = self.feedforward_limit, max(NORMAL_95 * told.bias_std, self.bias_floor)
        if abs(told.bias + fed) > spread:
            fed = min(max(-told.bias, -limit), limit)
        return fed, (told.bias - spread, told.bias + spread)

    def _friction(self, evidence: Evidence) -> Range:
        """Torques (N m) to reckon with: those stated, and what the last feedforward left at rest."""
        told, now = evidence.disturbance, evidence.gains
        low, high = self.uncertainty.friction
        if evidence.tuned_for is None or now is None or not math.isfinite(told.bias_std):
            return low, high
        left = abs(told.bias + now.feedforward)
        return low, max(high, left * self.servo.k_T / self.servo.R) if left > self.bias_moved else high


def _noise(evidence: Evidence) -> float:
    """m rms; 0 where nobody could tell."""
    noise = evidence.disturbance.noise
    return noise if math.isfinite(noise) else 0.0


def _in_force(setting: Design, evidence: Evidence) -> bool:
    """Whether the edge runs it, as far as is known."""
    now, new = evidence.gains, setting.controller
    if now is None or evidence.setting is None or abs(now.feedforward - new.feedforward) > _SAME_FEEDFORWARD:
        return False
    gains = ((getattr(now, name), getattr(new, name)) for name in ("Kp", "Ki", "Kd", "Tf", "enter", "leave"))
    pairs = (*gains, (evidence.setting.tolerance, setting.tolerance))
    return all(math.isclose(a, b, rel_tol=_SAME, abs_tol=0.0) for a, b in pairs)


def band_of(proved: Certificate, noise: float = 0.0) -> Band:
    """What the loop stays within once it has arrived, `noise` (m rms) included.

    The members are some of all machines there are: it may take half as long again as the slowest of them took.
    """
    error = max(proved.within, proved.tail) + noise
    effort = proved.effort + abs(proved.setting.controller.Kp) * (NEAR * proved.step[1] + noise)
    return Band(error, error, effort, math.ceil(1.5 * proved.settling_worst))


@lru_cache(maxsize=16)
def _fallback(servo: Servo, uncertainty: Uncertainty, demands: Demands, trial: Trial) -> Certificate:
    found = certify(servo, uncertainty, demands, trial)
    if isinstance(found, Refusal):
        raise InvalidInput(f"no fallback set for the servo's stated range: {found.reason}")
    return found


def _fallen_back(proved: Certificate, region: Region, reason: str) -> Redesign:
    law = proved.setting.controller.replace(feedforward=region.feedforward)
    sent = replace(proved, setting=replace(proved.setting, controller=law))
    return _sent(sent, region.noise, math.nan, f"{reason}; the fallback set is sent")


def _sent(proved: Certificate, noise: float, gap: float, reason: str) -> Redesign:
    """The redesign that carries a certificate."""
    return Redesign(proved.setting.setting(band_of(proved, noise)), gap, reason, proved)
