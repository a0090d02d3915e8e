"""Plant, edge, link and twin under one virtual clock."""

from servotwin.cosim.driver import Cosimulation, cosimulate
from servotwin.cosim.loop import Loop, Transmission
from servotwin.cosim.machine import Machine, SimulatedMachine, simulation_of
from servotwin.cosim.quantisation import Quantisation, quantisation

__all__ = [
    "Cosimulation",
    "Loop",
    "Machine",
    "Quantisation",
    "SimulatedMachine",
    "Transmission",
    "cosimulate",
    "quantisation",
    "simulation_of",
]
