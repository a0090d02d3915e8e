"""Simulation of a servo: continuous or sampled, exact in both."""

from servotwin.simulation.run import Run
from servotwin.simulation.simulate import Simulation, simulate

__all__ = ["Run", "Simulation", "simulate"]
