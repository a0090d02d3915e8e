"""The second degree of freedom: setpoint weights as a filter of the reference; the law does not change.

With weights b and c the law would act on b r - y and c r - y in its proportional and derivative terms. On a linear loop
that equals the unchanged law with its reference filtered by F = C_r / C,

    C_r = b Kp + Ki / s + c Kd s / (Tf s + 1),

which leaves margins, Ms and everything that a dead zone or a gap does at rest untouched.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import polynomial as poly

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.linear import LinearSystem, realised, series
from servotwin.plant.plants import Plant


def prefilter(controller: Controller, b: float, c: float) -> LinearSystem:
    """F for setpoint weights.

    Parameters
    ----------
    controller : Controller
        With integral action.
    b, c : float
        Shares of the reference in the proportional and derivative terms, within 0 .. 1; both 1 is no filter.

    Raises
    ------
    InvalidInput
        A weight is outside its range, there is no integral action (F would not have gain 1 at rest), or the
        controller's zeros are not stable (they are F's poles).
    """
    for name, weight in (("b", b), ("c", c)):
        if not (math.isfinite(weight) and 0.0 <= weight <= 1.0):
            raise InvalidInput(f"setpoint weight {name} = {weight!r}: must be within 0 and 1")
    g = controller
    if g.Ki == 0.0:
        raise InvalidInput("setpoint weights need integral action: without it they would change the gain at rest")
    above = np.array([g.Ki, b * g.Kp + g.Ki * g.Tf, b * g.Kp * g.Tf + c * g.Kd])
    below = np.array([g.Ki, g.Kp + g.Ki * g.Tf, g.Kp * g.Tf + g.Kd])
    # What cancels but for rounding is zero: a controller with one zero only.
    rounding = 1e-9 * np.array([0.0, abs(g.Kp) + abs(g.Ki) * g.Tf, abs(g.Kp) * g.Tf + abs(g.Kd)])
    above[np.abs(above) <= rounding] = below[np.abs(below) <= rounding] = 0.0
    order = int(np.flatnonzero(below)[-1])
    zeros = poly.polyroots(below[: order + 1])
    if np.any(zeros.real >= 0.0):
        raise InvalidInput(f"setpoint weights need a controller whose zeros are stable; its zeros are {zeros} 1/s")
    if np.any(above[order + 1 :] != 0.0):
        raise InvalidInput(f"setpoint weights b = {b:g}, c = {c:g}: Kp Tf = -Kd, so only c = b gives a proper filter")
    return realised(above[: order + 1], below[: order + 1])


def overshoot(servo: Plant, controller: Controller, b: float = 1.0, c: float = 1.0) -> float:
    """Overshoot of the linear loop's step response (no gap) as a part of the step, in ten turns of the slowest pole."""
    closed = servo.closed_loop(controller)
    system = closed if b == c == 1.0 else series(prefilter(controller, b, c), closed)
    slowest = float(np.min(np.abs(system.poles())))
    response = system.step(np.linspace(0.0, 20.0 * math.pi / slowest, 20_001))
    return float(np.max(response) - 1.0)
