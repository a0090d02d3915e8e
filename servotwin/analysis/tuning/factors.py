"""A PIDF controller by the phases of its factors at the crossover, as pidtune parametrises it.

    C(s) = K (s sin phz + wc cos phz) (s sin be + wc cos be) / (s (s sin al + wc cos al))

At s = j wc every bracket is wc exp(j angle): so the angles are phases, and abs(C(j wc)) = K.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.linear import Complex

# Where a type has no filter of its own: the law's derivative needs one, so fast that it costs half a degree at most.
FASTEST_FILTER = 0.01
_ROUNDING = 8.0 * float(np.finfo(float).eps)


class Kind(NamedTuple):
    """What a controller type consists of: an integrator, a second zero `be`, a filter `al` to choose."""

    integral: bool
    zero: bool
    second_zero: bool
    filter: bool


KINDS = {
    "P": Kind(False, False, False, False),
    "PI": Kind(True, True, False, False),
    "PD": Kind(False, True, False, False),
    "PDF": Kind(False, True, False, True),
    "PID": Kind(True, True, True, False),
    "PIDF": Kind(True, True, True, True),
}


class Factors(NamedTuple):
    """K (V/m), the crossover wc (rad/s) and the angles phz, be, al (rad); be is 0 without a second zero."""

    K: float
    wc: float
    phz: float
    be: float
    al: float
    integral: bool

    def controller(self) -> Controller:
        """The gains of the law that equals C(s); the filter's time is tan(al) / wc."""
        Kp, Ki, Kd, time = (float(value) for value in _gains(self))
        # Without derivative action the filter has nothing to filter; the law wants one all the same.
        return Controller(Kp, Ki, Kd, time if time > 0.0 else FASTEST_FILTER / self.wc)

    def response(self, omega: ArrayLike) -> Complex:
        """C(j omega)."""
        s, w = 1j * np.asarray(omega, dtype=float), self.wc
        first = s * np.sin(self.phz) + w * np.cos(self.phz)
        second = s * np.sin(self.be) + w * np.cos(self.be)
        below = s * np.sin(self.al) + w * np.cos(self.al)
        return np.asarray(self.K * first * second / (below * (s if self.integral else w)))


def _gains(factors: Factors) -> tuple[float, float, float, float]:
    """Kp, Ki, Kd, Tf by comparing coefficients over s (Tf s + 1)."""
    K, wc, phz, be, al, integral = factors
    time = math.tan(al) / wc
    below = wc * math.cos(al)
    square = K * math.sin(phz) * math.sin(be) / below
    linear = K * wc * math.sin(phz + be) / below
    constant = K * wc**2 * math.cos(phz) * math.cos(be) / below
    if not integral:
        # Without the integrator the same numerator stands over wc (Tf s + 1).
        square, linear, constant = 0.0, linear / wc, constant / wc
        return constant, 0.0, linear - constant * time, time
    Kp = linear - constant * time
    return Kp, constant, square - Kp * time, time


def factorised(controller: Controller, wc: float) -> Factors:
    """The factors of given gains (the inverse of `Factors.controller`) at a crossover wc, rad/s.

    Raises
    ------
    InvalidInput
        The controller has no integral action, or its zeros are not real and stable.
    """
    c = controller
    if c.Ki == 0.0:
        raise InvalidInput("controller Ki = 0: the factorisation needs integral action")
    zeros = _zeros(c)
    if not all(zero < 0.0 for zero in zeros):
        shown = "complex" if math.isnan(zeros[0]) else f"{', '.join(f'{zero:.6g}' for zero in zeros)} 1/s"
        raise InvalidInput(f"the controller's zeros are {shown}: they must be real and negative to be factored")
    angles = sorted((math.atan2(wc, -zero) for zero in zeros), reverse=True)
    angles += [0.0] * (2 - len(angles))
    K = abs(complex(c.Kp + c.Ki / (1j * wc) + c.Kd * 1j * wc / (c.Tf * 1j * wc + 1.0)))
    return Factors(math.copysign(K, c.Ki), wc, angles[0], angles[1], math.atan(wc * c.Tf), True)


def _zeros(c: Controller) -> list[float]:
    """Real zeros of a controller with integral action, 1/s; NaN for two that are complex.

    What cancels but for rounding is zero: the highest coefficient of a controller with one zero only, and the
    discriminant of two equal ones.
    """
    square, linear, constant = c.Kp * c.Tf + c.Kd, c.Kp + c.Ki * c.Tf, c.Ki
    linear_rounding = _ROUNDING * (abs(c.Kp) + abs(c.Ki) * c.Tf)
    square_rounding = _ROUNDING * (abs(c.Kp) * c.Tf + abs(c.Kd))
    if abs(square) <= square_rounding:
        return [-constant / linear] if abs(linear) > linear_rounding else []
    discriminant = linear**2 - 4.0 * square * constant
    if abs(discriminant) <= 2.0 * abs(linear) * linear_rounding + 4.0 * abs(constant) * square_rounding:
        discriminant = 0.0
    if discriminant < 0.0:
        return [math.nan, math.nan]
    larger = -0.5 * (linear + math.copysign(math.sqrt(discriminant), linear))
    return [larger / square, constant / larger]
