"""Several windows of one machine: its own numbers are shared, gap, delay and initial states are each window's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.joint.alone import APART, RIVAL, Alone
from servotwin.estimation.joint.knowledge import tolerance_of
from servotwin.estimation.joint.search import Known, Stand, descend
from servotwin.plant.signals import Array

SHARED = ("k/m", "c/m", "pitch", "k_B")


@dataclass(frozen=True, eq=False)
class Together:
    """The windows as one problem, whose point has the shared parameters first and then each window's own.

    Attributes
    ----------
    fits : tuple of Alone
        All with the same shared parameters.
    places : tuple of (P,) arrays of int
        Where each window's parameters are in the whole point.
    """

    fits: tuple[Alone, ...]
    places: tuple[NDArray[np.intp], ...]

    @classmethod
    def of(cls, fits: Sequence[Alone]) -> Together:
        """The layout."""
        names = fits[0].model.names
        shared = {name: i for i, name in enumerate(name for name in names if name in SHARED)}
        places, end = [], len(shared)
        for fit in fits:
            own = [name for name in fit.model.names if name not in shared]
            where = {**shared, **{name: end + i for i, name in enumerate(own)}}
            places.append(np.array([where[name] for name in fit.model.names], dtype=np.intp))
            end += len(own)
        return cls(tuple(fits), tuple(places))

    @property
    def size(self) -> int:
        """Parameters in all."""
        return 1 + max(int(place.max()) for place in self.places)

    def joined(self, parts: Sequence[Array]) -> Array:
        """(size,) of one (P,) for each window; where they share, the first's counts."""
        whole = np.empty(self.size)
        for place, part in reversed(list(zip(self.places, parts, strict=True))):
            whole[place] = part
        return whole

    def known(self) -> Known:
        """Bounds and priors of the whole."""
        each = [fit.known for fit in self.fits]
        columns = ([getattr(one, name) for one in each] for name in ("lowest", "highest", "mean", "spread"))
        return Known(*(self.joined(column) for column in columns))

    def evaluate(self, point: Array) -> Stand:
        """Residuals and derivatives of all windows; what is known of the shared parameters counts once."""
        known, residuals, blocks = self.known(), [], []
        for fit, place in zip(self.fits, self.places, strict=True):
            count = len(place)
            seen = fit.evaluated(fit.known.vague(np.ones(count, dtype=bool)))(point[place])
            block = np.zeros((self.size, seen.residual.size - count))
            block[place] = seen.jacobian[:, :-count]
            residuals.append(seen.residual[:-count])
            blocks.append(block)
        prior, slope = (point - known.mean) / known.spread, np.diag(1.0 / known.spread)
        return Stand(point, np.concatenate([*residuals, prior]), np.hstack([*blocks, slope]))

    def solved(self) -> tuple[Stand, tuple[tuple[float, ...], ...]]:
        """The best minimum, and for each window the other gaps (rad) that explain all windows nearly as well."""
        tolerance = self.joined([tolerance_of(fit.model) for fit in self.fits])
        starts = [self._start([fit.best for fit in self.fits])]
        for index, fit in enumerate(self.fits):
            others = [one.best for one in self.fits]
            starts += [self._start([*others[:index], rival, *others[index + 1 :]]) for rival in fit.minima[1:]]
        found = [descend(self.evaluate, start, self.known(), tolerance) for start in starts]
        best = min(found, key=lambda one: one.cost)
        near = [one for one in found if one.cost < best.cost + RIVAL]
        gaps = [place[0] for place in self.places]
        rivals = tuple(tuple(float(one.point[i]) for one in near if _apart(one.point[i], best.point[i])) for i in gaps)
        return replace(best, evaluations=sum(one.evaluations for one in found)), rivals

    def _start(self, stands: Sequence[Stand]) -> Array:
        """Each window's own minimum; the shared parameters of the one that knows its gap best."""
        leader = min(range(len(stands)), key=lambda i: float(stands[i].deviations()[0]))
        whole = self.joined([one.point for one in stands])
        whole[self.places[leader]] = stands[leader].point
        return whole


def _apart(gap: float, other: float) -> bool:
    return abs(gap - other) > APART
