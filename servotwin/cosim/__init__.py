"""Plant, edge, link and twin under one virtual clock."""

from servotwin.cosim.driver import Cosimulation, cosimulate
from servotwin.cosim.loop import Loop, MessageCopy
from servotwin.cosim.machine import Machine, SimulatedMachine, simulation_of

__all__ = [
    "Cosimulation",
    "Loop",
    "Machine",
    "MessageCopy",
    "SimulatedMachine",
    "cosimulate",
    "simulation_of",
]
