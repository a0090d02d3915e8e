"""Candidates for a verified setting: the own law with other gains, feedforwards, integral action and dead zones."""

from __future__ import annotations

import math
from functools import lru_cache

from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.control.retuning import integrates, only_integrates, static_gain
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.assess import COUNTS
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.integral_action import (
    has_slow_integral,
    integral_shares,
    is_pulled_off,
    stands_on_integral,
)
from servotwin.redesign.certified.margins import laws_within, widened, with_margins
from servotwin.redesign.certified.rest_in_gap import drives_to_and_fro
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design

# Time constant of a velocity feedforward's filter, in units of 1 / crossover of a motor that Kp alone moves.
_VELOCITY_TIME = 0.5
# Tolerances at which an integral that stops within the lost motion begins again.
_LEAVES = 2.0
# Zones that stop the integral of a filtered PID, in lost motions, and where it begins again.
_GAP_ZONES = ((0.5, 2.0), (1.0, 1.0))
# Of the error that may be left in the end: where the integral of such a zone begins again, at most.
_WITHIN = 0.95


def candidates_of(
    servo: Plant, uncertainty: Uncertainty, demands: Demands, disturbed: bool, noisy: bool
) -> list[Design]:
    """Every combination of scales, shapes, feedforwards, integral action and dead zone within the bounds on Ms.

    The friction that acts on every machine is fed forward, all of it or none: more would push.
    Integral action is for friction, for an unknown input bias and for a load that holds the motor off its reference, a
    dead zone keeps noise out of the voltage: they are candidates only where there is such a thing, or noise. Integral
    action comes with and without a zone about the reference that stops the integral only. A dead zone also leaves a
    motor alone that would drive to and fro in the gap at any gain.

    Raises
    ------
    InvalidInput
        No scaled controller is within the bounds on Ms.
    """
    integral = integral_shares(servo, demands, disturbed or is_pulled_off(servo, uncertainty))
    within = laws_within(servo, widened(uncertainty, demands), with_margins(demands), integral)
    plain = list(_without_zone(servo, within, demands, uncertainty.step[0]))
    fed = [each.controller for each in plain if not each.tolerance]
    plain += [Design(law) for law in _with_friction(servo, fed, uncertainty, demands)]
    # The lost motion is no part of an error of the motor.
    zone = 0.0 if servo.at_motor else servo.tolerance_for(uncertainty.gap[1])
    plain += _zones_in_gap(servo, within, zone, demands)
    plain += _stopped_in_gap(servo, plain, zone, demands)
    opens = isinstance(servo.controller, Controller) and not only_integrates(servo.controller)
    if not (0.0 < zone <= demands.tolerance and opens):
        return plain
    laws = [each.controller for each in plain if not each.tolerance]
    opened = [law.replace(enter=enter, leave=leave) for law in laws for enter, leave in demands.hysteresis if noisy]
    plain += [Design(law, zone) for law in opened]
    return plain + (_opened_in_gap(plain, zone) if drives_to_and_fro(servo, uncertainty, demands) else [])


def last_resort(servo: Plant, uncertainty: Uncertainty, demands: Demands, candidates: list[Design]) -> list[Design]:
    """On a shaft that is free in the gap: dead zones that leave the motor alone there, where none was a candidate.

    They leave an error of up to the lost motion, which a law that comes to rest without one does not.
    """
    zone = servo.tolerance_for(uncertainty.gap[1])
    law = servo.controller
    opens = isinstance(law, Controller) and not only_integrates(law) and 0.0 < zone <= demands.tolerance
    if not opens or servo.backlash_kind is not BacklashKind.FREE or drives_to_and_fro(servo, uncertainty, demands):
        return []
    return [] if servo.at_motor else _opened_in_gap(candidates, zone)


def _opened_in_gap(plain: list[Design], zone: float) -> list[Design]:
    """Laws without integral action whose dead zone (m) of the lost motion leaves the motor alone in the gap."""
    laws = [each.controller for each in plain if not each.tolerance and not integrates(each.controller)]
    return [Design(law.replace(enter=1.0, leave=1.0), zone) for law in laws]


@lru_cache(maxsize=16)
def _without_zone(servo: Plant, within: tuple[AnyController, ...], demands: Demands, step: float) -> tuple[Design, ...]:
    """Candidates without a dead zone that stops the whole law, the same for every gap, for a smallest step (m)."""
    laws = [fed for law in within for fed in _with_velocity(servo, law, demands)]
    may_stop = not stands_on_integral(servo)
    stopped = [each for law in laws if may_stop and integrates(law) for each in _stopped(servo, law, step, demands)]
    return (*(Design(law) for law in laws), *stopped)


def _with_velocity(servo: Plant, law: AnyController, demands: Demands) -> list[AnyController]:
    """A law as it is, and a filtered PID with velocity feedforwards; others keep their own."""
    if not isinstance(law, Controller):
        return [law]
    needed, own = servo.command_per_speed / servo.p, abs(servo.pidf.Kp)
    shares = demands.velocity if demands.velocity_feedforward and own > 0.0 and needed > 0.0 else ()
    time = _VELOCITY_TIME * needed / own if shares else law.velocity_time
    return [law, *(law.replace(velocity_feedforward=share * needed, velocity_time=time) for share in shares)]


def friction_push(servo: Plant, uncertainty: Uncertainty, demands: Demands) -> float:
    """Feedforward of the friction that acts on every machine; 0: none is allowed."""
    friction = uncertainty.friction[0] + uncertainty.own_friction_of(servo)[0]
    fed = min(float(servo.command_of(friction)), demands.friction_limit)
    if not demands.friction_feedforward or not fed:
        return 0.0
    return math.copysign(fed, static_gain(servo.controller))


def _with_friction(
    servo: Plant, laws: list[AnyController], uncertainty: Uncertainty, demands: Demands
) -> list[AnyController]:
    """The laws without integral action, with the feedforward of friction: an integral would have to give up at every
    reversal what it holds against it."""
    fed = friction_push(servo, uncertainty, demands)
    pids = [law for law in laws if isinstance(law, Controller) and not law.Ki] if fed else []
    return [law.replace(friction_feedforward=fed) for law in pids]


def _stopped(servo: Plant, law: AnyController, step: float, demands: Demands) -> list[Design]:
    """A law with dead zones that stop its integral only, for a smallest step (m)."""
    counts = COUNTS * servo.position_resolution
    zones = [(share * step + counts, leave) for share, leave in demands.stops]
    return [
        Design(law.replace(integral_only=True, enter=1.0, leave=leave), tolerance)
        for tolerance, leave in zones
        if tolerance <= demands.tolerance
    ]


def _zones_in_gap(servo: Plant, laws: tuple[AnyController, ...], zone: float, demands: Demands) -> list[Design]:
    """Laws other than the filtered PID with a dead zone over the lost motion (m), noise or not.

    It stops the integral, which would wind up there, or opens the loop: a velocity loop in the motor holds the motor in
    the middle of a gap only where the position loop asks for nothing.
    """
    if isinstance(servo.controller, Controller) or not 0.0 < zone <= demands.tolerance:
        return []
    stopping = [] if stands_on_integral(servo) else [law for law in laws if integrates(law)]
    stopped = [law.replace(integral_only=True, enter=1.0, leave=_LEAVES) for law in stopping]
    opening = [law.replace(integral_only=False) for law in laws]
    opened = [law.replace(enter=enter, leave=leave) for law in opening for enter, leave in demands.hysteresis]
    return [Design(law, zone) for law in (*stopped, *opened)]


def _stopped_in_gap(servo: Plant, plain: list[Design], zone: float, demands: Demands) -> list[Design]:
    """Filtered PIDs whose integral may act as a whole, with zones about the lost motion (m) that stop it.

    Within the lost motion the integral pushes the motor from flank to flank and does not move the load.
    """
    if not isinstance(servo.controller, Controller) or not has_slow_integral(servo):
        return []
    laws = [each.controller for each in plain if integrates(each.controller) and not each.tolerance]
    # A zone that is wider than the error that may be left in the end would be in vain.
    sizes = [(min(share * zone, _WITHIN * demands.tail / leave), leave) for share, leave in _GAP_ZONES]
    zones = [(tolerance, leave) for tolerance, leave in sizes if 0.0 < tolerance <= demands.tolerance]
    return [
        Design(law.replace(integral_only=True, enter=1.0, leave=leave), tolerance)
        for law in laws
        for tolerance, leave in zones
    ]
