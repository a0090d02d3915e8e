"""Estimate of the gap from one cut window: a score statistic, its spread, and how far the screw was pushed.

The motor's angle goes through the play operator at a gap, the screw's angle through the structure. What the position
has beyond that is regressed on its sensitivity to the gap, db = phi'r / phi'phi. Beside that sensitivity stand columns
for where the screw began, the encoder's offset, the structure's motion from before the window and a delay between the
channels. An autoregression of the residual makes its noise white. Where the gap has moved by more than 2 mrad (ten
counts of a fine encoder), the regression is repeated at the new one.

A window in which the screw is pushed one way only shows the gap if the encoder's offset is known from other windows of
the same boot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, isfinite, pi, sqrt
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import BY_GAP, BY_START, SCREW, Gap, contacts
from servotwin.estimation.core.decimation import Decimation, decimation
from servotwin.estimation.core.least_squares import LeastSquares, independent_least_squares
from servotwin.estimation.core.response import Readout, Response, response
from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.novelty.settings import NoveltyModel, ResponseMode
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

# Judged samples per period of the structure's fastest mode: the load moves no faster, and noise above is left out. With
# 36 the spread is the same and an autoregression of it needs four times the order.
_PER_PERIOD = 9.0
_LINEARISATIONS = 8  # at most
_WHITENED_FITS = 2  # fits in the noise that the one before has left
_CLOSE = 2e-3  # rad: nearer than that one more linearisation changes nothing that matters,
_CLOSE_COUNTS = 10.0  # or so many counts of the encoder, where they are known and less
_LEAST_COUNTS = 4.0  # the least gap to begin at: at none the screw would follow every count of a motor at rest
_STARTS = 0.0, 0.9, -0.9  # places in the gap, tried in turn until a fit converges with a usual residual
_USUAL = 1.5  # times the usual residual: up to this, no other start is tried
_ORDER = 8  # of the autoregression, at most
_ROUNDING = 1e-13  # of the largest motion
_PER_COLUMN = 3  # judged samples, at least
_LARGEST = 1e100  # rad or m: no sensor gives more, and the squares of larger numbers overflow
_BLOCK_S, _PARTS = 0.1, 5  # the servo's own seconds of rest that make one lead; parts of it whose means must agree


class EncoderOffset(NamedTuple):
    """Load's angle less the screw's as the sensors count them, and its standard deviation, rad."""

    value: float
    std: float


class Score(NamedTuple):
    """Estimate of the gap from one window.

    Attributes
    ----------
    gap, std : float
        rad, with the standard deviation in the window's own noise.
    offset : EncoderOffset
        As this window shows it; infinitely uncertain where it does not.
    travel : (float, float)
        rad, how far the screw was pushed forwards and backwards.
    noise : float
        m, root mean square of the residual of the judged samples.
    """

    gap: float
    std: float
    offset: EncoderOffset
    travel: tuple[float, float]
    noise: float


def model_of(servo: Servo, sample_rate: float) -> NoveltyModel:
    """Describe a servo's structure at a sample rate (Hz), as `edge.toml` stores it.

    Raises
    ------
    InvalidInput
        The screw is not rigid: then the load acts back, and its angle is no function of the motor's.
    """
    if not servo.rigid:
        raise InvalidInput(f"servo k_d = {servo.k_d!r} N/m: novelty at the edge needs a rigid screw")
    known = response(servo, sample_rate)
    fastest = float(np.abs(known.poles).max()) / (2.0 * pi)
    modes = tuple(
        ResponseMode(complex(*decay), complex(*gain))
        for decay, gain in zip(known.decay.tolist(), known.position.gain.tolist(), strict=True)
    )
    factor = max(1, round(sample_rate / (_PER_PERIOD * fastest)))
    return NoveltyModel(
        rate=sample_rate,
        modes=modes,
        direct=known.position.direct,
        static_gain=known.static_gain,
        unseen=known.unseen,
        factor=factor,
        second=scales(servo).time,
        encoder_resolution=servo.encoder_resolution,
    )


@lru_cache(maxsize=8)
def response_of(model: NoveltyModel) -> Response:
    """Return the response that a model describes; velocities, which it does not hold, are zero."""
    decay, gain = (np.array([[z.real, z.imag] for z in column]) for column in zip(*model.modes, strict=True))
    poles = model.rate * np.log(np.array([mode.decay for mode in model.modes]))
    position, nothing = Readout(gain, model.direct), Readout(np.zeros_like(gain), 0.0)
    return Response(poles, decay, position, nothing, 1.0 / model.rate, model.static_gain, model.unseen)


@lru_cache(maxsize=8)
def _nuisances(model: NoveltyModel, samples: int) -> Array:
    """(k, m) constant and free motions of the structure, decimated, for windows of so many samples."""
    rows = np.vstack([np.ones(samples), response_of(model).free(samples)])
    return decimation(model.factor).rows(rows)


def score(
    theta_m: Sequence[float] | Array,
    position: Sequence[float] | Array,
    model: NoveltyModel,
    gap: float,
    offset: EncoderOffset | None = None,
    usual: float = inf,
) -> Score | None:
    """Estimate the gap from one window; None: the window does not show it, or is too short.

    Parameters
    ----------
    theta_m, position : (n,) sequences
        rad and m, at the model's rate.
    model : NoveltyModel
    gap : float
        rad, where to begin.
    offset : EncoderOffset, optional
        Known from other windows; None: the window stands alone.
    usual : float
        m, usual residual (rms) of a fit. Where it is larger, the screw may have begun elsewhere.
    """
    angle, load = np.asarray(theta_m, dtype=np.float64), np.asarray(position, dtype=np.float64)
    fewest = _PER_COLUMN * (2 * len(model.modes) + 4)
    if angle.size // model.factor - 3 < fewest:
        return None
    if not max(float(np.abs(angle).max()), float(np.abs(load).max())) < _LARGEST:
        return None
    window, best = _Window.prepared(angle, load, model, offset), None
    for start in _STARTS:
        candidate = window.converged(_Place(max(gap, _LEAST_COUNTS * model.encoder_resolution), start))
        if candidate is not None and (best is None or candidate.noise < best.noise):
            best = candidate
        if best is not None and best.noise <= _USUAL * usual:
            break
    return best


class _Place(NamedTuple):
    """Total gap (rad), and where in it the screw began: -1 behind the motor by half the gap .. 1 ahead of it."""

    gap: float
    place: float

    @property
    def screw(self) -> float:
        """rad from the motor, at the first sample."""
        return 0.5 * self.gap * self.place

    def near(self, other: _Place, close: float) -> bool:
        """Tell whether both are as good to linearise at: gap and screw nearer than `close` (rad)."""
        return abs(self.gap - other.gap) < close and abs(self.screw - other.screw) < close


@dataclass(frozen=True, eq=False)
class _Window:
    """Prepared window: angle and decimated position, counted from their first samples.

    `level` is the known constant of the position less the screw's first angle, m; `floor` the rounding, m.
    """

    theta_m: Array
    position: Array
    model: NoveltyModel
    response: Response
    reduce: Decimation
    floor: float
    level: EncoderOffset | None
    origin: float

    @classmethod
    def prepared(cls, theta_m: Array, position: Array, model: NoveltyModel, offset: EncoderOffset | None) -> _Window:
        angle, load, reduce = theta_m - theta_m[0], position - position[0], decimation(model.factor)
        gain, origin = model.static_gain, float(position[0] - model.static_gain * theta_m[0])
        largest = max(float(np.abs(load).max()), abs(gain) * float(np.abs(angle).max()))
        return cls(
            theta_m=angle,
            position=reduce.rows(load[None])[0],
            model=model,
            response=response_of(model),
            reduce=reduce,
            floor=_ROUNDING * largest,
            level=None if offset is None else EncoderOffset(gain * offset.value - origin, abs(gain) * offset.std),
            origin=origin,
        )

    def converged(self, place: _Place) -> Score | None:
        """Linearise until gap and place converge, and fit in the noise of the last fit's residual."""
        count = self.model.encoder_resolution
        noise, fits, close = None, 0, min(_CLOSE, _CLOSE_COUNTS * count) if count > 0.0 else _CLOSE
        for _ in range(_LINEARISATIONS):
            columns = self.columns(place)
            if columns is None:
                return None
            moved = place
            while place.near(moved, close) and fits <= _WHITENED_FITS:
                fit = columns.fitted(noise)
                noise = burg(fit.residual[None], min(_ORDER, fit.residual.size // 8)).at_least(self.floor)
                moved, fits = fit.moved(place), fits + 1
            if place.near(moved, close):
                return columns.score(fit)
            place, fits = moved, min(fits, _WHITENED_FITS)
        return None

    def columns(self, place: _Place) -> _Columns | None:
        """Linearise at a place; None where the screw was not pushed, or one way only and the offset is not known."""
        followed = contacts(self.theta_m, Gap(place.gap, place.screw))
        pushes = int(np.count_nonzero(np.diff(followed[BY_GAP], prepend=0.0)))
        if pushes < (2 if self.level is None else 1):
            return None
        screw = followed[SCREW]
        # All signals start from zero; the constant and the free motions account for what happened before.
        signals = np.vstack([screw - screw[0], followed[BY_START] - 1.0, followed[BY_GAP]])
        load, by_start, by_gap = self.reduce.rows(self.response.respond(signals))
        late = np.gradient(load)
        by_place, by_gap = 0.5 * place.gap * by_start, by_gap + 0.5 * place.place * by_start
        rows = np.vstack([_nuisances(self.model, screw.size), late, by_place, by_gap])
        moved = np.diff(screw[: max(2, screw.size - round(self.model.unseen * self.model.rate))])
        travel = float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum())
        return _Columns(self, place, self.position - load, rows, travel)


class _Fit(NamedTuple):
    """Least squares, whether the place was fixed, the residual (m,) m, and its standard deviation when white."""

    solved: LeastSquares
    fixed_place: bool
    residual: Array
    spread: float

    @property
    def gap(self) -> float:
        """Change of the gap, rad."""
        return float(self.solved.coefficients[-1])

    def moved(self, place: _Place) -> _Place:
        """Place after the fit's step."""
        change = 0.0 if self.fixed_place else float(self.solved.coefficients[-2])
        return _Place(max(0.0, place.gap + self.gap), min(max(place.place + change, -1.0), 1.0))


class _Columns(NamedTuple):
    """Residual (m,) and the rows (k, m) it is regressed on: constant, free motions, delay, place, gap."""

    window: _Window
    place: _Place
    residual: Array
    rows: Array
    travel: tuple[float, float]

    def fitted(self, noise: Autoregression | None) -> _Fit:
        """Fit in white noise, or in that of an autoregression; a place that would leave the gap stays at its end."""
        table = np.vstack([self.residual, self.rows])
        white = self.with_level(table if noise is None else noise.whiten(table), plain=noise is None)
        fit = self._solved(white, fixed=False)
        beyond = abs(self.place.place) == 1.0 and fit.solved.coefficients[-2] * self.place.place > 0.0
        return self._solved(np.delete(white, -2, axis=0), fixed=True) if beyond else fit

    def _solved(self, white: Array, fixed: bool) -> _Fit:
        solved = independent_least_squares(white[1:], white[0])
        rest = white[0] - solved.coefficients @ white[1:]
        residual = self.residual - solved.coefficients @ (np.delete(self.rows, -2, axis=0) if fixed else self.rows)
        return _Fit(solved, fixed, residual, sqrt(float(rest @ rest) / (rest.size - len(white) + 1)))

    def with_level(self, white: Array, plain: bool) -> Array:
        """Append the known offset to the whitened table as one more sample."""
        level = self.window.level
        if level is None:
            return white
        weight = 1.0 if plain else 1.0 / level.std
        known = weight * (level.value + self.window.model.static_gain * self.place.screw)
        shares = [1.0, *[0.0] * (len(self.rows) - 3), *self.by_level]
        return np.column_stack([white, [known, *(weight * share for share in shares)]])

    @property
    def by_level(self) -> tuple[float, float]:
        """Derivatives of the screw's first angle by place and gap, m: they turn the constant into the offset."""
        gain = self.window.model.static_gain
        return -0.5 * gain * self.place.gap, -0.5 * gain * self.place.place

    def score(self, fit: _Fit) -> Score | None:
        """Turn the last fit into an estimate; None: it does not show the gap."""
        solved, gain = fit.solved, self.window.model.static_gain
        of_gap, of_level = np.zeros(solved.coefficients.size), np.zeros(solved.coefficients.size)
        of_gap[-1] = of_level[0] = 1.0
        by_place, of_level[-1] = self.by_level
        if not fit.fixed_place:
            of_level[-2] = by_place
        std = fit.spread * solved.deviation(of_gap)
        if not isfinite(std + fit.gap):
            return None
        level = float(of_level @ solved.coefficients) - gain * self.place.screw
        offset_std = fit.spread * solved.deviation(of_level) / abs(gain)
        offset = EncoderOffset((level + self.window.origin) / gain, offset_std)
        noise = sqrt(float(fit.residual @ fit.residual) / fit.residual.size)
        return Score(self.place.gap + fit.gap, std, offset, self.travel, noise)


def leads_at_rest(
    theta_m: Sequence[float] | Array, position: Sequence[float] | Array, rate: float, static_gain: float, still: float
) -> list[float]:
    """Leads (rad) of the motor over the load, one for each tenth of the servo's own second in which neither moves.

    At rest the motor's angle less the load's, as an angle of the screw, is where in the gap the screw lies. Its range
    over all rests since the encoder was set is a lower bound of the gap, whatever the dynamics.

    Parameters
    ----------
    theta_m, position : (n,) sequences
        rad, m.
    rate : float
        Samples per second of the servo's own.
    static_gain : float
        m/rad.
    still : float
        rad: a signal that moves by less is at rest. Of the load, the means of fiftieths of a second count.
    """
    angles, loads = np.asarray(theta_m, dtype=np.float64), np.asarray(position, dtype=np.float64)
    size = max(_PARTS, round(_BLOCK_S * rate))
    part, leads = size // _PARTS, []
    for first in range(0, angles.size - size + 1, size):
        angle = angles[first : first + size]
        if float(np.ptp(angle)) >= still:
            continue
        means = loads[first : first + part * _PARTS].reshape(_PARTS, part).mean(axis=1) / static_gain
        if float(np.ptp(means)) < still:
            leads.append(float(angle.mean() - means.mean()))
    return leads
