"""Place of a setting in a stability map, whose cells are computed exactly, in the background, the nearest first.

The loop without friction is homogeneous: one map over dead zone and step, each over half the travel in the gap, holds
for every gap. Only other gains need another map.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from threading import Lock, Thread
from typing import Any

from servotwin.analysis.maps.axes import RatioAxes
from servotwin.analysis.maps.measures import measured
from servotwin.analysis.maps.settings import MapSettings
from servotwin.control.laws import AnyController
from servotwin.errors import InvalidInput
from servotwin.plant.plants import Plant

TOLERANCES = tuple(0.4 * k for k in range(11))
STEPS = tuple(2.0**k for k in range(-2, 9))
"""Axes of the coarse map: dead zone and step over half the travel in the gap."""
MEMBERS = 4
"""Starts in each cell."""
_MAPS = 8
"""Maps in memory: complete ones, and the last that was asked for."""


@dataclass(eq=False)
class CoarseMap:
    """A map, filled cell by cell.

    Attributes
    ----------
    settings : MapSettings
    settled : list of float or None
        Share of the starts that settle, last axis (the step) fastest; None: not computed yet.
    near : int
        Cell that is wanted first.
    failed : str
        Reason for which no cell can be computed; empty: none.
    """

    settings: MapSettings
    settled: list[float | None] = field(default_factory=lambda: [None] * (len(TOLERANCES) * len(STEPS)))
    near: int = 0
    failed: str = ""

    @property
    def missing(self) -> int | None:
        """The cell to be computed next: the nearest to `near`; None: there is none."""
        left = [cell for cell, value in enumerate(self.settled) if value is None]
        return min(left, key=self._distance) if left and not self.failed else None

    def compute(self, cell: int) -> None:
        """Run the starts of one cell."""
        try:
            self.settled[cell] = float(measured(self.settings, range(cell, cell + 1)).settled[0])
        except InvalidInput as error:
            self.failed = str(error)

    def _distance(self, cell: int) -> int:
        (row, column), (wanted, beside) = divmod(cell, len(STEPS)), divmod(self.near, len(STEPS))
        return max(abs(row - wanted), abs(column - beside))


class CoarseMaps:
    """Maps of some loops; a thread computes them, the one that was asked for last first."""

    def __init__(self) -> None:
        self._maps: OrderedDict[tuple[Plant, AnyController], CoarseMap] = OrderedDict()
        self._lock = Lock()
        self._thread: Thread | None = None

    def position(self, servo: Plant, law: AnyController, gap: float, tolerance: float, step: float) -> dict[str, Any]:
        """Place of a setting in the map of its loop.

        Parameters
        ----------
        servo, law : Plant, controller
        gap : float
            rad, total.
        tolerance, step : float
            m or rad, half-width of the dead zone and reference step.

        Returns
        -------
        dict
            Ready for JSON. why (there is no map; else empty), tolerances and steps (axes), settled (rows of shares,
            None where they are not known yet), tolerance and step (place on the axes), row and column (nearest cell),
            left (cells that are still to be computed) and starts (in each cell).
        """
        travel = 0.5 * abs(servo.p) * gap
        if travel <= 0.0:
            return {"why": "Without a gap there is no map: the loop settles, or it is unstable whatever the dead zone."}
        if servo.motor_friction or servo.own_friction:
            return {"why": "Friction makes the map another one for each gap; no coarse one is computed."}
        place = tolerance / travel, step / travel
        row = _nearest(TOLERANCES, place[0])
        column = _nearest([math.log(each) for each in STEPS], math.log(place[1]))
        try:
            found = self._wanted(servo, law, row * len(STEPS) + column)
        except InvalidInput as error:
            return {"why": str(error)}
        settled, width = list(found.settled), len(STEPS)
        return {
            "why": found.failed,
            "tolerances": TOLERANCES,
            "steps": STEPS,
            "settled": [settled[first : first + width] for first in range(0, len(settled), width)],
            "tolerance": place[0],
            "step": place[1],
            "row": row,
            "column": column,
            "left": 0 if found.failed else settled.count(None),
            "starts": MEMBERS,
        }

    def _wanted(self, servo: Plant, law: AnyController, near: int) -> CoarseMap:
        key = servo, law
        with self._lock:
            found = self._maps.get(key)
            if found is None:
                found = CoarseMap(MapSettings(servo, RatioAxes(TOLERANCES, STEPS), _continuous(law), members=MEMBERS))
                # While gains are dragged, each place would leave a map behind that nobody sees any more.
                for other in [each for each, value in self._maps.items() if value.missing is not None]:
                    del self._maps[other]
                self._maps[key] = found
            self._maps.move_to_end(key)
            if len(self._maps) > _MAPS:
                self._maps.popitem(last=False)
            found.near = near
            if self._thread is None and found.missing is not None:
                self._thread = Thread(target=self._compute, name="coarse maps", daemon=True)
                self._thread.start()
        return found

    def _compute(self) -> None:
        """Compute cells until none is missing."""
        while True:
            with self._lock:
                job = self._next()
                if job is None:
                    self._thread = None
                    return
            found, cell = job
            found.compute(cell)

    def _next(self) -> tuple[CoarseMap, int] | None:
        for found in reversed(self._maps.values()):
            if (cell := found.missing) is not None:
                return found, cell
        return None


def _continuous(law: AnyController) -> AnyController:
    """The law as maps take it: without sampling."""
    return law if law.sample_rate is None else law.replace(sample_rate=None)


def _nearest(values: tuple[float, ...] | list[float], value: float) -> int:
    return min(range(len(values)), key=lambda k: abs(values[k] - value))
