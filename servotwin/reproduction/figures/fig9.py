"""Fig 9: the step response with a gap and no dead zone."""

from __future__ import annotations

from servotwin.reproduction.figures import gaps
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.runs import Runs


def data(runs: Runs) -> gaps.Data:
    """1 mm steps for total gaps of 0, 5, 10 and 15 deg."""
    return gaps.data(runs, None)


PLATE = Plate(
    "fig9",
    "Fig 9. The gap makes the loop oscillate.",
    "(a) Position of the last mass after a 1 mm step and (b) the angles of motor and screw, for four total gaps and"
    " without a dead zone.",
    data,
    gaps.plot,
)
