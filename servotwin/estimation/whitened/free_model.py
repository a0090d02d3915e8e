"""Fit of gap, place and the model's own numbers to a whitened window, and the hypothesis of a single contact.

A machine is never quite its model. Its stiffness and damping over the masses, its pitch and its mass ratio are free
here, within what is known of them beforehand, beside the gap and the screw's place in it; a compliance of the screw may
be a nuisance. The model's factors enter nonlinearly and are iterated (Levenberg-Marquardt), unlike the tangents of
`gate.model_shift`.

The same fit with a gap that is too wide for the motor to cross says how well one contact alone explains the window. A
fit of two contacts may bend a wrong model into any gap: two are believed only where one explains significantly less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.estimation.core.bounded_step import bounded_step
from servotwin.estimation.core.contacts import BY_RATE
from servotwin.estimation.core.least_squares import Flags, least_squares, orthonormal, project_out
from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.estimate import MachineReading
from servotwin.estimation.whitened.nearby import nearby, own_softness
from servotwin.estimation.whitened.reduction import CONSTANT, GAP, RESIDUAL, Misfit, Point, Reduction
from servotwin.estimation.whitened.search import PLACES
from servotwin.estimation.whitened.sensor_errors import cyclic_motions, lag_motion
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

FACTORS = ("k/m", "c/m", "pitch", "mass ratio")
PITCH = FACTORS.index("pitch")
FREEDOM = (0.1, 0.5, 0.05, 0.1)  # relative standard deviations of the factors where nothing else is known of them
LARGEST = 4.0  # standard deviations by which a factor may move
COMPLIANCE = 0.1  # usual size of that ratio where nothing is known of it
SCREW_SPREAD = 0.2  # relative, of an elastic screw's stiffness: shaft, nut and bearings in series are known roughly
CYCLIC = 2e-3 * math.pi  # rad, usual size of an error once per turn: a thousandth of a turn
_WIDE = (0.01, 0.05, 0.005, 0.02)  # relative spreads of the factors: within these, the motion is linear in them
_FIRST_DAMPING, _FIRST_LINEAR, _LARGEST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-6, 1e8, 1e-9
_EVALUATIONS = 12  # of a fit
_GAIN = 1e-6  # of the residual's variance, promised by a step: a thousandth of one standard deviation of anything
_VAIN = 1e-3  # the same, of a step that led up: what is left then is rounding, and edges of single samples
_SINGULAR = 1e-10  # of a column's length
_ANY = (0.0, math.inf, math.inf)


@dataclass(frozen=True, eq=False)
class FactorPrior:
    """Prior knowledge of the logarithms of `FACTORS`, the machine's numbers over the model's.

    Attributes
    ----------
    mean : (4,) array
    covariance : (4, 4) array
    softness : (float, float)
        As of `MachineReading`.
    """

    mean: Array
    covariance: Array
    softness: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of_spreads(cls, k: float, c: float, pitch: float, ratio: float = 0.03) -> FactorPrior:
        """Make a prior of independent factors about 1, with relative standard deviations."""
        return cls(np.zeros(4), np.diag(np.square([k, c, pitch, ratio])))

    @classmethod
    def of_reading(cls, numbers: MachineReading) -> FactorPrior:
        """Make a prior of plain numbers, bit for bit."""
        covariance = np.array(numbers.covariance).reshape(len(numbers.factors), -1)
        return cls(np.array(numbers.factors), covariance, numbers.softness)

    def with_pitch(self, mean: float, std: float) -> FactorPrior:
        """The same with other knowledge of the pitch alone, of its logarithm."""
        means, covariance = self.mean.copy(), self.covariance.copy()
        covariance[PITCH], covariance[:, PITCH] = 0.0, 0.0
        means[PITCH], covariance[PITCH, PITCH] = mean, std**2
        return replace(self, mean=means, covariance=covariance)

    @property
    def pitch(self) -> tuple[float, float]:
        """Mean and standard deviation of the pitch's logarithm."""
        return float(self.mean[PITCH]), math.sqrt(self.covariance[PITCH, PITCH])

    @property
    def reading(self) -> MachineReading:
        """The same as plain numbers."""
        return MachineReading(tuple(self.mean.tolist()), tuple(self.covariance.ravel().tolist()), self.softness)

    @cached_property
    def root(self) -> Array:
        """(4, 4) whitening matrix: root (factors - mean) has unit covariance."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))

    @property
    def wide(self) -> bool:
        """True where some factor is known so roughly that the motion is not linear in it."""
        return bool(np.any(np.sqrt(np.diag(self.covariance)) > _WIDE))

    def limits(self) -> tuple[Array, Array]:
        """(4,) least and largest factors that are searched."""
        reach = LARGEST * np.sqrt(np.diag(self.covariance))
        return self.mean - reach, self.mean + reach


@dataclass(frozen=True, eq=False)
class FreeFit:
    """A minimum with a free model.

    Attributes
    ----------
    point : Point
    factors : (4,) array
        Logarithms of `FACTORS` over the model's.
    cost : float
        Squared length of the whitened residual, prior included.
    rows : (6, M) array
        Derivatives of the motion by gap (rad), place and factors, nuisances out.
    movable : (6,) array of bool
        Those that were free.
    evaluations : int
    floor : float
        Cost to which the linearised problem came down where it was last asked; 0: nowhere.
    """

    point: Point
    factors: Array
    cost: float
    rows: Array
    movable: Flags
    evaluations: int
    floor: float = 0.0

    @cached_property
    def covariance(self) -> Array:
        """(6, 6) of gap (rad), place and factors, for a residual of variance 1; inf on the diagonal: not known."""
        return _covariance(self.rows, self.movable)

    def learnt(self, prior: FactorPrior, variance: float) -> Array:
        """(4, 4) covariance of the factors for a residual of a variance, that of the gap's and place's whole freedom.

        The prior, which is part of `rows`, has its own variance: a window that shows nothing must leave it as it was.
        """
        own = math.sqrt(max(0.0, 1.0 - 1.0 / variance)) * prior.root.T
        left = project_out(orthonormal(self.rows[:2]), self.rows[2:]) / math.sqrt(variance)
        return np.asarray(np.linalg.inv(left @ left.T + own @ own.T))


def adapted(servo: Servo, factors: Array) -> Servo:
    """Return the servo with other logarithms of `FACTORS`.

    The mass ratio is that of the last mass to the others. With two masses, the first of which moves with the screw,
    there is none.
    """
    k, c, p, ratio = (math.exp(value) for value in factors)
    masses = servo.masses.copy()
    masses[-1] *= ratio if servo.n > 2 else 1.0
    return servo.replace(m=tuple(masses), k=tuple(k * servo.stiffnesses), c=tuple(c * servo.dampings), p=p * servo.p)


@dataclass(frozen=True, eq=False)
class FreeProblem:
    """A window in known noise as a function of gap, place and factors.

    Attributes
    ----------
    reduction : Reduction
        Of the window, with any model's response.
    noise : Autoregression
    servo : Servo
        To which the factors refer.
    prior : FactorPrior
    largest : float
        rad, of the gap.
    compliance : float
        Usual size of the structure's stiffness over the screw's, a nuisance; 0: the screw is as stiff as the model's.
    delay : float
        s, by which the position is late: how much a sensor may lag, a nuisance too; 0: no sensor lags.
    cyclic : float
        Usual size (rad) of a sensor's error once per turn, a nuisance too; 0: none.
    ramp : float
        Usual size (rad/s) of a ramp of the gap beyond the growth that is assumed, a nuisance too; 0: none.
    """

    reduction: Reduction
    noise: Autoregression
    servo: Servo
    prior: FactorPrior
    largest: float
    compliance: float = 0.0
    delay: float = 0.0
    cyclic: float = 0.0
    ramp: float = 0.0

    def rows(self, q: Array, keep: bool = False) -> tuple[Array, Array]:
        """Residual (M,) and derivatives of the motion (6, M) at a point (6,), nuisances out, prior appended.

        With `keep` compliance, lag, cyclic errors (4) and ramp, as far as they are free and in units of their usual
        sizes, are the last derivatives and not nuisances.
        """
        point, factors = Point(q[0], q[1]), q[2:]
        rate, soft = 1.0 / self.reduction.response.interval, self.compliance > 0.0
        near = nearby(self.servo, tuple(factors.tolist()), rate, self.reduction.decimation, soft)
        reduction = replace(self.reduction, response=near.model.response)
        screw = reduction.traced(point)
        table = reduction.tabulated(screw)
        rows = reduction.prepared(self.noise, table, CONSTANT)
        weights = least_squares(rows[CONSTANT:], rows[RESIDUAL]).coefficients
        answer = reduction.position - table[RESIDUAL]
        motions = near.motions(screw[:1], answer, weights[1 : len(reduction.fixed())])
        motions[factors.size :] *= self.compliance
        motions = np.concatenate([motions, *self._by_sensors(reduction, point, screw)])
        root, seen, known, count = self.prior.root, rows.shape[1], factors.size, len(motions)
        # One more sample each for what is known of the motions' sizes.
        white, more = self.noise.whiten(motions, seen - answer.size + count), np.zeros((len(rows), count))
        white[:known, seen : seen + known] = root.T
        white[known:, seen + known :] = np.eye(count - known)
        more[RESIDUAL, :known] = root @ (self.prior.mean - factors)
        whole = np.hstack([rows, more])
        wanted = count if keep else known
        basis = orthonormal(np.concatenate([whole[CONSTANT:], white[wanted:]]))
        remainder = project_out(basis, np.concatenate([whole[:CONSTANT], white[:wanted]]))
        return remainder[RESIDUAL], remainder[GAP:]

    def _by_sensors(self, reduction: Reduction, point: Point, screw: Array) -> list[Array]:
        """(1 or 4, m) motions by lag, cyclic errors and ramp, as far as these are free."""
        free = []
        if self.delay != 0.0:
            free.append(lag_motion(reduction, point, screw, self.delay)[None])
        if self.cyclic > 0.0:
            free.append(self.cyclic * cyclic_motions(reduction, point))
        if self.ramp > 0.0:
            free.append(self.ramp * reduction.response.interval * reduction.reduced.respond(screw[BY_RATE:]))
        return free

    def descend(
        self,
        start: Array,
        free: tuple[bool, bool],
        within: tuple[float, float, float] = _ANY,
        evaluations: int = _EVALUATIONS,
        gain: float = _GAIN,
    ) -> FreeFit:
        """Descend from a start (6,) with at most so many evaluations; of gap and place only what is `free` moves.

        It ends where a step promises less than the part `gain` of the residual's variance, or little and leads up.
        It ends early once the cost is below the first number of `within`, once the linearised problem stays above the
        second by more than it is below the cost, or once it stays above the third: its value is then not that of the
        minimum, but on the same side of these.
        """
        lowest, highest = self.prior.limits()
        low, high = np.concatenate([[0.0, -1.0], lowest]), np.concatenate([[self.largest, 1.0], highest])
        movable, (enough, most, hopeless) = np.array([*free, *(True for _ in FACTORS)]), within
        q, damping = np.clip(start, low, high), _FIRST_DAMPING if self.prior.wide else _FIRST_LINEAR
        residual, rows = self.rows(q)
        cost, count, floor = float(residual @ residual), 1, 0.0
        while count < evaluations and damping < _LARGEST_DAMPING and cost > enough:
            if most < math.inf:
                floor = _linear_floor(residual, rows, movable)
                if floor > hopeless or floor - most > cost - floor:
                    break
            step, promised = bounded_step(residual, rows, movable, q, low, high, damping)
            variance = cost / residual.size
            if promised <= gain * variance:
                break
            ahead, slopes = self.rows(q + step)
            after, count = float(ahead @ ahead), count + 1
            if after < cost:
                q, residual, rows, cost, damping = q + step, ahead, slopes, after, max(0.1 * damping, _LEAST_DAMPING)
            elif promised <= _VAIN * variance:
                break
            else:
                damping *= 10.0
        return FreeFit(Point(float(q[0]), float(q[1])), q[2:], cost, rows, movable, count, floor)


def other_screws(problem: FreeProblem, start: Array, free: tuple[bool, bool], gain: float = _GAIN) -> list[FreeFit]:
    """Fits from a start (6,) with an elastic screw as soft, and as stiff, as it may be; none with a rigid one."""
    servo, fits = problem.servo, []
    for share in () if servo.rigid else (1.0 / (1.0 + SCREW_SPREAD), 1.0 + SCREW_SPREAD):
        here = start.copy()
        # The structure is held at its other end too: a soft screw takes its share of the travel.
        here[2 + PITCH] += (1.0 / share - 1.0) * own_softness(servo)
        fits.append(replace(problem, servo=servo.replace(k_d=share * servo.k_d)).descend(here, free, gain=gain))
    return fits


def _linear_floor(residual: Array, rows: Array, movable: Array) -> float:
    """Squared length of what is left of a residual where all derivatives may have any share of it."""
    remainder = project_out(orthonormal(rows[movable]), residual[None])[0]
    return float(remainder @ remainder)


@dataclass(frozen=True)
class ContactEvidence:
    """Rise of the cost where only one contact is allowed, over the variance of the noise; model free in both.

    Attributes
    ----------
    rise : float
        At least, where it is far above what is `BELIEVED`.
    single : FreeFit
        The fit of one contact.
    variance : float
        Of the residual of two contacts in units of the noise, at least 1.
    """

    rise: float
    single: FreeFit
    variance: float

    @property
    def two(self) -> bool:
        """True where two contacts are believed."""
        return self.rise >= BELIEVED


# The square of the contacts' least travel over the largest accepted standard deviation is above that: a second contact
# that is worth less could not have made an acceptable estimate.
BELIEVED = 100.0
_ENOUGH, HOPELESS = 0.3, 30.0  # times that: clearly too little; so much that no start has come back from there
_STARTS = 3
# Of 167 windows whose best start is so far off, no other start's linearised problem came below 0.41 of the best's.
_OUT_OF_REACH = 10.0 * HOPELESS


def contact_evidence(problem: FreeProblem, misfit: Misfit, two: Point) -> ContactEvidence:
    """Compare the fit of a window that has two contacts with the best one of a single contact, both with a free model.

    Parameters
    ----------
    problem : FreeProblem
        In the noise of the fit of two contacts: where one contact is the truth, both fits leave this noise.
    misfit : Misfit
        In the same noise with the model fixed, for the starts.
    two : Point
        The fit of two contacts.
    """
    mean = problem.prior.mean
    # One evaluation: the fit is a minimum already, and a little too high a cost only makes the second contact weaker.
    believed = problem.descend(np.array([*two, *mean]), (True, True), evaluations=1)
    variance = max(1.0, believed.cost / max(1, misfit.position.size))
    wide, allowed = problem.largest, BELIEVED * variance
    places = tuple(dict.fromkeys((*same_way(two, wide), *PLACES)))
    order = np.argsort(misfit.costs([Point(wide, place) for place in places]), kind="stable")
    out_of_reach = believed.cost + _OUT_OF_REACH * allowed
    within = believed.cost + _ENOUGH * allowed, believed.cost + allowed, believed.cost + HOPELESS * allowed
    fits = []
    for index in order[:_STARTS]:
        start = np.array([wide, places[index], *believed.factors])
        fits.append(problem.descend(start, (False, True), within))
        if fits[-1].cost <= within[0] or fits[-1].floor > out_of_reach:
            break
    best = min(fits, key=lambda one: one.cost)
    return ContactEvidence((best.cost - believed.cost) / variance, best, variance)


def same_way(point: Point, gap: float) -> tuple[float, float, float]:
    """Places in another gap (rad) at a point's place, and as far from the contact ahead, and from the one behind.

    A window of one contact is explained by any gap from whose other side the motor stays away, the way to this contact
    being the same.
    """
    if gap == 0.0:
        return (point.place,) * 3
    share = point.gap / gap
    ahead, behind = share * (1.0 + point.place) - 1.0, 1.0 - share * (1.0 - point.place)
    return point.place, min(max(ahead, -1.0), 1.0), min(max(behind, -1.0), 1.0)


def _covariance(rows: Array, movable: Flags) -> Array:
    size = np.linalg.norm(rows, axis=1)
    use = np.flatnonzero(movable & (size > 0.0))
    covariance = np.zeros((rows.shape[0], rows.shape[0]))
    np.fill_diagonal(covariance, np.where(movable, math.inf, 0.0))
    scaled = rows[use] / size[use, None]
    values, vectors = np.linalg.eigh(scaled @ scaled.T)
    good = values > _SINGULAR * values[-1]
    if np.all(good):
        inverse = (vectors / values) @ vectors.T / np.outer(size[use], size[use])
        covariance[np.ix_(use, use)] = inverse
    return covariance
