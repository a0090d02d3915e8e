"""Loads that float in their gap: how long they coast, and what never comes to rest there.

Inside the gap nothing but its bearing's friction stops such a load, and nothing but the law or its own friction stops
the motor. A law that reads the load alone answers every error with a push, whose flank the load leaves again: the loop
with hardly any stiffness, which a swing just wider than the gap sees (describing function), is unstable. A dead zone of
the lost motion leaves the motor alone there; it comes to rest if its drive brakes it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.retuning import law_for_margins, scaled
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.margins import nominal_margins
from servotwin.redesign.certified.uncertainty import Uncertainty

# Share of the shaft's stiffness that stands for a swing hardly wider than the gap.
_HARDLY = 1e-6
# Times 1 / crossover within which a motor that is left alone must lose its speed, or it coasts through a dead zone. Of
# seven random drives with 0.05 to 3.5 six came to rest in one; of the machines of a drive with 16 at most half did.
_BRAKED = 10.0


def coasting_time(servo: Plant, uncertainty: Uncertainty) -> float:
    """s, longest time constant with which a load that floats in its gap loses its speed; 0 where none floats, friction
    stops it, or nothing does."""
    if not isinstance(servo, Axis) or not floats_in_gap(servo) or not servo.load.c[0]:
        return 0.0
    return (1.0 + uncertainty.m) * sum(servo.load.m) / ((1.0 - uncertainty.c) * servo.load.c[0])


def check_rests(servo: Plant, uncertainty: Uncertainty, demands: Demands) -> None:
    """Refuse an axis on which no candidate can come to rest inside the gap.

    Raises
    ------
    InvalidInput
        Its load floats there without friction and damping, or its law drives the motor to and fro there.
    """
    # Within one count of its encoder a load is at rest as far as anybody can measure.
    seen = servo.p * uncertainty.gap[1] > servo.position_resolution
    if not isinstance(servo, Axis) or not floats_in_gap(servo) or not seen:
        return
    load = servo.load
    if not load.c[0]:
        damping, friction = load.key("c"), load.key("friction")
        raise InvalidInput(
            f"load.{damping} = 0: a load that floats in its gap without damping and friction never comes to rest, and "
            f'no setting is verified; give {damping} or {friction} above 0, or policy = "paper"'
        )
    if drives_to_and_fro(servo, uncertainty, demands) and not _is_braked(servo):
        motor = " or coulomb_friction_n_m of the actuator" if servo.takes_friction else ""
        raise InvalidInput(
            'controller.kind = "filtered_pid": this law reads the load alone and drives the motor to and fro in the '
            "gap, where neither motor nor load has friction and a motor that is left alone coasts on, so that no "
            "setting is verified; give "
            f'kind = "cascade", whose velocity loop brakes the motor, {load.key("friction")} of the load{motor} above '
            '0, or policy = "paper"'
        )


def drives_to_and_fro(servo: Plant, uncertainty: Uncertainty, demands: Demands) -> bool:
    """True where a filtered PID drives the motor to and fro in the gap at any gain, and no friction stops it."""
    law = servo.controller
    if not isinstance(servo, Axis) or not isinstance(law, Controller) or not floats_in_gap(servo) or servo.at_motor:
        return False
    stopped = servo.motor_friction > 0.0 or uncertainty.friction[0] > 0.0
    return not stopped and not _can_rest(servo, law, demands)


def floats_in_gap(axis: Plant) -> bool:
    """True where neither spring nor friction stops the load inside the gap."""
    if not isinstance(axis, Axis):
        return False
    return axis.backlash_kind is BacklashKind.FREE and axis.load.free and not axis.load.friction


def _can_rest(axis: Axis, own: Controller, demands: Demands) -> bool:
    """True where a candidate without integral action is stable with hardly any stiffness between motor and load."""
    shaft = axis.transmission
    soft = replace(axis, transmission=replace(shaft, k_d=_HARDLY * shaft.k_d, c_d=_HARDLY * shaft.c_d))
    plain = own.replace(sample_rate=None, rate_limit=None)
    laws = {scaled(plain, scale, shape, 0.0) for shape in demands.shapes for scale in demands.scales}
    return any(soft.closed_loop(law).poles().real.max() < 0.0 for law in laws)


def _is_braked(axis: Axis) -> bool:
    """True where drive and bearing stop a motor without command soon, seen by the loop."""
    alone = np.linalg.eigvals(np.asarray(axis.actuator.matrices().A)[:-1, :-1]).real.max()
    crossovers = nominal_margins(axis, law_for_margins(axis.pidf)).gain_crossovers
    return bool(crossovers) and -alone * _BRAKED >= crossovers[-1].omega
