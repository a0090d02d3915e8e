"""The control law: what is tuned (`Controller`), what runs every sample (`tick`)."""

from servotwin.control.controller import Controller
from servotwin.control.law import LawParameters, LawState, start, tick, transfer

__all__ = ["Controller", "LawParameters", "LawState", "start", "tick", "transfer"]
