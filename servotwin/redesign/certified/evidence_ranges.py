"""Ranges of gap, bias, friction, noise and steps that a setting must serve, from the evidence of a machine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from servotwin.control.gains import with_gains
from servotwin.control.retuning import integrates
from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.estimation.learning.motor import BIAS, FRICTION, LearntMotor
from servotwin.estimation.learning.trend import Trend
from servotwin.plant.basis import BacklashKind
from servotwin.plant.display_units import command_unit
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.integral_action import own_static_gain
from servotwin.redesign.certified.learnt_servo import learnt_servo
from servotwin.redesign.certified.uncertainty import Range, Region, Uncertainty
from servotwin.redesign.dead_zones import gap_range
from servotwin.redesign.policy import Evidence

SAME_FEEDFORWARD = 7e-3
"""Relative to `smallest_answer`: a smaller change of the feedforward is not worth an update."""
# Relative to `smallest_answer`: the least half-width of the range of input biases, however well one is estimated; a
# voltage at rest that differs by so much from the feedforward indicates friction, which stops the motor short of its
# reference.
_BIAS_FLOOR, _BIAS_MOVED = 1.5e-3, 0.035
# Friction holds the motor at up to so much more than half the difference of two rests, and than the model states.
_HOLDS = 1.25
# Share of the voltage at rest, up to which friction and bias of the turning motor must be known to tell it apart.
_TELLS = 0.25


class _Rest(NamedTuple):
    """Input bias and friction as the rests of a machine tell them, in volts.

    Attributes
    ----------
    bias : float
    spread : float
        By which the bias may be off either way; inf: nothing is known.
    friction : float
        Of a friction beyond the model's that only the rests show; 0: none.
    """

    bias: float
    spread: float
    friction: float


@dataclass(frozen=True)
class EvidenceRanges:
    """Makes the region that a setting must serve.

    Parameters
    ----------
    servo : Servo or Axis
        The model.
    uncertainty : Uncertainty
        Prior knowledge, which counts where the evidence does not tell.
    feedforward_limit : float
        V, either sign.
    horizon : float
        s for which a setting is to hold.
    """

    servo: Plant
    uncertainty: Uncertainty
    feedforward_limit: float
    horizon: float

    @property
    def smallest_answer(self) -> float:
        """V, with which the servo's own Kp answers the smallest step: the unit of small voltages."""
        return own_static_gain(self.servo) * self.uncertainty.step[0]

    @property
    def bias_floor(self) -> float:
        """V: least half-width of the range of input biases, however well one is estimated."""
        return _BIAS_FLOOR * self.smallest_answer

    def region(self, evidence: Evidence) -> Region:
        """Make the region that a setting must serve, from the evidence; gaps as stated where none was estimated."""
        estimate = self.estimate(evidence)
        gap = self.uncertainty.gap if estimate is None else self._gap(estimate, evidence.trend)
        feedforward, input_bias = self.input_bias(evidence)
        friction, noise, usual = self.friction(evidence), _noise(evidence), self._usual_step(evidence)
        return Region(gap, feedforward, input_bias, friction, noise, usual)

    def estimate(self, evidence: Evidence) -> GapEstimate | None:
        """Estimate that counts: the window's own, or the trend's where only the window's bias is known."""
        if not evidence.unusable:
            return evidence.estimate
        trend, bias_known = evidence.trend, math.isfinite(evidence.disturbance.bias_std)
        return trend.as_estimate() if bias_known and trend is not None and trend.updates > 0 else None

    def gap_now(self, evidence: Evidence) -> Range:
        """Range of gaps at the window, as stated where none was estimated."""
        estimate = self.estimate(evidence)
        return self.uncertainty.gap if estimate is None else gap_range(estimate)

    def _gap(self, estimate: GapEstimate, trend: Trend | None) -> Range:
        """Range of gaps until `horizon` has passed; one window alone tells nothing about wear."""
        low, high = gap_range(estimate)
        grows = trend is not None and trend.updates > 1
        return low, high + (self.horizon * max(0.0, trend.rate_interval[1]) if trend is not None and grows else 0.0)

    def input_bias(self, evidence: Evidence) -> tuple[float, Range]:
        """Feedforward (V), and the range of input biases; a bias that is not significantly off the feedforward in force
        leaves it as it is."""
        bias, spread, _ = self._rest(evidence)
        gains = evidence.gains
        fed = gains.feedforward if gains is not None else 0.0
        if not math.isfinite(spread):
            return fed, self.uncertainty.input_bias
        limit, most = self.feedforward_limit, max(spread, self.bias_floor, self._wound(evidence, bias))
        if self._may_be_friction(evidence):
            return fed, self._as_stated(min(bias, -fed), max(bias, -fed), spread, most)
        # Only a significant change: every new feedforward is an update at the edge.
        if abs(bias + fed) > most:
            fed = min(max(-bias, -limit), limit)
        return fed, self._as_stated(bias, bias, spread, most)

    def _as_stated(self, low: float, high: float, spread: float, most: float) -> Range:
        """Range of input biases (V), `most` beyond both ends, as far as it is stated: evidence makes no question harder
        than it is without any, unless the range with its spread alone contradicts what is stated."""
        stated = self.uncertainty.input_bias
        if high + spread < stated[0] or stated[1] < low - spread:
            return low - most, high + most
        return max(low - most, stated[0]), min(high + most, stated[1])

    def contradiction(self, region: Region) -> str:
        """Say which ranges of a region are beyond the stated ones; empty where none is."""
        known = self.uncertainty
        shown = (
            ("an input bias", command_unit(self.servo), region.input_bias, known.input_bias),
            ("friction", "N m", region.friction, known.friction),
        )
        return "".join(
            f"; the windows show {name} of {low:.3g} to {high:.3g} {unit}, and {least:.3g} to {most:.3g} are stated"
            for name, unit, (low, high), (least, most) in shown
            if low < least or most < high
        )

    def _usual_step(self, evidence: Evidence) -> Range | None:
        """Range of the steps in the last windows (m), as far as it lies within the stated one; None: none was seen."""
        if not evidence.steps:
            return None
        least, most = self.uncertainty.step
        low, high = (min(max(size, least), most) for size in (min(evidence.steps), max(evidence.steps)))
        return low, high

    def _rest(self, evidence: Evidence) -> _Rest:
        """Tell input bias and friction by the rests.

        A bias is the same at every rest. Friction stops the motor at one end of what it can hold or at the other.
        """
        bias, std = evidence.disturbance.bias, evidence.disturbance.bias_std
        motor = self._motor(evidence)
        if motor is not None and motor.friction[0] > 0.0:
            # Friction holds a motor at rest against any voltage up to its own; only a turning one shows the bias.
            return _Rest(float(motor.mean[BIAS]), NORMAL_95 * motor.std(BIAS), 0.0)
        if motor is not None or not math.isfinite(std):
            return _Rest(bias, NORMAL_95 * std, 0.0)
        rests = (*evidence.rests, bias)
        if self._held > 0.0:
            return self._beside_own_friction(rests, std)
        half = 0.5 * (max(rests) - min(rests))
        if half <= 0.5 * _BIAS_MOVED * self.smallest_answer:
            return _Rest(bias, NORMAL_95 * std, 0.0)
        middle = 0.5 * (max(rests) + min(rests))
        if self.servo.backlash_kind is BacklashKind.HELD:
            # A load on a spring pulls at this motor, so that its rests differ with the load's place, without friction.
            return _Rest(middle, max(NORMAL_95 * std, half), 0.0)
        return _Rest(middle, max(NORMAL_95 * std, 0.5 * half), _HOLDS * half)

    def _beside_own_friction(self, rests: tuple[float, ...], std: float) -> _Rest:
        """The same where the model states friction, that may hold the motor at either end of `_held`.

        The bias is as stated as far as this friction explains the rests, otherwise any with which it does. Rests that
        differ by more show more friction.
        """
        low, high = max(rests) - self._held, min(rests) + self._held
        if low > high:
            half = 0.5 * (max(rests) - min(rests))
            if self.servo.backlash_kind is BacklashKind.HELD:
                # The load's friction and its springs pull at this motor: the rests show no more friction of its own.
                return _Rest(0.5 * (low + high), max(NORMAL_95 * std, half), 0.0)
            return _Rest(0.5 * (low + high), max(NORMAL_95 * std, 0.5 * half), _HOLDS * half - self._own)
        least, most = self.uncertainty.input_bias
        if least <= high and most >= low:
            low, high = max(low, least), min(high, most)
        return _Rest(0.5 * (low + high), max(NORMAL_95 * std, 0.5 * (high - low)), 0.0)

    def _wound(self, evidence: Evidence, bias: float) -> float:
        """V that an integral may hold at rest against the model's friction.

        The next move begins with it, as if the bias changed by as much: a simulation begins with an integral of zero.
        """
        if not integrates(self.servo.controller):
            return 0.0
        rests = (*evidence.rests, evidence.disturbance.bias)
        most = self.uncertainty.own_friction_of(self.servo)[1]
        return min(_HOLDS * max(abs(rest - bias) for rest in rests), float(self.servo.command_of(most)))

    @property
    def _own(self) -> float:
        """V that the model's friction holds at rest."""
        return float(self.servo.command_of(self.servo.own_friction))

    @property
    def _held(self) -> float:
        """V: a rest up to this far from the bias shows nothing beyond the model's friction."""
        return max(_HOLDS, 1.0 + self.uncertainty.own_friction) * self._own

    def _may_be_friction(self, evidence: Evidence) -> bool:
        """True at the first rest, unless the motor's motion told friction: the voltage there is of bias or friction.

        Fed forward, a friction would push the wrong way after the next reversal.
        """
        alone = not evidence.rests and self._motor(evidence) is None
        beyond = max(0.0, abs(evidence.disturbance.bias) - self._held)
        return alone and self.uncertainty.friction[1] == 0.0 and self._moved(beyond)

    def _moved(self, voltage: float) -> bool:
        """True where a voltage at rest is no small change."""
        return abs(voltage) > _BIAS_MOVED * self.smallest_answer

    def shows_more(self, evidence: Evidence) -> bool:
        """True where a window tells more of machine, bias or friction than the setting in force answers to."""
        gains, rested = evidence.gains, math.isfinite(evidence.disturbance.bias_std)
        if gains is None or not rested or evidence.estimate.ok:
            return False
        if evidence.estimate.machine is not None and self.servo.backlash_kind is not BacklashKind.FREE:
            return True
        fed, _ = self.input_bias(evidence)
        if abs(fed - gains.feedforward) > SAME_FEEDFORWARD * self.smallest_answer:
            return True
        low, high = self.friction(evidence)
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

    def friction(self, evidence: Evidence) -> Range:
        """Range of friction torques beyond the model's (N m): as learnt, otherwise as stated or as the rests show.

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
            least, most = (max(0.0, each - self._own) for each in motor.friction)
            # Friction that is not significant counts at most as stated.
            return (least * torque, most * torque) if least > 0.0 else (0.0, min(high, most * torque))
        high = max(high, self._rest(evidence).friction * torque)
        if evidence.tuned_for is None or now is None or not math.isfinite(disturbance.bias_std):
            return low, high
        if not 0.0 < abs(now.feedforward) < self.feedforward_limit or servo.backlash_kind is BacklashKind.HELD:
            return low, high
        left = max(0.0, abs(disturbance.bias + now.feedforward) - self._held)
        return low, max(high, left * torque) if left > _BIAS_MOVED * self.smallest_answer else high


def _noise(evidence: Evidence) -> float:
    """Measurement noise, m rms; 0 where it is unknown."""
    noise = evidence.disturbance.noise
    return noise if math.isfinite(noise) else 0.0
