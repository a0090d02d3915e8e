"""What the edge is given where a scenario says nothing of it: a proved fallback set, its band, and limits.

The fallback set is proved for every gap, step and input bias of the stated range, so that it needs no estimate: the
loop begins on it, and comes back to it. The limits admit what the policy may send and little else.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from servotwin.control.gains import gains_of
from servotwin.edge.limits import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.settings import Supervision
from servotwin.messages import Gains, Setting
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.certify import candidates_of
from servotwin.redesign.certified.policy import CertifiedPolicy, band_of
from servotwin.redesign.dead_zones import HysteresisPolicy
from servotwin.redesign.registry import certified_policy, policy_of
from servotwin.twin.settings import TwinSettings

PATIENCE = 1.0
"""s that a change of the dead zone waits for an instant at which it neither opens nor closes the loop."""

_ROUNDING = 1.0 + 1e-9


class Guarding(NamedTuple):
    """What the edge watches for and falls back to, the limits of updates, and the middle of the box for gains."""

    supervision: Supervision
    limits: Limits
    middle: Gains


def guarding(servo: Servo, settings: TwinSettings, noise: float = 0.0) -> Guarding | None:
    """For a policy that sends gains; None for one that sets the tolerance only.

    A twin may be silent for as long as its settings are proved for.

    Parameters
    ----------
    servo : Servo
        With the controller that runs.
    settings : TwinSettings
    noise : float
        m rms on the measured position.

    Raises
    ------
    InvalidInput
        No fallback set is proved for the whole stated range.
    """
    if settings.policy not in ("certified", "hysteresis"):
        return None
    policy = certified_policy(servo, settings)
    proved = policy.fallback()
    gains, band = gains_of(proved.setting.controller), band_of(proved, noise)
    supervision = Supervision(FallbackSet(Setting(proved.setting.tolerance, gains, band), policy.horizon))
    sent = policy_of(servo, settings)
    return Guarding(
        supervision, *(hysteresis_box(sent) if isinstance(sent, HysteresisPolicy) else certified_box(policy))
    )


def start_of(fallback: FallbackSet) -> Parameters:
    """The fallback set from the first sample on; an update may replace it at once."""
    return Parameters(setting=fallback.setting, fallback=True)


def certified_box(policy: CertifiedPolicy) -> tuple[Limits, Gains]:
    """Every candidate's gains and dead zone, and the middle between them."""
    own, demands = policy.servo.controller, policy.demands_within_band()
    scales = [setting.controller.Kp / own.Kp for setting in candidates_of(policy.servo, demands, 0.0, True, False)]
    middle, factor = math.sqrt(min(scales) * max(scales)), math.sqrt(max(scales) / min(scales)) * _ROUNDING
    leave = max((leave for _, leave in demands.hysteresis), default=1.0)
    limits = Limits(
        maximum=demands.tolerance,
        gain_factor=factor,
        integral_factor=max(demands.integral, default=0.0) * _ROUNDING,
        feedforward=policy.feedforward_limit * _ROUNDING,
        patience_s=PATIENCE,
    )
    return limits, Gains(own.Kp * middle, own.Ki, own.Kd * middle, own.Tf, 0.0, max(leave, own.leave) / factor)


def hysteresis_box(policy: HysteresisPolicy) -> tuple[Limits, Gains]:
    """The servo's own gains; a dead zone may be as wide as the twin finds the gap."""
    own = policy.servo.controller.replace(enter=policy.enter, leave=policy.leave)
    return Limits(gain_factor=_ROUNDING, feedforward=abs(own.feedforward), patience_s=PATIENCE), gains_of(own)
