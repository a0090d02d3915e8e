"""A digital twin that keeps a motion controller tuned while its machine wears."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Certificate": "servotwin.redesign.certified.certificate",
    "Controller": "servotwin.control",
    "CycleResult": "servotwin.analysis.limit_cycles.cycle",
    "Demands": "servotwin.redesign.certified.certificate",
    "GapEstimate": "servotwin.estimation.estimate",
    "GapStatus": "servotwin.estimation.estimate",
    "InvalidInput": "servotwin.errors",
    "Loop": "servotwin.cosim",
    "Noise": "servotwin.plant.noise",
    "PiecewiseCubic": "servotwin.plant.signals",
    "Run": "servotwin.simulation.run",
    "SCurve": "servotwin.plant.signals",
    "Samples": "servotwin.plant.signals",
    "Scenario": "servotwin.cosim.scenario",
    "Servo": "servotwin.plant.servo",
    "Simulation": "servotwin.simulation",
    "SquareWave": "servotwin.plant.signals",
    "StabilityMap": "servotwin.analysis.maps.result",
    "Step": "servotwin.plant.signals",
    "Trend": "servotwin.estimation.learning.trend",
    "Tuning": "servotwin.analysis.tuning.tune",
    "Uncertainty": "servotwin.redesign.certified.uncertainty",
    "Window": "servotwin.estimation.window",
    "certify": "servotwin.redesign.certified.certify",
    "cosimulate": "servotwin.cosim",
    "estimate_gap": "servotwin.estimation.gap",
    "estimate_jointly": "servotwin.estimation.joint.estimator",
    "limit_cycle": "servotwin.analysis.limit_cycles.cycle",
    "simulate": "servotwin.simulation",
    "stability_map": "servotwin.design",
    "tune": "servotwin.design",
}

if TYPE_CHECKING:
    from servotwin.analysis.limit_cycles.cycle import CycleResult, limit_cycle
    from servotwin.analysis.maps.result import StabilityMap
    from servotwin.analysis.tuning.tune import Tuning
    from servotwin.control import Controller
    from servotwin.cosim import Loop, cosimulate
    from servotwin.cosim.scenario import Scenario
    from servotwin.design import stability_map, tune
    from servotwin.errors import InvalidInput
    from servotwin.estimation.estimate import GapEstimate, GapStatus
    from servotwin.estimation.gap import estimate_gap
    from servotwin.estimation.joint.estimator import estimate_jointly
    from servotwin.estimation.learning.trend import Trend
    from servotwin.estimation.window import Window
    from servotwin.plant.noise import Noise
    from servotwin.plant.servo import Servo
    from servotwin.plant.signals import PiecewiseCubic, Samples, SCurve, SquareWave, Step
    from servotwin.redesign.certified.certificate import Certificate, Demands
    from servotwin.redesign.certified.certify import certify
    from servotwin.redesign.certified.uncertainty import Uncertainty
    from servotwin.simulation import Simulation, simulate
    from servotwin.simulation.run import Run

__all__ = [
    "Certificate",
    "Controller",
    "CycleResult",
    "Demands",
    "GapEstimate",
    "GapStatus",
    "InvalidInput",
    "Loop",
    "Noise",
    "PiecewiseCubic",
    "Run",
    "SCurve",
    "Samples",
    "Scenario",
    "Servo",
    "Simulation",
    "SquareWave",
    "StabilityMap",
    "Step",
    "Trend",
    "Tuning",
    "Uncertainty",
    "Window",
    "certify",
    "cosimulate",
    "estimate_gap",
    "estimate_jointly",
    "limit_cycle",
    "simulate",
    "stability_map",
    "tune",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562), so that a part does not import the rest."""
    if name not in _HOMES:
        raise AttributeError(f"module 'servotwin' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
