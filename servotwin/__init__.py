"""A digital twin that keeps a motion controller tuned while its machine wears."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Controller": "servotwin.control",
    "GapEstimate": "servotwin.estimation.estimate",
    "GapStatus": "servotwin.estimation.estimate",
    "InvalidInput": "servotwin.errors",
    "Noise": "servotwin.plant.noise",
    "PiecewiseCubic": "servotwin.plant.signals",
    "Run": "servotwin.simulation.run",
    "SCurve": "servotwin.plant.signals",
    "Samples": "servotwin.plant.signals",
    "Scenario": "servotwin.cosim.scenario",
    "Servo": "servotwin.plant.servo",
    "Simulation": "servotwin.simulation",
    "SquareWave": "servotwin.plant.signals",
    "Step": "servotwin.plant.signals",
    "Trend": "servotwin.estimation.trend",
    "Window": "servotwin.estimation.window",
    "cosimulate": "servotwin.cosim",
    "estimate_gap": "servotwin.estimation.gap",
    "estimate_jointly": "servotwin.estimation.joint.estimator",
    "simulate": "servotwin.simulation",
}

if TYPE_CHECKING:
    from servotwin.control import Controller
    from servotwin.cosim import cosimulate
    from servotwin.cosim.scenario import Scenario
    from servotwin.errors import InvalidInput
    from servotwin.estimation.estimate import GapEstimate, GapStatus
    from servotwin.estimation.gap import estimate_gap
    from servotwin.estimation.joint.estimator import estimate_jointly
    from servotwin.estimation.trend import Trend
    from servotwin.estimation.window import Window
    from servotwin.plant.noise import Noise
    from servotwin.plant.servo import Servo
    from servotwin.plant.signals import PiecewiseCubic, Samples, SCurve, SquareWave, Step
    from servotwin.simulation import Simulation, simulate
    from servotwin.simulation.run import Run

__all__ = [
    "Controller",
    "GapEstimate",
    "GapStatus",
    "InvalidInput",
    "Noise",
    "PiecewiseCubic",
    "Run",
    "SCurve",
    "Samples",
    "Scenario",
    "Servo",
    "Simulation",
    "SquareWave",
    "Step",
    "Trend",
    "Window",
    "cosimulate",
    "estimate_gap",
    "estimate_jointly",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562), so that a part does not import the rest."""
    if name not in _HOMES:
        raise AttributeError(f"module 'servotwin' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
