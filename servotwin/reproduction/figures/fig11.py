"""Fig 11: the step response with a gap and the dead zone for 10 deg."""

from __future__ import annotations

from servotwin.reproduction.figures import gaps
from servotwin.reproduction.figures.plate import Plate
from servotwin.reproduction.runs import ESTIMATE_DEG, Runs


def data(runs: Runs) -> gaps.Data:
    """1 mm steps for total gaps of 0, 5, 10 and 15 deg, the dead zone made for 10 deg."""
    return gaps.data(runs, ESTIMATE_DEG)


PLATE = Plate(
    "fig11",
    "Fig 11. A dead zone settles it.",
    "As Fig 9, with a dead zone made for a gap of 10 deg whatever the gap is.",
    data,
    gaps.plot,
)
