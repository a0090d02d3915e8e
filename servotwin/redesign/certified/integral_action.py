"""Integral action among the candidates: when it is tried, and how much of the own one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.retuning import integrates, law_for_margins, only_integrates, static_gain, without_integral
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.margins import nominal_margins
from servotwin.redesign.certified.uncertainty import Uncertainty

# Shares of an integral action that may act as a whole: that of a cascade and of a linear law, and that of a filtered
# PID whose corner Ki / Kp is below this share of the crossover. A faster one swings in every gap: only the small shares
# of `Demands.integral` are tried.
_WHOLE_INTEGRAL = (0.0, 0.1, 0.3, 1.0)
_SLOW_INTEGRAL = 0.25
# Share of a step that the own gain leaves where a load pulls the motor off: half of what counts as arrived, since lower
# gains leave more.
_PULLED = 0.01
# A motor that rests anywhere answers a frequency that is so much lower more strongly, by more than this.
_SLOWER, _INTEGRATES = 0.01, 10.0


def own_static_gain(servo: Plant) -> float:
    """Size of the command (V) with which the servo's own controller answers a constant error of one metre.

    Of a controller that only integrates it is the command that moves the load by one metre.
    """
    law = servo.controller
    return 1.0 / abs(slow_response(servo)[1]) if only_integrates(law) else abs(static_gain(law))


def slow_response(servo: Plant) -> tuple[float, complex]:
    """A frequency far below all corners of a plant (rad/s), and its response there (m/V)."""
    plant = servo.plant()
    corners = np.abs(plant.poles())
    slow = 1e-4 * float(corners[corners > 1e-9 * corners.max()].min())
    return slow, complex(plant.response(slow))


def is_pulled_off(servo: Plant, uncertainty: Uncertainty) -> bool:
    """Tell whether the load holds the motor off its reference, as a spring or a constant force does.

    It does where the servo's own static gain alone leaves an error that counts beside the smallest step.
    """
    own = servo.controller
    if only_integrates(own) or not own_static_gain(servo):
        return False
    step = uncertainty.step[0]
    return _held_by_spring(servo) * step + _held_by_force(servo, uncertainty.gap[0]) > _PULLED * step


def _held_by_spring(servo: Plant) -> float:
    """Share of a step that is left at rest without integral action; 0 for a motor that rests anywhere."""
    slow, response = slow_response(servo)
    if abs(servo.plant().response(_SLOWER * slow)) > _INTEGRATES * abs(response):
        return 0.0
    return 1.0 / (1.0 + own_static_gain(servo) * abs(response))


def _held_by_force(servo: Plant, gap: float) -> float:
    """Error (m) with which the servo's own static gain holds the constant force on the load."""
    rest = servo.rest_under_force(gap, 0.0) if isinstance(servo, Axis) else None
    return 0.0 if rest is None else abs(rest.command) / own_static_gain(servo)


def integral_shares(servo: Plant, demands: Demands, disturbed: bool = True) -> tuple[float, ...]:
    """Factors on the own integral action that are tried; `disturbed`: friction, a bias or a pulled load asks for it.

    That of a filtered PID acts on the position, across the gap; that of a cascade on the motor's speed, before it. One
    that is all of a controller is scaled like other gains, and one that a loop needs is never less.
    """
    own = servo.controller
    if only_integrates(own) or stands_on_integral(servo):
        return (1.0,)
    if not disturbed:
        return (0.0,)
    return demands.integral if isinstance(own, Controller) and not has_slow_integral(servo) else _WHOLE_INTEGRAL


@lru_cache(maxsize=16)
def stands_on_integral(servo: Plant) -> bool:
    """True where the own loop is stable with its integral action only: its proportional gain may have the other sign,
    and no zone may stop the integral."""
    own = law_for_margins(servo.controller)
    if not integrates(own) or only_integrates(own) or not nominal_margins(servo, own).stable:
        return False
    return not nominal_margins(servo, without_integral(own)).stable


def has_slow_integral(servo: Plant) -> bool:
    """True where a filtered PID's own integral acts well below the crossover, as a textbook has it."""
    own = servo.controller
    if not isinstance(own, Controller) or not own.Ki or not own.Kp:
        return False
    crossovers = nominal_margins(servo, law_for_margins(own)).gain_crossovers
    return bool(crossovers) and 0.0 < own.Ki / own.Kp <= _SLOW_INTEGRAL * crossovers[-1].omega
