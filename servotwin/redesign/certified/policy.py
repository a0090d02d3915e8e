"""The default policy: a setting verified on all machines that the evidence allows, otherwise the fallback set."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from time import perf_counter
from typing import ClassVar, Protocol

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.estimation.trend import Trend
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.messages import Band, Setting
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.assess import NEAR
from servotwin.redesign.certified.certificate import Certificate, Demands, NotVerified
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import LearntFactors, Range, Region, Uncertainty
from servotwin.redesign.dead_zones import gap_range
from servotwin.redesign.design import Design
from servotwin.redesign.policy import Evidence, Redesign

# Relative: a smaller change of a gain is not worth an update.
_SAME = 1e-3
# Voltages, relative to the answer of the servo's own Kp to the smallest step: a smaller change of the feedforward is
# not worth an update; the least half-width of the range of input biases, however well one is estimated; a voltage at
# rest that differs by so much from the feedforward indicates friction, which stops the motor short of its reference.
_SAME_FEEDFORWARD, _BIAS_FLOOR, _BIAS_MOVED = 7e-3, 1.5e-3, 0.035


class Verifier(Protocol):
    """Source of verified settings for a region: by simulation, or from a table.

    Attributes
    ----------
    provisional : bool
        True when its certificates are those of wider regions, and the region itself is still to be verified.
    """

    @property
    def provisional(self) -> bool: ...

    def verify(self, region: Region, running: Setting | None) -> Certificate | NotVerified:
        """Find a verified setting for a region; `running` is in force, where that is known."""
        ...

    def fallback(self) -> Certificate:
        """Certificate of the setting for the whole stated range."""
        ...


@dataclass(frozen=True)
class CertifiedPolicy:
    """Policy that verifies settings by simulation on the joint uncertainty of gap, plant, input bias and steps.

    Parameters
    ----------
    servo : Servo
        The model.
    uncertainty : Uncertainty
        Prior knowledge, before any window; the fallback set is verified for its range of gaps.
    demands : Demands
    trial : Trial, optional
        Made for the servo by default.
    feedforward_limit : float
        V, either sign.
    horizon : float
        s for which a setting is to hold: the gap may grow meanwhile as fast as the trend says.
    clock : callable
        s, from which the certificates' computing times are taken.
    """

    servo: Servo
    uncertainty: Uncertainty = field(default_factory=lambda: Uncertainty(input_bias=(-0.1, 0.1)))
    demands: Demands = field(default_factory=Demands)
    trial: Trial | None = None
    feedforward_limit: float = 0.2
    horizon: float = 40.0
    needs_estimate: ClassVar[bool] = False
    provisional: ClassVar[bool] = False
    clock: Callable[[], float] = field(default=perf_counter, compare=False)

    @property
    def simulations(self) -> Trial:
        """Trial of every verification.

        Raises
        ------
        InvalidInput
            No candidate is within the bounds on Ms.
        """
        return self.trial or trial_for(self.servo, self.uncertainty, self.demands)

    @property
    def smallest_answer(self) -> float:
        """V, with which the servo's own Kp answers the smallest step: the unit of small voltages."""
        return abs(self.servo.controller.Kp) * self.uncertainty.step[0]

    @property
    def bias_floor(self) -> float:
        """V: least half-width of the range of input biases, however well one is estimated."""
        return _BIAS_FLOOR * self.smallest_answer

    def redesign(self, evidence: Evidence) -> Redesign:
        """Choose the verified setting for the evidence; without one the fallback set, and the reason.

        The setting must stay within the fallback set's band, since the edge falls back when the loop leaves it. Where
        the gap may be wider than the stated range nothing is sent: not even the fallback set is verified there. Where
        the window's own estimate is unusable, its input bias still counts, with the gap of the trend.
        """
        return self.decide(evidence, self if evidence.machine is None else _LearntVerifier(self, evidence.machine))

    def decide(self, evidence: Evidence, verifier: Verifier) -> Redesign:
        """Choose as `redesign` does, with the certificates of `verifier`."""
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
        feedforward, input_bias = self._input_bias(evidence)
        region = Region(gap, feedforward, input_bias, self._friction(evidence), _noise(evidence))
        result = verifier.verify(region, evidence.setting)
        if isinstance(result, NotVerified):
            return _fallback_redesign(verifier.fallback(), region, result.reason)
        if _in_force(result.setting, evidence, _SAME_FEEDFORWARD * self.smallest_answer):
            return Redesign(None, estimate.gap, "the verified setting is in force already", certificate=result)
        redesign = _redesign(result, region.noise, estimate.gap, "")
        return replace(redesign, to_verify=region) if verifier.provisional else redesign

    def verify(self, region: Region, _running: Setting | None = None) -> Certificate | NotVerified:
        """Find the cheapest setting for a region, by simulation."""
        known = region.within(self.uncertainty)
        return certify(
            self.servo,
            known,
            self.demands_within_band(),
            self.simulations,
            region.feedforward,
            region.noise,
            self.clock,
        )

    def confirm(self, region: Region, setting: Design) -> Certificate | NotVerified:
        """Verify one setting for a region, by simulation."""
        known = region.within(self.uncertainty)
        return confirm(
            self.servo, known, setting, self.demands_within_band(), self.simulations, region.noise, self.clock
        )

    def demands_within_band(self) -> Demands:
        """Demands with the fallback set's band as a bound; a dead zone must open the loop inside of that band."""
        certificate, leave = self.fallback(), max((leave for _, leave in self.demands.hysteresis), default=1.0)
        tolerance = min(self.demands.tolerance, band_of(certificate).error / leave)
        # Less than what counts as arrived for the smallest step is no error.
        tail = max(certificate.tail, NEAR * self.uncertainty.step[0])
        return replace(self.demands, tail=min(self.demands.tail, tail), tolerance=tolerance)

    def fallback(self) -> Certificate:
        """Certificate of the setting for every gap and bias of the stated range, whatever is estimated.

        Raises
        ------
        InvalidInput
            No setting is verified for the whole range: state a narrower one, or lower the demands.
        """
        return _fallback(self.servo, self.uncertainty, self.demands, self.simulations)

    def _estimate(self, evidence: Evidence) -> GapEstimate | None:
        if not evidence.unusable:
            return evidence.estimate
        trend, bias_known = evidence.trend, math.isfinite(evidence.disturbance.bias_std)
        return trend.as_estimate() if bias_known and trend is not None and trend.updates > 0 else None

    def _gap(self, estimate: GapEstimate, trend: Trend | None) -> Range:
        """Range of gaps until `horizon` has passed; one window alone tells nothing about wear."""
        low, high = gap_range(estimate)
        grows = trend is not None and trend.updates > 1
        return low, high + (self.horizon * max(0.0, trend.rate_interval[1]) if trend is not None and grows else 0.0)

    def _input_bias(self, evidence: Evidence) -> tuple[float, Range]:
        """Feedforward (V), and the range of input biases; a bias that is not significantly off the feedforward in force
        leaves it as it is."""
        disturbance = evidence.disturbance
        gains = evidence.gains
        fed = gains.feedforward if gains is not None else 0.0
        if not math.isfinite(disturbance.bias_std):
            return fed, self.uncertainty.input_bias
        limit, spread = self.feedforward_limit, max(NORMAL_95 * disturbance.bias_std, self.bias_floor)
        # Only a significant change: every new feedforward is an update at the edge.
        if abs(disturbance.bias + fed) > spread:
            fed = min(max(-disturbance.bias, -limit), limit)
        return fed, (disturbance.bias - spread, disturbance.bias + spread)

    def _friction(self, evidence: Evidence) -> Range:
        """Range of friction torques (N m): as stated, widened to the torque that the last feedforward left at rest."""
        disturbance, now = evidence.disturbance, evidence.gains
        low, high = self.uncertainty.friction
        if evidence.tuned_for is None or now is None or not math.isfinite(disturbance.bias_std):
            return low, high
        left = abs(disturbance.bias + now.feedforward)
        return low, max(
            high, left * self.servo.k_T / self.servo.R
        ) if left > _BIAS_MOVED * self.smallest_answer else high


# Standard deviations, relative, of stiffness and damping below which a learnt machine is not believed: what the model
# leaves out does not average away with the windows.
_LEAST_K, _LEAST_C = 0.002, 0.01


@dataclass(frozen=True)
class _LearntVerifier:
    """Verification by simulation on what was learnt of the machine, in place of the model's stated error.

    Its numbers are those of k/m and c/m: the masses are taken as the model's. The fallback set stays that of the stated
    ranges.
    """

    policy: CertifiedPolicy
    machine: FactorPrior
    provisional: ClassVar[bool] = False

    def verify(self, region: Region, _running: Setting | None = None) -> Certificate | NotVerified:
        policy, covariance = self.policy, self.machine.covariance[:2, :2] + np.diag([_LEAST_K**2, _LEAST_C**2])
        spread = tuple(tuple(row) for row in covariance.tolist())
        learnt = LearntFactors(("k", "c"), (0.0, 0.0), spread)
        return certify(
            adapted(policy.servo, self.machine.mean),
            region.within(policy.uncertainty).replace(learnt=learnt, m=0.0),
            policy.demands_within_band(),
            policy.simulations,
            region.feedforward,
            region.noise,
            policy.clock,
        )

    def fallback(self) -> Certificate:
        return self.policy.fallback()


def _noise(evidence: Evidence) -> float:
    """Measurement noise, m rms; 0 where it is unknown."""
    noise = evidence.disturbance.noise
    return noise if math.isfinite(noise) else 0.0


def _in_force(setting: Design, evidence: Evidence, small: float) -> bool:
    """True when the edge runs the setting already, by its last report, but for a `small` (V) change of feedforward."""
    now, new = evidence.gains, setting.controller
    if now is None or evidence.setting is None or abs(now.feedforward - new.feedforward) > small:
        return False
    names = ("Kp", "Ki", "Kd", "Tf", "enter", "leave", "integral_only")
    gains = ((getattr(now, name), getattr(new, name)) for name in names)
    pairs = (*gains, (evidence.setting.tolerance, setting.tolerance))
    return all(math.isclose(a, b, rel_tol=_SAME, abs_tol=0.0) for a, b in pairs)


def band_of(certificate: Certificate, noise: float = 0.0) -> Band:
    """Band within which the loop stays once it has arrived, `noise` (m rms) included.

    The simulated machines are a sample: the real one may need half as long again as the slowest of them.
    """
    error = max(certificate.within, certificate.tail) + noise
    effort = certificate.effort + abs(certificate.setting.controller.Kp) * (NEAR * certificate.step[1] + noise)
    return Band(error, error, effort, math.ceil(1.5 * certificate.settling_worst))


@lru_cache(maxsize=16)
def _fallback(servo: Servo, uncertainty: Uncertainty, demands: Demands, trial: Trial) -> Certificate:
    result = certify(servo, uncertainty, demands, trial)
    if isinstance(result, NotVerified):
        raise InvalidInput(f"no fallback set for the servo's stated range: {result.reason}")
    return result


def _fallback_redesign(certificate: Certificate, region: Region, reason: str) -> Redesign:
    law = certificate.setting.controller.replace(feedforward=region.feedforward)
    certificate = replace(certificate, setting=replace(certificate.setting, controller=law))
    return _redesign(certificate, region.noise, math.nan, f"{reason}; the fallback set is sent")


def _redesign(certificate: Certificate, noise: float, gap: float, reason: str) -> Redesign:
    """Redesign that sends a certificate's setting, with its band."""
    return Redesign(certificate.setting.setting(band_of(certificate, noise)), gap, reason, certificate)
