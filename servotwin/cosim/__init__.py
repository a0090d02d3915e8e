"""Plant, edge, link and twin under one virtual clock."""

from servotwin.cosim.driver import Cosimulation, cosimulate
from servotwin.cosim.loop import Loop, MessageCopy
from servotwin.cosim.machine import Machine, SimulatedMachine, simulation_of
from servotwin.cosim.quantisation import Quantisation, quantisation

__all__ = [
    "Cosimulation",
    "Loop",
    "Machine",
    "MessageCopy",
    "Quantisation",
    "SimulatedMachine",
    "cosimulate",
    "quantisation",
    "simulation_of",
]
