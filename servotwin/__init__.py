"""A digital twin that keeps a motion controller tuned while its machine wears."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Axis": "servotwin.plant.axis",
    "Cascade": "servotwin.control.cascade",
    "Certificate": "servotwin.redesign.certified.certificate",
    "Controller": "servotwin.control",
    "CycleResult": "servotwin.analysis.limit_cycles.cycle",
    "DcMotor": "servotwin.plant.actuator",
    "Demands": "servotwin.redesign.certified.demands",
    "GapEstimate": "servotwin.estimation.estimate",
    "GapStatus": "servotwin.estimation.estimate",
    "InvalidInput": "servotwin.errors",
    "LinearLaw": "servotwin.control.linear_law",
    "Load": "servotwin.plant.load",
    "Loop": "servotwin.cosim",
    "Noise": "servotwin.plant.noise",
    "PiecewiseCubic": "servotwin.plant.signals",
    "Run": "servotwin.simulation.run",
    "SCurve": "servotwin.plant.signals",
    "Samples": "servotwin.plant.signals",
    "Scenario": "servotwin.cosim.scenario",
    "Sensors": "servotwin.plant.sensors",
    "Servo": "servotwin.plant.servo",
    "Simulation": "servotwin.simulation",
    "SquareWave": "servotwin.plant.signals",
    "StabilityMap": "servotwin.analysis.maps.result",
    "Step": "servotwin.plant.signals",
    "Stepper": "servotwin.plant.actuator",
    "TorqueDrive": "servotwin.plant.actuator",
    "Transmission": "servotwin.plant.transmission",
    "Trend": "servotwin.estimation.learning.trend",
    "Tuning": "servotwin.analysis.tuning.tune",
    "Uncertainty": "servotwin.redesign.certified.uncertainty",
    "VelocityDrive": "servotwin.plant.actuator",
    "Window": "servotwin.estimation.window",
    "certify": "servotwin.redesign.certified.certify",
    "commission": "servotwin.commissioning.commission",
    "cosimulate": "servotwin.cosim",
    "estimate_gap": "servotwin.estimation.gap",
    "estimate_jointly": "servotwin.estimation.joint.estimator",
    "limit_cycle": "servotwin.analysis.limit_cycles.cycle",
    "simulate": "servotwin.simulation",
    "stability_map": "servotwin.design",
    "tune": "servotwin.design",
    "tune_cascade": "servotwin.analysis.tuning.cascade",
}

if TYPE_CHECKING:
    from servotwin.analysis.limit_cycles.cycle import CycleResult, limit_cycle
    from servotwin.analysis.maps.result import StabilityMap
    from servotwin.analysis.tuning.tune import Tuning
    from servotwin.commissioning.commission import commission
    from servotwin.control import Controller
    from servotwin.control.cascade import Cascade
    from servotwin.control.linear_law import LinearLaw
    from servotwin.cosim import Loop, cosimulate
    from servotwin.cosim.scenario import Scenario
    from servotwin.design import stability_map, tune
    from servotwin.errors import InvalidInput
    from servotwin.estimation.estimate import GapEstimate, GapStatus
    from servotwin.estimation.gap import estimate_gap
    from servotwin.estimation.joint.estimator import estimate_jointly
    from servotwin.estimation.learning.trend import Trend
    from servotwin.estimation.window import Window
    from servotwin.plant.actuator import DcMotor, Stepper, TorqueDrive, VelocityDrive
    from servotwin.plant.axis import Axis
    from servotwin.plant.load import Load
    from servotwin.plant.noise import Noise
    from servotwin.plant.sensors import Sensors
    from servotwin.plant.servo import Servo
    from servotwin.plant.signals import PiecewiseCubic, Samples, SCurve, SquareWave, Step
    from servotwin.plant.transmission import Transmission
    from servotwin.redesign.certified.certificate import Certificate
    from servotwin.redesign.certified.certify import certify
    from servotwin.redesign.certified.demands import Demands
    from servotwin.redesign.certified.uncertainty import Uncertainty
    from servotwin.simulation import Simulation, simulate
    from servotwin.simulation.run import Run

__all__ = [
    "Axis",
    "Cascade",
    "Certificate",
    "Controller",
    "CycleResult",
    "DcMotor",
    "Demands",
    "GapEstimate",
    "GapStatus",
    "InvalidInput",
    "LinearLaw",
    "Load",
    "Loop",
    "Noise",
    "PiecewiseCubic",
    "Run",
    "SCurve",
    "Samples",
    "Scenario",
    "Sensors",
    "Servo",
    "Simulation",
    "SquareWave",
    "StabilityMap",
    "Step",
    "Stepper",
    "TorqueDrive",
    "Transmission",
    "Trend",
    "Tuning",
    "Uncertainty",
    "VelocityDrive",
    "Window",
    "certify",
    "commission",
    "cosimulate",
    "estimate_gap",
    "estimate_jointly",
    "limit_cycle",
    "simulate",
    "stability_map",
    "tune",
    "tune_cascade",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for (PEP 562), so that a part does not import the rest."""
    if name not in _HOMES:
        raise AttributeError(f"module 'servotwin' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
