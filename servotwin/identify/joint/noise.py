"""The noise in what a joint fit leaves of a window."""

from __future__ import annotations

import math

import numpy as np

from servotwin.identify.core.decimation import Decimation
from servotwin.identify.core.normal import least_squares
from servotwin.identify.core.whitening import Autoregression, burg
from servotwin.identify.joint.model import JUMP, MOTOR_START, JointModel
from servotwin.identify.joint.search import Stand
from servotwin.plant.signals import Array


def noise_left(
    model: JointModel, found: Stand, reduce: Decimation, before: Autoregression, order: int, put: bool
) -> Autoregression:
    """The noise in the residual of a fit that was made with a first idea of it.

    A fit takes noise away with every parameter, and most where the gap shows, so that what is left looks quieter there
    than the noise was. With `put`, what it may have taken is put back, as equally likely series: one standard deviation
    up and down along every direction of the parameters.
    """
    table = _kept(model, model.table(dict(zip(model.names, found.point.tolist(), strict=True)), reduce.rows))
    rows = before.whiten(table)
    solved = least_squares(rows[1:], rows[0])
    left = table[0] - solved.coefficients @ table[1:]
    if not np.any(left):
        return Autoregression.white(1.0)
    if not put:
        return burg(left[None], order)
    rest = rows[0] - solved.coefficients @ rows[1:]
    scale = math.sqrt(float(rest @ rest) / max(1, rest.size - len(solved.root)))
    taken = scale * math.sqrt(len(solved.root)) * (solved.root @ table[1:])
    return burg(np.vstack([left + taken, left - taken]), order)


def _kept(model: JointModel, table: Array) -> Array:
    """The rows without those of parameters that are known well beforehand and take little away."""
    first = len(table) - len(model.names)
    known = [first + i for i, name in enumerate(model.names) if name in MOTOR_START or name.startswith(JUMP)]
    return np.delete(table, known, axis=0)
