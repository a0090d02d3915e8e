"""The residual of a window at a gap and its exact derivatives: decimated, whitened, nuisances projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.contacts import BY_RATE, Gap, polygon
from servotwin.estimation.core.decimation import Decimation, decimation
from servotwin.estimation.core.least_squares import least_squares, orthonormal
from servotwin.estimation.core.reduced import ReducedResponse, reduced_response
from servotwin.estimation.core.response import Response
from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.whitened.descent import MisfitData, Room, evaluate_all, mix_places
from servotwin.estimation.whitened.hum import hum, sines
from servotwin.plant.signals import Array


class Point(NamedTuple):
    """Total gap (rad) and where in it the screw began, -1 (behind the motor by half the gap) .. 1 (ahead of it)."""

    gap: float
    place: float

    def screw(self, first: float, rate: float = 0.0) -> Gap:
        """Arguments of the play operator; `first` is the motor's first angle (rad)."""
        return Gap(self.gap, first + 0.5 * self.gap * self.place, rate)


class MisfitSlopes(NamedTuple):
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
    reduced : ReducedResponse
    noise : Autoregression, optional
        None: not whitened.
    extra : int
        Rows at the end that no screw's motion reaches: prior knowledge of nuisances.
    rate : float
        rad per sample: growth of the gap.
    """

    theta_m: Array
    position: Array
    basis: Array
    reduced: ReducedResponse
    noise: Autoregression | None = None
    extra: int = 0
    rate: float = 0.0

    @cached_property
    def data(self) -> MisfitData:
        """The same for compiled functions."""
        readout, blocks = self.reduced.response.position, self.reduced.position
        noise = self.noise or Autoregression.white(1.0)
        return MisfitData(
            self.theta_m,
            self.position,
            self.basis,
            self.reduced.response.decay,
            readout.gain,
            readout.direct,
            *(3 * (np.empty((0, 0)),) if blocks is None else (blocks.angles, blocks.decay, blocks.gain)),
            noise.predictors,
            noise.spread,
            self.rate,
        )

    @cached_property
    def room(self) -> Room:
        """Memory of its evaluations."""
        return Room.of(self.data, self.position.size - self.extra)

    def costs(self, points: Sequence[Point]) -> Array:
        """(k,) squared lengths of the residual at points."""
        costs = np.empty(len(points))
        evaluate_all(self.data, self.room, np.array(points, dtype=float), costs)
        return costs


RESIDUAL, GAP, PLACE, CONSTANT = range(4)  # rows of a table; the structure's free motions come next
_SAMPLES_PER_PERIOD, _FEWEST = 40.0, 100  # kept at least: of the fastest mode; in all

_ROUNDING = 1e-13  # of the largest motion, some hundred times a float's
_ABOVE = 2.0  # times the structure's fastest mode: it hardly moves there
_MOST_GROWTH = 4.0  # standard deviations of the gap's rate


@dataclass(frozen=True, eq=False)
class NuisancePrior:
    """Prior knowledge of a nuisance, in its own unit."""

    mean: float
    std: float


@dataclass(frozen=True, eq=False)
class Reduction:
    """Both channels counted from their first sample on, the position decimated.

    Attributes
    ----------
    theta_m : (n,) array
        rad.
    position : (m,) array
        m.
    response : Response
    decimation : Decimation
    offset : NuisancePrior, optional
        Of the constant in the position, m.
    growth : NuisancePrior, optional
        Of the gap's rate, rad per sample; None: the gap is constant.
    rate : float
        rad per sample: the rate at which the screw is followed; what is left of the rate is a nuisance.
    rounding : float
        m: noise below this is rounding, which changes with every point and carries no information.
    skew : bool
        True: a delay between the channels is a nuisance.
    hum : tuple of float
        rad per reduced sample, frequencies of sines in the position that are nuisances too.
    """

    theta_m: Array
    position: Array
    response: Response
    decimation: Decimation
    offset: NuisancePrior | None = None
    growth: NuisancePrior | None = None
    skew: bool = True
    rate: float = 0.0
    rounding: float = 0.0
    hum: tuple[float, ...] = ()

    @classmethod
    def of(
        cls,
        theta_m: Array,
        position: Array,
        model: Response,
        offset: NuisancePrior | None = None,
        growth: NuisancePrior | None = None,
        skew: bool = True,
        factor: int | None = None,
    ) -> Reduction:
        """Prepare theta_m (n,) rad and position (n,) m, both from any origin; `factor` None: as the structure needs."""
        reduce = decimation(factor_for(model, theta_m.size) if factor is None else factor)
        rows = reduce.rows(np.asarray(position - position[0])[None])
        largest = max(float(np.abs(position).max()), abs(model.static_gain) * float(np.abs(theta_m).max()))
        # From the positions as measured: far from the origin their rounding is larger than the motion suggests.
        rounding = _ROUNDING * largest
        return cls(theta_m - theta_m[0], rows[0], model, reduce, offset, growth, skew, rounding=rounding)

    @property
    def reduced(self) -> ReducedResponse:
        """Response and decimation in one."""
        return reduced_response(self.response, self.decimation)

    def fixed(self) -> Array:
        """(r, m) nuisances that do not depend on the gap: the constant, the free motions."""
        return _fixed(self.reduced, self.theta_m.size)

    def traced(self, point: Point) -> Array:
        """(4, n) screw's angle and its derivatives by gap, place and rate."""
        screw = polygon(self.theta_m, point.screw(0.0, self.rate))
        mix_places(screw, point.gap, point.place)
        return screw

    def table(self, point: Point) -> Array:
        """(k, m) residual, derivatives of the response by gap and place, nuisances; not whitened."""
        return self.tabulated(self.traced(point))

    def tabulated(self, screw: Array) -> Array:
        """`table` for a screw's angle with its derivatives (4, n)."""
        moving = self.reduced.respond(screw if self.growth else screw[:BY_RATE])
        late = [self.reduced.velocities(screw[:1])] if self.skew else []
        humming = sines(self.hum, self.position.size)
        residual = (self.position - moving[0])[None]
        return np.concatenate([residual, moving[1:3], self.fixed(), moving[3:], humming, *late])

    def prepared(self, noise: Autoregression, rows: Array, first: int) -> Array:
        """(k, m + e) whitened rows and what is known beforehand, as e more samples; nuisances begin at row `first`."""
        known = {} if self.offset is None else {first: self.offset}
        if self.growth is not None:
            known[first + len(self.fixed())] = NuisancePrior(self.growth.mean - self.rate, self.growth.std)
        white = noise.whiten(rows, len(known))
        for sample, (row, prior) in enumerate(known.items(), rows.shape[1]):
            # It says: nuisance times 1 / std equals mean / std, with a deviation of 1, as whitened noise has.
            white[0, sample], white[row, sample] = prior.mean / prior.std, 1.0 / prior.std
        return white

    def coarse(self) -> Misfit:
        """The misfit in white noise, with the fixed nuisances only: for the first search.

        A known constant is subtracted. Were it free, the search would end at a wrong gap, and the noise would be
        estimated from the residual there.
        """
        fixed = self.fixed()
        known = 0.0 if self.offset is None else self.offset.mean * fixed[0]
        basis = _fixed_basis(self.reduced, self.theta_m.size, self.offset is None)
        return Misfit(self.theta_m, self.position - known, basis, self.reduced, rate=self.rate)

    def misfit(self, noise: Autoregression, point: Point, table: Array | None = None) -> Misfit:
        """The misfit in noise of a known kind, its nuisances taken at a point; `table`: that of the point, if known."""
        nuisances = (self.table(point) if table is None else table)[CONSTANT:]
        rows = self.prepared(noise, np.concatenate([self.position[None], nuisances]), 1)
        extra = rows.shape[1] - self.position.size
        basis = orthonormal(rows[1:])
        return Misfit(self.theta_m, rows[0], basis, self.reduced, noise, extra, self.rate)

    def humming(self, noise: Autoregression, table: Array, order: int) -> Reduction:
        """Take sines that are in the residual of a fit, whose table and noise are given, as nuisances.

        `order` is the noise's largest. Sines near the structure's own frequencies stay: they may be its motion.
        """
        fastest = float(np.abs(self.response.poles).max()) * self.response.interval * self.decimation.factor
        rest = self.residual(table, self.prepared(noise, table, CONSTANT))
        return replace(self, hum=(*self.hum, *hum(rest, order, _ABOVE * fastest)))

    def residual(self, table: Array, rows: Array) -> Array:
        """(m,) what nuisances leave of a table's residual in the noise that its `rows` are whitened with."""
        shares = least_squares(rows[CONSTANT:], rows[RESIDUAL]).coefficients
        return np.asarray(table[RESIDUAL] - shares @ table[CONSTANT:])

    def growing(self, noise: Autoregression, table: Array) -> Reduction:
        """Follow the screw at the rate of growth that a point and a noise make likely.

        The rate is linear only as long as no contact comes or goes with it: a motor that holds still in contact holds
        the screw in a constant gap, and not in a growing one.
        """
        if self.growth is None:
            return self
        rows = self.prepared(noise, table, CONSTANT)
        shares = least_squares(rows[GAP:], rows[RESIDUAL]).coefficients[CONSTANT - GAP :]
        most = _MOST_GROWTH * self.growth.std
        return replace(self, rate=min(max(self.rate + float(shares[len(self.fixed())]), -most), most))


@lru_cache(maxsize=32)
def _fixed(model: ReducedResponse, samples: int) -> Array:
    free = model.free(samples)
    return np.concatenate([np.ones((1, free.shape[1])), free])


@lru_cache(maxsize=32)
def _fixed_basis(model: ReducedResponse, samples: int, constant: bool) -> Array:
    return orthonormal(_fixed(model, samples)[0 if constant else 1 :])


def factor_for(model: Response, samples: int) -> int:
    """Choose the decimation: the structure's fastest mode keeps its band, and the window enough samples."""
    rate = 1.0 / model.interval
    fastest = float(np.abs(model.poles).max()) / (2.0 * np.pi)
    return max(1, min(int(rate / (_SAMPLES_PER_PERIOD * fastest)), samples // _FEWEST))
