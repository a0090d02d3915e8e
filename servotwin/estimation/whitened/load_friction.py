"""Coulomb friction of the load that nobody stated, as what a fit leaves: a force on the last mass against its motion.

The fit's own motion tells the direction. Where the load rests the force is not known, so that the sum is a guess: it
names a cause, and moves no gap. What other numbers of the structure would explain is no friction.
"""

from __future__ import annotations

import numpy as np

from servotwin.estimation.core.least_squares import least_squares
from servotwin.estimation.core.response import Response, Structures
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.free_model import FACTORS
from servotwin.estimation.whitened.nearby import nearby
from servotwin.estimation.whitened.reduction import GAP, RESIDUAL
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_RESTS = 0.02  # of the largest speed: the force turns about there
# Of what a fit leaves. Of 183 refused windows with friction 57 had more, and four of 219 with other faults.
_EXPLAINS = 0.6
_HERE = (0.0,) * len(FACTORS)  # logarithms of the factors


def friction_hint(fit: WhitenedFit, servo: Servo) -> str:
    """Sentence for a fit whose residual looks like friction of the load; empty where it does not."""
    force, share = friction_in(fit, servo)
    if not (force > 0.0 and share >= _EXPLAINS):
        return ""
    return (
        f"a Coulomb friction of the load of about {force:.2g} N (rotary: N m) would explain {100.0 * share:.0f} % of "
        "what is left: stated as the friction of an axis's load it is part of the model"
    )


def friction_in(fit: WhitenedFit, servo: Servo) -> tuple[float, float]:
    """Friction (N; rotary: N m) that explains most of what a fit leaves, and its share of that, in squares."""
    table, reduction = fit.table, fit.reduction
    interval = reduction.response.interval * reduction.decimation.factor
    speed = np.gradient(reduction.position - fit.residual, interval)
    against = -speed / np.hypot(speed, _RESTS * float(np.max(np.abs(speed))) or 1.0)
    pushed = _pushed(servo, 1.0 / interval).respond(against[None])
    known = np.vstack([table[GAP:], _by_numbers(fit, servo)])
    without, given = _left(known, table[RESIDUAL]), _left(np.vstack([known, pushed]), table[RESIDUAL])
    share = 1.0 - given[1] / without[1] if without[1] > 0.0 else 0.0
    return given[0], share


def _by_numbers(fit: WhitenedFit, servo: Servo) -> Array:
    """(4, m) derivatives of the fitted position by the structure's numbers."""
    reduction = fit.reduction
    near = nearby(servo, _HERE, 1.0 / reduction.response.interval, reduction.decimation, False)
    answer, weights = reduction.position - fit.table[RESIDUAL], fit.shares[1 : len(reduction.fixed())]
    return near.motions(reduction.traced(fit.point)[:1], answer, weights)


def _left(columns: Array, target: Array) -> tuple[float, float]:
    """Coefficient of the last of the columns (k, m) that are fitted to a target (m,), and the squares that are left."""
    shares = least_squares(columns, target).coefficients
    left = target - shares @ columns
    return float(shares[-1]), float(left @ left)


def _pushed(servo: Servo, sample_rate: float) -> Response:
    """Response of the last mass's position (m) to a force (N) on it, at a sample rate (Hz)."""
    chain = servo.chain()
    drive = np.zeros(len(chain.A))
    drive[-1] = 1.0 / float(servo.masses[-1])
    nothing = np.zeros(1)
    return Structures(chain.A[None], drive[None], chain.C_last, nothing, nothing).responses(sample_rate)[0]
