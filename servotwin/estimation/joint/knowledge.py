"""What is known of a joint model's parameters before the fit: bounds, priors, where to begin, which steps matter."""

from __future__ import annotations

import math

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.joint.model import JUMP, JointModel
from servotwin.estimation.joint.search import Known
from servotwin.estimation.joint.settings import SPREADS, JointSettings
from servotwin.estimation.trend import Prior
from servotwin.plant.signals import Array

AnyPrior = float | GapEstimate | Prior | None


def known_of(model: JointModel, prior: AnyPrior, settings: JointSettings) -> Known:
    """Bounds and priors."""
    rows = {"gap": (0.0, settings.largest_gap_rad, 0.0, math.inf), "place": (-1.0, 1.0, 0.0, math.inf)}
    rows["delay"] = (-settings.largest_delay_s, settings.largest_delay_s, 0.0, math.inf)
    rows.update({name: (-4.0 * s, 4.0 * s, 0.0, s) for name, s in ((n, settings.spread(n)) for n in SPREADS)})
    if isinstance(prior, Prior):
        rows["gap"] = (0.0, settings.largest_gap_rad, prior.gap, max(prior.gap_std, settings.model_error_rad))
    if model.window.voltage is not None and model.window.theta_m is None:
        size = max(1e-6, float(np.abs(model.window.voltage).max()))
        speed, current = size / model.servo.k_B, size / model.servo.R
        rows["speed0"] = (-4.0 * speed, 4.0 * speed, float(model.window.voltage[0]) / model.servo.k_B, speed)
        rows["current0"] = (-4.0 * current, 4.0 * current, 0.0, current)
        for index in model.jumps:
            area = 0.5 * abs(float(np.diff(model.window.voltage)[index])) / model.rate
            rows[f"{JUMP}{index}"] = (-area, area, 0.0, area / math.sqrt(3.0))
    return Known(*(np.array(column) for column in zip(*(rows[name] for name in model.names), strict=True)))


def start_of(model: JointModel, prior: AnyPrior) -> Array:
    """(P,) the point that the search begins from, but for gap and place, which are scanned."""
    values = dict.fromkeys(model.names, 0.0)
    values["gap"] = _gap_of(prior) or 0.0
    if "speed0" in values and model.window.voltage is not None:
        values["speed0"] = float(model.window.voltage[0]) / model.servo.k_B
    return np.array(list(values.values()))


def _gap_of(prior: AnyPrior) -> float | None:
    """rad."""
    gap = prior if prior is None or isinstance(prior, int | float) else prior.gap
    if isinstance(prior, GapEstimate) and not prior.ok:
        return None
    if gap is not None and not 0.0 <= gap < math.inf:
        raise InvalidInput(f"prior gap = {gap!r} rad: must be finite and at least 0")
    return gap


def tolerance_of(model: JointModel) -> Array:
    """(P,) steps that do not matter: 3e-5 deg, and 1e-6 of what is a logarithm."""
    steps = {"gap": 5e-7, "place": 1e-2, "delay": 1e-8, "gap rate": 1e-6, "speed0": 1e-3, "current0": 1e-4}
    steps.update({f"{JUMP}{index}": 1e-8 for index in model.jumps})
    return np.array([steps.get(name, 1e-6) for name in model.names])
