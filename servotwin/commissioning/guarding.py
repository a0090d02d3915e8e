"""Supervision of an edge, and the limits that admit what the policy may send and little else.

A fallback set is verified for every gap, step and input bias of the stated range, so that it needs no estimate:
the loop begins on it, and comes back to it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import msgspec

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.control.retuning import friction_feedforward, strength
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.settings import Supervision
from servotwin.edge.watch import WatchSettings
from servotwin.estimation.disturbance import holds_position
from servotwin.messages import AnyGains, CascadeGains, Gains, LinearGains, Setting
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.margins import integral_shares
from servotwin.redesign.certified.policy import CertifiedPolicy, band_of
from servotwin.redesign.certified.uncertainty import PARAMETERS, LearntFactors, Uncertainty
from servotwin.redesign.dead_zones import HysteresisPolicy
from servotwin.redesign.registry import certified_policy, policy_of
from servotwin.twin.settings import TwinSettings

# Seconds here are the servo's own (`plant.scales`).
PATIENCE = 1.0
"""Longest time that a change of the dead zone waits for an instant at which it neither opens nor closes the loop."""
_ERROR_FLOORS = 10.0  # to a smallest step
# Widens a box so that rounding does not exclude its own corner.
_ROUNDING = 1.0 + 1e-9
# Factor by which the resonance of a learnt machine may be off the model's, either way.
_NOTCH_MOVES = 2.0
_BELOW_HALF = 0.49


class Guarding(NamedTuple):
    """Supervision of the edge, limits of updates, and the middle of their box for gains."""

    supervision: Supervision
    limits: Limits
    middle: AnyGains


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
    return Guarding(
        supervision, *(_hysteresis_box(sent) if isinstance(sent, HysteresisPolicy) else _certified_box(policy))
    )


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


def _certified_box(policy: CertifiedPolicy) -> tuple[Limits, AnyGains]:
    """Limits that admit the gains and dead zone of every candidate, and the gains in the middle of that box."""
    own, demands = policy.servo.controller, policy.demands_within_band()
    laws = _candidates(policy, demands)
    sent, centre = [gains_of(law) for law in laws], gains_of(own)
    ends = {name: _range([getattr(gains, name) for gains in sent]) for name in centre.scaled}
    middle = {name: math.copysign(math.sqrt(low * high), getattr(centre, name)) for name, (low, high) in ends.items()}
    widest = max(math.sqrt(high / low) if low > 0.0 else 1.0 for low, high in ends.values())
    kick = _kick(laws)
    factor = max(widest, kick / abs(middle["Kp"]) if kick else 0.0) * _ROUNDING
    notches = [gains.notch_hz for gains in sent if not isinstance(gains, LinearGains) and gains.notch_hz]
    dampings = [gains.notch_damping for gains in sent if not isinstance(gains, LinearGains) and gains.notch_hz]
    leave = max([law.leave for law in laws] + [leave for _, leave in demands.hysteresis])
    limits = Limits(
        maximum=demands.tolerance,
        gain_factor=factor,
        integral_factor=max(integral_shares(policy.servo, demands), default=0.0) * _ROUNDING,
        feedforward=max(policy.feedforward_limit, policy.friction_feedforward_limit) * _ROUNDING,
        # The centre follows the learnt machine.
        notch_min_hz=min(notches, default=0.0) / _NOTCH_MOVES,
        notch_max_hz=min(max(notches, default=0.0) * _NOTCH_MOVES, _highest_notch(own)),
        notch_damping=max(dampings, default=0.5 if isinstance(own, LinearLaw) else own.notch_damping),
        patience_s=PATIENCE * scales(policy.servo).time,
    )
    return limits, _centre_of(centre, middle, _ROUNDING * max(leave, own.leave) / factor)


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


def _centre_of(own: AnyGains, middle: dict[str, float], leave: float) -> AnyGains:
    """Gains in the middle of a box, with the own integral gain and nothing fed forward."""
    if isinstance(own, Gains):
        return Gains(middle["Kp"], own.Ki, middle["Kd"], middle["Tf"], 0.0, leave)
    centre = msgspec.structs.replace(own, **middle, enter=0.0, leave=leave, feedforward=0.0)
    if isinstance(centre, CascadeGains):
        time = centre.velocity_gain / own.integral_gain if own.integral_gain else 0.0
        return msgspec.structs.replace(centre, integral_time=time)
    return msgspec.structs.replace(centre, integral_share=own.integral_gain / centre.gain)


def _candidates(policy: CertifiedPolicy, demands: Demands) -> list[AnyController]:
    """Candidates for the stated ranges, those for a plant that the twin has learnt exactly, and those in between.

    What is left open of a learnt plant may rule its fastest laws out: then slower ones with a notch are candidates.
    """
    exact = policy.uncertainty.replace(
        **dict.fromkeys(PARAMETERS, 0.0), learnt=LearntFactors(("k",), (0.0,), ((0.0,),))
    )
    stated = _laws(policy, policy.uncertainty, demands)
    known = dataclasses.replace(demands, beyond=dataclasses.replace(demands.beyond, k_T=0.0))
    fastest = max(abs(strength(law)) for law in stated) / abs(strength(policy.servo.controller))
    slower = tuple(scale for scale in demands.scales if scale <= fastest * _ROUNDING)
    between = dataclasses.replace(known, scales=slower)
    return [*stated, *_laws(policy, exact, known), *_laws(policy, exact, between)]


def _laws(policy: CertifiedPolicy, known: Uncertainty, demands: Demands) -> list[AnyController]:
    return [each.controller for each in candidates_of(policy.servo, known, demands, True, False)]


def _range(values: list[float]) -> tuple[float, float]:
    return min(map(abs, values)), max(map(abs, values))


def _hysteresis_box(policy: HysteresisPolicy) -> tuple[Limits, AnyGains]:
    """Limits that admit the servo's own gains only, and a dead zone of any width, which follows the estimated gap."""
    own = policy.servo.controller.replace(enter=policy.enter, leave=policy.leave)
    gains, patience = gains_of(own), PATIENCE * scales(policy.servo).time
    limits = Limits(
        gain_factor=_ROUNDING,
        feedforward=max(abs(own.feedforward), abs(friction_feedforward(own))),
        patience_s=patience,
    )
    if isinstance(gains, LinearGains):
        return limits, gains
    notch = gains.notch_hz
    return dataclasses.replace(limits, notch_min_hz=notch, notch_max_hz=notch, notch_damping=gains.notch_damping), gains
