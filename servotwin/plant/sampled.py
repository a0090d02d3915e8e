"""The loop without a gap, one tick ahead: zero-order hold on the plant, the edge's own tick as the law."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servotwin.control.law import LawState, tick
from servotwin.errors import InvalidInput
from servotwin.plant import linear
from servotwin.plant.linear import Complex, held

if TYPE_CHECKING:
    from servotwin.control.controller import Controller
    from servotwin.plant.servo import Servo


def sampled_poles(servo: Servo, controller: Controller) -> Complex:
    """Poles z of the sampled loop: eigenvalues of plant and law over one tick; stable when all abs(z) < 1.

    The law's matrix comes from applying the tick to unit states, with limits and dead zone off, where it is linear.
    """
    if controller.sample_rate is None:
        raise InvalidInput("controller sample_rate = None: a sampled loop needs a rate in Hz")
    plant = linear.plant(servo)
    law = controller.replace(voltage_limit=None, rate_limit=None, feedforward=0.0).law(None)
    advance, drive = held(plant.A, plant.B, 1.0 / controller.sample_rate)
    size = plant.B.size
    names = ["derivative"] + ["integral"] * (controller.Ki != 0.0) + ["filtered"] * (law.loop_step < 1.0)
    matrix = np.zeros((size + len(names), size + len(names)))
    for column, unit in enumerate(np.eye(len(matrix))):
        before = LawState(0.0, 0.0, 0.0, 0.0, 1.0)._replace(**dict(zip(names, map(float, unit[size:]), strict=True)))
        after = tick(law, before, 0.0, float(plant.C @ unit[:size]))
        matrix[:size, column] = advance @ unit[:size] + drive * after.voltage
        matrix[size:, column] = [getattr(after, name) for name in names]
    return np.asarray(np.linalg.eigvals(matrix), dtype=complex)
