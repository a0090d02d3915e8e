"""Time that a load takes for a step, by which the windows of a slow loop are longer than those of the machine's own."""

from __future__ import annotations

import math

import numpy as np

from servotwin.control.laws import AnyController
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Step
from servotwin.simulation.simulate import simulate

_ARRIVED = 0.95  # of the way
_ASTRAY = 2.0  # steps: farther than any overshoot of a stable loop
_SAMPLES = 2000  # about so many


def move_time(servo: Plant, law: AnyController, tolerance: float, step: float, longest: float) -> float:
    """Time (s) until the load has gone nearly all of the way that it goes within `longest` (s) after a step from rest.

    Without a gap. Friction and limits count: the load may stop where friction holds it. 0: the loop is unstable.

    Parameters
    ----------
    servo : Servo or Axis
    law : Controller, Cascade or LinearLaw
    tolerance : float
        m, rotary: rad; of the dead zone.
    step : float
        m, rotary: rad.
    longest : float
        s.
    """
    rate, wanted = law.sample_rate, _SAMPLES / longest
    shown = wanted if rate is None else rate / max(1, math.floor(rate / wanted))
    run = simulate(servo, longest, controller=law, reference=Step(step), tolerance=tolerance, sample_rate=shown)
    way = np.abs(run.position - run.position[0])
    if way.max() > _ASTRAY * step:
        return 0.0
    return float(run.time[np.argmax(way >= _ARRIVED * way[-1])])
