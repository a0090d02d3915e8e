"""What a gap leaves unexplained of a window, with its exact derivatives, nuisances projected out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.between import trace
from servotwin.estimation.core.contacts import Gap
from servotwin.estimation.core.decimation import Decimation
from servotwin.estimation.core.projection import remove
from servotwin.estimation.core.response import Response
from servotwin.estimation.core.whitening import Autoregression
from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array


class Point(NamedTuple):
    """Total gap (rad) and where in it the screw began, -1 (behind the motor by half the gap) .. 1 (ahead of it)."""

    gap: float
    place: float

    def screw(self, first: float, rate: float = 0.0) -> Gap:
        """The same as seen by the play operator, the motor's first angle being `first` (rad)."""
        return Gap(self.gap, first + 0.5 * self.gap * self.place, rate)


class Slopes(NamedTuple):
    """Residual (m,), its derivatives by gap and place (2, m), its square and their products."""

    residual: Array
    jacobian: Array
    cost: float


@dataclass(frozen=True, eq=False)
class Misfit:
    """Position less the structure's response to the play operator, reduced to few, white samples.

    Attributes
    ----------
    theta_m : (n,) array
        rad, from the window's first angle on.
    position : (m,) array
        Reduced like everything else.
    basis : (r, m) array
        Orthonormal nuisances.
    response : Response
    decimation : Decimation
    noise : Autoregression, optional
        None: not whitened.
    extra : int
        Rows at the end that no screw's motion reaches: prior knowledge of nuisances.
    rate : float
        rad per sample: how fast the gap grows.
    """

    theta_m: Array
    position: Array
    basis: Array
    response: Response
    decimation: Decimation
    noise: Autoregression | None = None
    extra: int = 0
    rate: float = 0.0

    def reduce(self, columns: Array) -> Array:
        """(k, m) of rows (k, n) at the full rate."""
        rows = self.decimation.rows(columns)
        rows = rows if self.noise is None else self.noise.whiten(rows)
        return np.hstack([rows, np.zeros((len(rows), self.extra))]) if self.extra else rows

    def cost(self, point: Point) -> float:
        """Squared length of the residual."""
        screw = np.empty((1, self.theta_m.size))
        trace(self.theta_m, *point.screw(self.theta_m[0], self.rate), screw)
        row = self.position - self.reduce(self.response.respond(screw))[0]
        remove(self.basis, len(self.basis), row)
        return float(row @ row)

    def slopes(self, point: Point) -> Slopes:
        """Residual and derivatives at a point."""
        seen = np.empty((4, self.theta_m.size))
        trace(self.theta_m, *point.screw(self.theta_m[0], self.rate), seen)
        mix_places(seen, point.gap, point.place)
        rows = self.reduce(self.response.respond(seen[:3]))
        rows[0] -= self.position
        for row in rows:
            remove(self.basis, len(self.basis), row)
        np.negative(rows, out=rows)
        return Slopes(rows[0], rows[1:], float(rows[0] @ rows[0]))


@bare
def mix_places(seen: Array, gap: float, place: float) -> None:
    """Turn derivatives by gap at fixed theta_d0, and by theta_d0, into those by gap at fixed place, and by place."""
    half = 0.5 * gap
    for i in range(seen.shape[1]):
        seen[1, i] += 0.5 * place * seen[2, i]
        seen[2, i] *= half
