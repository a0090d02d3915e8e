"""The default policy: a setting verified on all machines that the evidence allows, otherwise the fallback set."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import ClassVar, Protocol

from servotwin.control.gains import gains_of, with_gains
from servotwin.control.retuning import integrates, static_gain
from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.estimation.learning.motor import BIAS, FRICTION, LearntMotor
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import Band, Setting
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.assess import NEAR
from servotwin.redesign.certified.certificate import Certificate, Demands, NotVerified
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.fallback import fallback_certificate
from servotwin.redesign.certified.learnt_servo import learnt_servo, narrowed
from servotwin.redesign.certified.margins import own_static_gain
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
# Friction holds the motor at up to so much more than half the difference of two rests.
_HOLDS = 1.25
# Share of the voltage at rest, up to which friction and bias of the turning motor must be known to tell it apart.
_TELLS = 0.25


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
    servo : Servo or Axis
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

    servo: Plant
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
        return own_static_gain(self.servo) * self.uncertainty.step[0]

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
        learnt = learnt_servo(self.servo, self.uncertainty, evidence.machine, evidence.motor)
        return self.decide(evidence, self if learnt is None else _LearntVerifier(self, *learnt))

    def decide(self, evidence: Evidence, verifier: Verifier) -> Redesign:
        """Choose as `redesign` does, with the certificates of `verifier`."""
        estimate = self._estimate(evidence)
        if estimate is None and not self._shows_more(evidence):
            return Redesign(None, math.nan, evidence.unusable)
        best = math.nan if estimate is None else estimate.gap
        region = self.region(evidence)
        if too_wide := self._too_wide(region):
            return Redesign(None, math.nan, too_wide)
        result = verifier.verify(region, evidence.setting)
        if isinstance(result, NotVerified):
            return _fallback_redesign(verifier.fallback(), region, result.reason)
        if _in_force(result.setting, evidence, _SAME_FEEDFORWARD * self.smallest_answer):
            return Redesign(None, best, "the verified setting is in force already", certificate=result)
        redesign = _redesign(result, region.noise, best, "")
        return replace(redesign, to_verify=region) if verifier.provisional else redesign

    def region(self, evidence: Evidence) -> Region:
        """Make the region that a setting must serve, from the evidence; gaps as stated where none was estimated."""
        estimate = self._estimate(evidence)
        gap = self.uncertainty.gap if estimate is None else self._gap(estimate, evidence.trend)
        feedforward, input_bias = self._input_bias(evidence)
        friction, noise, usual = self._friction(evidence), _noise(evidence), self._usual_step(evidence)
        return Region(gap, feedforward, input_bias, friction, noise, usual)

    def _too_wide(self, region: Region) -> str:
        """Reason to send nothing: the gap may be wider than stated; empty: it is not."""
        if region.gap[1] <= self.uncertainty.gap[1]:
            return ""
        low, high, most = (math.degrees(x) for x in (*region.gap, self.uncertainty.gap[1]))
        return f"the gap may be {low:.3g} to {high:.3g} deg, and at most {most:.3g} deg are certified: nothing is sent"

    def fall_back(self, evidence: Evidence, reason: str) -> Redesign:
        """Choose the fallback set, whatever else would be verified."""
        region = self.region(evidence)
        if too_wide := self._too_wide(region):
            return Redesign(None, math.nan, too_wide)
        return _fallback_redesign(self.fallback(), region, reason)

    def confirm_again(self, evidence: Evidence, setting: Setting) -> Redesign:
        """Verify an earlier setting for the present evidence; without a setting where it is not verified."""
        region = self.region(evidence)
        if too_wide := self._too_wide(region):
            return Redesign(None, math.nan, too_wide)
        law = self.servo.controller
        design = Design(law if setting.gains is None else with_gains(law, setting.gains), setting.tolerance)
        result = self.confirm(region, design, evidence.machine, evidence.motor)
        if isinstance(result, NotVerified):
            return Redesign(None, math.nan, result.reason)
        return _redesign(result, region.noise, evidence.estimate.gap, "")

    def verify(self, region: Region, running: Setting | None = None) -> Certificate | NotVerified:
        """Find the cheapest setting for a region by simulation, or the running one where it is hardly dearer."""
        return self.verify_on(self.servo, region.within(self.uncertainty), region, running)

    def verify_on(
        self, servo: Plant, known: Uncertainty, region: Region, running: Setting | None
    ) -> Certificate | NotVerified:
        """Verify as `verify` does, on a servo with an uncertainty of its own."""
        demands, trial = self.demands_within_band(), self.simulations
        fed, in_force = region.feedforward, None
        if running is not None and running.gains is not None:
            in_force = Design(with_gains(servo.controller, running.gains), running.tolerance)
        return certify(servo, known, demands, trial, fed, region.noise, self.clock, in_force)

    def confirm(
        self,
        region: Region,
        setting: Design,
        machine: FactorPrior | None = None,
        motor: LearntMotor | None = None,
    ) -> Certificate | NotVerified:
        """Verify one setting for a region, by simulation, on machine and motor as learnt where they were."""
        servo, known = self.servo, region.within(self.uncertainty)
        learnt = learnt_servo(servo, self.uncertainty, machine, motor)
        if learnt is not None:
            servo, known = learnt[0], narrowed(known, learnt[1])
        demands = self.demands_within_band()
        return confirm(servo, known, setting, demands, self.simulations, region.noise, self.clock)

    def demands_within_band(self) -> Demands:
        """Demands with the fallback set's band as a bound; a dead zone must open the loop inside of that band."""
        certificate, leave = self.fallback(), max((leave for _, leave in self.demands.hysteresis), default=1.0)
        tolerance = min(self.demands.tolerance, band_of(certificate).error / leave)
        # Less than what counts as arrived for the smallest step is no error.
        tail = max(certificate.tail, NEAR * self.uncertainty.step[0])
        return replace(self._limited_demands, tail=min(self.demands.tail, tail), tolerance=tolerance)

    def fallback(self) -> Certificate:
        """Certificate of the setting for every gap and bias of the stated range, whatever is estimated.

        Raises
        ------
        InvalidInput
            No setting is verified for the whole range: state a narrower one, or lower the demands.
        """
        return fallback_certificate(self.servo, self.uncertainty, self._limited_demands, self.simulations)

    @property
    def _limited_demands(self) -> Demands:
        """Demands with the largest friction feedforward that an edge of this policy takes."""
        return replace(self.demands, friction_limit=min(self.demands.friction_limit, self.feedforward_limit))

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
        bias, std, friction_voltage = self._rest(evidence)
        gains = evidence.gains
        fed = gains.feedforward if gains is not None else 0.0
        if not math.isfinite(std):
            return fed, self.uncertainty.input_bias
        limit, spread = self.feedforward_limit, max(NORMAL_95 * std, self.bias_floor, 0.5 * friction_voltage)
        if self._may_be_friction(evidence):
            return fed, (min(bias, -fed) - spread, max(bias, -fed) + spread)
        # Only a significant change: every new feedforward is an update at the edge.
        if abs(bias + fed) > spread:
            fed = min(max(-bias, -limit), limit)
        return fed, (bias - spread, bias + spread)

    def _usual_step(self, evidence: Evidence) -> Range | None:
        """Range of the steps in the last windows (m), as far as it lies within the stated one; None: none was seen."""
        if not evidence.steps:
            return None
        least, most = self.uncertainty.step
        low, high = (min(max(size, least), most) for size in (min(evidence.steps), max(evidence.steps)))
        return low, high

    def _rest(self, evidence: Evidence) -> tuple[float, float, float]:
        """Input bias, its standard deviation, and the voltage of a friction that only the rests show (V); 0: none.

        A bias is the same at every rest. Friction stops the motor at one end of what it can hold or at the other.
        """
        bias, std = evidence.disturbance.bias, evidence.disturbance.bias_std
        motor = self._motor(evidence)
        if motor is not None and motor.friction[0] > 0.0:
            # Friction holds a motor at rest against any voltage up to its own; only a turning one shows the bias.
            return float(motor.mean[BIAS]), motor.std(BIAS), 0.0
        if motor is not None or not math.isfinite(std):
            return bias, std, 0.0
        rests = (*evidence.rests, bias)
        half = 0.5 * (max(rests) - min(rests))
        if half <= 0.5 * _BIAS_MOVED * self.smallest_answer:
            return bias, std, 0.0
        return 0.5 * (max(rests) + min(rests)), std, half

    def _may_be_friction(self, evidence: Evidence) -> bool:
        """True at the first rest, unless the motor's motion told friction: the voltage there is of bias or friction.

        Fed forward, a friction would push the wrong way after the next reversal.
        """
        alone = not evidence.rests and self._motor(evidence) is None
        return alone and self.uncertainty.friction[1] == 0.0 and self._moved(evidence.disturbance.bias)

    def _moved(self, voltage: float) -> bool:
        """True where a voltage at rest is no small change."""
        return abs(voltage) > _BIAS_MOVED * self.smallest_answer

    def _shows_more(self, evidence: Evidence) -> bool:
        """True where a window tells more of machine, bias or friction than the setting in force answers to."""
        gains, rested = evidence.gains, math.isfinite(evidence.disturbance.bias_std)
        if gains is None or not rested or evidence.estimate.ok:
            return False
        if evidence.estimate.machine is not None:
            return True
        fed, _ = self._input_bias(evidence)
        if abs(fed - gains.feedforward) > _SAME_FEEDFORWARD * self.smallest_answer:
            return True
        low, high = self._friction(evidence)
        sticks, integral = high > 0.0, integrates(with_gains(self.servo.controller, gains))
        if sticks and self._motor(evidence) is not None and (evidence.tuned_for is None or (low > 0.0 and integral)):
            # The fallback set is verified for the stated friction only, and an integral is not all that friction allows
            # once it is known.
            return True
        return integral != sticks and len(evidence.rests) > 0

    def _motor(self, evidence: Evidence) -> LearntMotor | None:
        """The learnt motor, where it tells friction and bias well enough to act on them: to a small voltage, or to a
        share of the largest one of the last rests, which is then of one or of the other: at a single rest they may
        cancel."""
        motor, enough = evidence.motor, 0.5 * _BIAS_MOVED * self.smallest_answer
        rests = (*evidence.rests, evidence.disturbance.bias)
        enough = max([enough, *(_TELLS * abs(rest) for rest in rests if math.isfinite(rest))])
        known = motor is not None and NORMAL_95 * max(motor.std(FRICTION), motor.std(BIAS)) <= enough
        return motor if known else None

    def _friction(self, evidence: Evidence) -> Range:
        """Range of friction torques (N m): as learnt, otherwise as stated or as the rests show.

        A voltage at rest is that of the bias, less at most the friction's either way. So rests that are alike show no
        friction, and those that differ show at least half of their difference, unless the bias moved. A feedforward
        stands for the rests that it was made from: what it leaves at rest counts too, but only one that is in force,
        and that its limit did not cut.
        """
        disturbance, now = evidence.disturbance, evidence.gains
        low, high = self.uncertainty.friction
        motor, servo = self._motor(evidence), self.servo
        learnt = learnt_servo(servo, self.uncertainty, None, evidence.motor)
        # Learnt as a voltage: as a torque it is that of the motor on which it is simulated.
        torque = (servo if learnt is None else learnt[0]).torque_of(1.0)
        if motor is not None:
            # What the model states itself is simulated anyway.
            least, most = (max(0.0, each - servo.command_of(servo.own_friction)) for each in motor.friction)
            # Friction that is not significant counts at most as stated.
            return (least * torque, most * torque) if least > 0.0 else (0.0, min(high, most * torque))
        high = max(high, _HOLDS * self._rest(evidence)[2] * torque)
        if evidence.tuned_for is None or now is None or not math.isfinite(disturbance.bias_std):
            return low, high
        if not 0.0 < abs(now.feedforward) < self.feedforward_limit:
            return low, high
        left = abs(disturbance.bias + now.feedforward)
        return low, max(high, left * torque) if left > _BIAS_MOVED * self.smallest_answer else high


@dataclass(frozen=True)
class _LearntVerifier:
    """Verification by simulation on what was learnt of the machine, in place of the model's stated error.

    The fallback set stays that of the stated ranges.
    """

    policy: CertifiedPolicy
    servo: Plant
    learnt: LearntFactors
    provisional: ClassVar[bool] = False

    def verify(self, region: Region, running: Setting | None = None) -> Certificate | NotVerified:
        known = narrowed(region.within(self.policy.uncertainty), self.learnt)
        return self.policy.verify_on(self.servo, known, region, running)

    def fallback(self) -> Certificate:
        return self.policy.fallback()


def _noise(evidence: Evidence) -> float:
    """Measurement noise, m rms; 0 where it is unknown."""
    noise = evidence.disturbance.noise
    return noise if math.isfinite(noise) else 0.0


def alike(one: Design, other: Setting | None) -> bool:
    """True when two settings are the same but for what they feed forward against bias and friction."""
    if other is None or other.gains is None:
        return False
    now, new = other.gains, gains_of(one.controller)
    if type(now) is not type(new):
        return False
    names = [name for name in new.__struct_fields__ if name not in new.fed]
    gains = ((getattr(now, name), getattr(new, name)) for name in names)
    pairs = (*gains, (other.tolerance, one.tolerance))
    return all(math.isclose(a, b, rel_tol=_SAME, abs_tol=0.0) for a, b in pairs)


def _in_force(setting: Design, evidence: Evidence, small: float) -> bool:
    """True when the edge runs the setting already, by its last report, but for a `small` (V) change of feedforwards."""
    now, new = evidence.gains, gains_of(setting.controller)
    if now is None or type(now) is not type(new):
        return False
    changes = [getattr(now, name) - getattr(new, name) for name in new.fed]
    return max(map(abs, changes)) <= small and alike(setting, evidence.setting)


def band_of(certificate: Certificate, noise: float = 0.0) -> Band:
    """Band within which the loop stays once it has arrived, `noise` (m rms) included.

    The simulated machines are a sample: the real one may need half as long again as the slowest of them.
    """
    error = max(certificate.within, certificate.tail) + noise
    effort = certificate.effort + abs(static_gain(certificate.setting.controller)) * (
        NEAR * certificate.step[1] + noise
    )
    return Band(error, error, effort, math.ceil(1.5 * certificate.settling_worst))


def _fallback_redesign(certificate: Certificate, region: Region, reason: str) -> Redesign:
    law = certificate.setting.controller.replace(feedforward=region.feedforward)
    certificate = replace(certificate, setting=replace(certificate.setting, controller=law))
    return _redesign(certificate, region.noise, math.nan, f"{reason}; the fallback set is sent")


def _redesign(certificate: Certificate, noise: float, gap: float, reason: str) -> Redesign:
    """Redesign that sends a certificate's setting, with its band."""
    return Redesign(certificate.setting.setting(band_of(certificate, noise)), gap, reason, certificate)
