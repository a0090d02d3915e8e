"""Plant, edge, link and twin under one virtual clock."""

from servotwin.cosim.driver import Cosimulation, Machine, cosimulate
from servotwin.cosim.loop import Loop, Transmission
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.quantisation import Quantisation, quantisation

__all__ = [
    "Cosimulation",
    "Loop",
    "Machine",
    "Quantisation",
    "Transmission",
    "cosimulate",
    "quantisation",
    "simulation_of",
]
