"""Supervision of an edge, and the limits that admit what the policy may send and little else.

A fallback set is verified for every gap, step and input bias of the stated range, so that it needs no estimate:
the loop begins on it, and comes back to it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.control.retuning import friction_feedforward
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.settings import Supervision
from servotwin.edge.watch import WatchSettings
from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import holds_position
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import Gains, LinearGains, Setting
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import integral_shares
from servotwin.redesign.certified.learnt_servo import learnt_servo, narrowed
from servotwin.redesign.certified.policy import CertifiedPolicy, band_of
from servotwin.redesign.certified.uncertainty import PARAMETERS, LearntFactors, Uncertainty
from servotwin.redesign.dead_zones import HysteresisPolicy
from servotwin.redesign.registry import certified_policy, policy_of
from servotwin.twin.settings import TwinSettings

# Seconds here are the servo's own (`plant.scales`).
PATIENCE = 1.0
"""Longest time that a change of the dead zone waits for an instant at which it neither opens nor closes the loop."""
_ERROR_FLOORS = 10.0  # to a smallest step
# Share of the stated half-widths that is open of a machine found at their end; with more it would not be found there.
_OPEN = 0.5
# Factor by which the resonance of a learnt machine may be off the model's, either way.
_NOTCH_MOVES = 2.0
_BELOW_HALF = 0.49


class Guarding(NamedTuple):
    """Supervision of the edge, and limits of updates."""

    supervision: Supervision
    limits: Limits


def guarding(servo: Plant, settings: TwinSettings, noise: float = 0.0) -> Guarding | None:
    """Derive supervision and limits for a policy that sends gains; None for one that sets the tolerance only.

    Parameters
    ----------
    servo : Servo or Axis
        Servo with the controller that runs.
    settings : TwinSettings
    noise : float
        m rms on the measured position.

    Raises
    ------
    InvalidInput
        No fallback set is verified for the whole stated range.
    """
    if settings.policy not in ("certified", "hysteresis"):
        return None
    policy = certified_policy(servo, settings)
    verified = policy.fallback()
    gains, band = gains_of(verified.setting.controller), band_of(verified, noise)
    fallback = FallbackSet(Setting.of(verified.setting.tolerance, gains, band), settings.silence)
    supervision = supervision_of(servo, settings, fallback)
    sent = policy_of(servo, settings)
    limits = _hysteresis_limits(sent) if isinstance(sent, HysteresisPolicy) else certified_limits(policy)
    return Guarding(supervision, limits)


def supervision_of(servo: Plant, settings: TwinSettings, fallback: FallbackSet) -> Supervision:
    """Supervision of a servo in its own seconds and volts; errors count from a tenth of the smallest stated step on.

    The command of a stepper is its position and no evidence. Friction holds an axis at rest under any command up to its
    own, and settings that were not simulated predict none: then only larger ones are evidence.
    """
    usual, period = WatchSettings(), Supervision().period_s
    second, _, volt = scales(servo)
    held = 0.0 if settings.policy == "certified" else float(servo.command_of(servo.own_friction))
    watch = dataclasses.replace(
        usual,
        slot_s=usual.slot_s * second,
        window_s=usual.window_s * second,
        settling_s=usual.settling_s * second,
        persist_s=usual.persist_s * second,
        error_floor=settings.uncertainty.step[0] / _ERROR_FLOORS,
        effort_floor=math.inf if holds_position(servo) else usual.effort_floor * volt + held,
    )
    return Supervision(fallback, watch, period * second)


def start_of(fallback: FallbackSet) -> Parameters:
    """Parameters with the fallback set from the first sample on; an update may replace it at once."""
    return Parameters(setting=fallback.setting, fallback=True)


def certified_limits(policy: CertifiedPolicy) -> Limits:
    """Limits that admit the gains and dead zone of every candidate."""
    law, demands = policy.servo.controller, policy.demands_within_band()
    laws = _candidates(policy, demands)
    sent, own = [gains_of(each) for each in laws], gains_of(law)
    ranges: dict[str, Any] = {
        name: _range([getattr(gains, name) for gains in sent]) for name in own.scaled if getattr(own, name)
    }
    kick = _kick(laws)
    notches = [gains.notch_hz for gains in sent if not isinstance(gains, LinearGains) and gains.notch_hz]
    dampings = [gains.notch_damping for gains in sent if not isinstance(gains, LinearGains) and gains.notch_hz]
    return Limits(
        maximum=demands.tolerance,
        gain_factor=max(1.0, kick / abs(own.Kp)) if isinstance(own, Gains) and kick else 1.0,
        integral_factor=max(integral_shares(policy.servo, demands), default=0.0),
        leave=max([each.leave for each in (law, *laws)] + [leave for _, leave in demands.hysteresis]),
        feedforward=max(policy.feedforward_limit, policy.friction_feedforward_limit),
        # The centre follows the learnt machine.
        notch_min_hz=min(notches, default=0.0) / _NOTCH_MOVES,
        notch_max_hz=min(max(notches, default=0.0) * _NOTCH_MOVES, _highest_notch(law)),
        notch_damping=max(dampings, default=0.5 if isinstance(law, LinearLaw) else law.notch_damping),
        patience_s=PATIENCE * scales(policy.servo).time,
        **ranges,
    )


def _highest_notch(own: AnyController) -> float:
    """Hz: a cascade has no notch at half of its rate or above."""
    if not isinstance(own, Cascade) or own.sample_rate is None:
        return math.inf
    return _BELOW_HALF * own.sample_rate


def _kick(laws: list[AnyController]) -> float:
    """Largest answer of a velocity feedforward to a step of the reference, V/m."""
    return max(
        (abs(law.velocity_feedforward) / law.velocity_time for law in laws if isinstance(law, Controller)), default=0.0
    )


def _candidates(policy: CertifiedPolicy, demands: Demands) -> list[AnyController]:
    """Candidates for the stated ranges, and for machines within them that the twin has learnt exactly or in part.

    The fastest laws are those for a stiff and damped machine that is learnt exactly; the slowest ones, and slow ones
    with a notch, those for a soft and lightly damped machine of which much is open.
    """
    servo, known = policy.servo, policy.uncertainty
    sure = dataclasses.replace(demands, beyond=dataclasses.replace(demands.beyond, k_T=0.0))
    exact = known.replace(**dict.fromkeys(PARAMETERS, 0.0))
    learnt = LearntFactors(("k_B",), (0.0,), ((known.k_B**2 / 3.0,),))
    asked: list[tuple[Plant, Uncertainty, Demands]] = [
        (servo, known, demands),
        (servo, known.replace(learnt=learnt), demands),
        (servo, exact.replace(learnt=LearntFactors(("k",), (0.0,), ((0.0,),))), sure),
    ]
    for end, open_part, ranges, wanted in ((1.0, 0.0, exact, sure), (-1.0, _OPEN, known, demands)):
        widths = np.array([known.k, known.c, 0.0, 0.0])
        prior = FactorPrior(np.log1p(end * widths), np.diag(np.square(open_part * widths) / 3.0))
        found = learnt_servo(servo, known, prior, None)
        if found is not None:
            asked.append((found[0], narrowed(ranges, found[1]), wanted))
    return [law for number, one in enumerate(asked) for law in _laws(*one, needed=number == 0)]


def _laws(servo: Plant, known: Uncertainty, demands: Demands, needed: bool) -> list[AnyController]:
    """Laws of the candidates for a question; none where no law is within the bounds, unless they are `needed`."""
    try:
        return [each.controller for each in candidates_of(servo, known, demands, True, False)]
    except InvalidInput:
        if needed:
            raise
        return []


def _range(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def _hysteresis_limits(policy: HysteresisPolicy) -> Limits:
    """Limits that admit the servo's own gains only, and a dead zone of any width, which follows the estimated gap."""
    own = policy.servo.controller
    limits = Limits(
        gain_factor=1.0,
        leave=policy.leave,
        feedforward=max(abs(own.feedforward), abs(friction_feedforward(own))),
        patience_s=PATIENCE * scales(policy.servo).time,
    )
    if isinstance(own, LinearLaw):
        return limits
    notch = own.notch_hz or 0.0
    return dataclasses.replace(limits, notch_min_hz=notch, notch_max_hz=notch, notch_damping=own.notch_damping)
