"""What a cut window says of the gap, at the edge: a score statistic, its spread, and what moved the screw.

The motor's angle goes through the play operator at a gap, the screw's angle through the structure; what the position
has beyond that is regressed on its sensitivity to the gap, db = phi'r / phi'phi. Where the screw began is unknown, and
so are the encoder's offset, the structure's motion from before the window and a delay between the channels: columns
beside it. Of the noise nothing is known but what the window shows: an autoregression of what is left makes it white.
The sensitivity is piecewise constant, so the response to it is a sum of step responses, made once. Where the gap has
moved by more than a little, the same is done once more at the new one.

A window in which the screw is pushed one way only says something of the gap if the encoder's offset is known: other
windows of the same boot have shown it.
"""

from math import inf, isfinite, sqrt
from typing import NamedTuple

from servotwin.edge.novelty.least_squares import Fit, Predictors, burg, dot, fit
from servotwin.edge.novelty.model import Fixed, NoveltyModel, Signal, fixed
from servotwin.edge.novelty.motion import Place, play

_STEPS = 8  # linearisations at most
_PASSES = 2  # fits in the noise that the one before has left
_CLOSE = 2e-3  # rad: nearer than that one more linearisation changes nothing that matters
_STARTS = 0.0, 0.9, -0.9  # places in the gap that are tried until one leads somewhere
_USUAL = 1.5  # times what is usually left is no reason to look elsewhere
_ORDER = 8  # of the autoregression, at most
_ROUNDING = 1e-13  # of the largest motion
_PER_COLUMN = 3  # judged samples, at least


class Offset(NamedTuple):
    """The encoder's: the load's angle less the screw's, rad, as the sensors count them, and its standard deviation."""

    value: float
    std: float


class Score(NamedTuple):
    """What a window says of the gap.

    Attributes
    ----------
    gap, std : float
        rad, with the standard deviation in the window's own noise.
    offset : Offset
        As this window shows it; infinitely uncertain where it does not.
    travel : (float, float)
        rad, how far the screw was pushed forwards and backwards.
    noise : float
        m, root mean square of what the fit leaves of the judged samples.
    """

    gap: float
    std: float
    offset: Offset
    travel: tuple[float, float]
    noise: float


def score(
    theta_m: Signal,
    position: Signal,
    model: NoveltyModel,
    gap: float,
    offset: Offset | None = None,
    usual: float = inf,
) -> Score | None:
    """What a window says of the gap; None: nothing, or it is too short.

    Parameters
    ----------
    theta_m, position : (n,) sequences
        rad and m, at the model's rate.
    model : NoveltyModel
    gap : float
        rad, where to begin.
    offset : Offset, optional
        Known from other windows; None: the window stands alone.
    usual : float
        m: what a fit leaves of a window usually. Where it leaves more, the screw may have begun elsewhere.
    """
    least = _PER_COLUMN * (2 * len(model.modes) + 4)
    if len(theta_m) // model.factor - 3 < least or not all(map(isfinite, (sum(theta_m), sum(position)))):
        return None
    window, gap = _Window.of(theta_m, position, model, offset), max(gap, 0.0)
    best: Score | None = None
    for start in _STARTS:
        found = window.settled(Place(gap, start))
        if found is not None and (best is None or found.noise < best.noise):
            best = found
        if best is not None and best.noise <= _USUAL * usual:
            break
    return best


class _Window(NamedTuple):
    """A window made ready: angle and position from their first samples on, the position as it is judged.

    `level` is what is known of the position's constant less the screw's first angle, m.
    """

    theta_m: list[float]
    position: list[float]
    model: NoveltyModel
    fixed: Fixed
    floor: float
    level: Offset | None
    origin: float

    @classmethod
    def of(cls, theta_m: Signal, position: Signal, model: NoveltyModel, offset: Offset | None) -> "_Window":
        angle, load = ([x - signal[0] for x in signal] for signal in (theta_m, position))
        size = max(max(map(abs, load)), abs(model.static_gain) * max(map(abs, angle)))
        gain, origin = model.static_gain, position[0] - model.static_gain * theta_m[0]
        level = None if offset is None else Offset(gain * offset.value - origin, abs(gain) * offset.std)
        rounding = _ROUNDING * size
        return cls(angle, model.decimated(load), model, fixed(model, len(angle)), rounding * rounding, level, origin)

    def settled(self, place: Place) -> Score | None:
        """Linearise until nothing moves any more, and fit in the noise that the last fit has left."""
        noise, fits = None, 0
        for _ in range(_STEPS):
            columns = self.columns(place)
            if columns is None:
                return None
            moved = place
            while _near(place, moved) and fits <= _PASSES:
                found = columns.fitted(noise)
                noise = burg(found.left, min(_ORDER, len(found.left) // 8), self.floor)
                moved, fits = found.moved(place), fits + 1
            if _near(place, moved):
                return columns.score(found)
            place, fits = moved, min(fits, _PASSES)
        return None

    def columns(self, place: Place) -> "_Columns | None":
        """Everything at a place; None where the screw was not pushed, or one way only and the offset is not known."""
        motion, model = play(self.theta_m, place), self.model
        if len(motion.contacts) < (2 if self.level is None else 1):
            return None
        response = model.decimated(model.respond([x - motion.angle[0] for x in motion.angle]))
        by_start, by_gap = (self.fixed.stepped(steps, model.factor) for steps in (motion.by_start, motion.by_gap))
        rows = [*self.fixed.nuisances, _slopes(response)]
        rows.append([0.5 * place.gap * x for x in by_start])
        rows.append([x + 0.5 * place.place * y for x, y in zip(by_gap, by_start, strict=True)])
        residual = [x - y for x, y in zip(self.position, response, strict=True)]
        return _Columns(self, place, residual, rows, motion.travel(round(model.unseen * model.rate)))


class _Found(NamedTuple):
    """A fit, whether the place was held, and what is left, (m,) m."""

    fit: Fit
    held: bool
    left: list[float]
    spread: float

    @property
    def gap(self) -> float:
        """Change of the gap, rad."""
        return self.fit.coefficients[-1]

    def moved(self, place: Place) -> Place:
        """Where a fit leads."""
        change = 0.0 if self.held else self.fit.coefficients[-2]
        return Place(max(0.0, place.gap + self.gap), min(max(place.place + change, -1.0), 1.0))


class _Columns(NamedTuple):
    """Residual and what it is regressed on: constant, motion from before, delay, place, gap; (m,) each."""

    window: _Window
    place: Place
    residual: list[float]
    rows: list[list[float]]
    travel: tuple[float, float]

    def fitted(self, noise: Predictors | None) -> _Found:
        """In white noise, or in that of an autoregression; a place that would leave the gap is held at its end."""
        white = self.rows if noise is None else [noise.whitened(row) for row in self.rows]
        target = self.residual if noise is None else noise.whitened(self.residual)
        white, target = self.known(white, target, noise is None)
        found = self.found(fit(white, target), held=False)
        beyond = abs(self.place.place) == 1.0 and found.fit.coefficients[-2] * self.place.place > 0.0
        return self.found(fit([*white[:-2], white[-1]], target), held=True) if beyond else found

    def found(self, fitted: Fit, held: bool) -> _Found:
        """With what it leaves of the samples as they are."""
        left = self.residual
        rows = [*self.rows[:-2], self.rows[-1]] if held else self.rows
        for share, row in zip(fitted.coefficients, rows, strict=True):
            left = [x - share * y for x, y in zip(left, row, strict=True)]
        rest = fitted.residual
        return _Found(fitted, held, left, sqrt(dot(rest, rest) / (len(rest) - len(rows))))

    def known(self, rows: list[list[float]], target: list[float], plain: bool) -> tuple[list[list[float]], list[float]]:
        """With what is known of the offset as one more sample."""
        level = self.window.level
        if level is None:
            return rows, target
        weight = 1.0 if plain else 1.0 / level.std
        shares = [1.0, *[0.0] * (len(rows) - 3), *self.by_level]
        told = weight * (level.value + self.window.model.static_gain * self.place.screw)
        return [[*row, weight * share] for row, share in zip(rows, shares, strict=True)], [*target, told]

    @property
    def by_level(self) -> tuple[float, float]:
        """What place and gap take off the constant to give the offset, m: the screw's first angle."""
        gain = self.window.model.static_gain
        return -0.5 * gain * self.place.gap, -0.5 * gain * self.place.place

    def score(self, found: _Found) -> Score | None:
        """What a fit comes to; None: nothing."""
        fitted, gain = found.fit, self.window.model.static_gain
        last = len(fitted.coefficients) - 1
        deviation = found.spread * fitted.deviation({last: 1.0})
        if not isfinite(deviation + found.gap):
            return None
        by_place, by_gap = self.by_level
        weights = {0: 1.0, last: by_gap} if found.held else {0: 1.0, last - 1: by_place, last: by_gap}
        level = sum(weight * fitted.coefficients[k] for k, weight in weights.items()) - gain * self.place.screw
        spread = found.spread * fitted.deviation(weights) / abs(gain)
        offset = Offset((level + self.window.origin) / gain, spread)
        noise = sqrt(dot(found.left, found.left) / len(found.left))
        return Score(self.place.gap + found.gap, deviation, offset, self.travel, noise)


def _near(one: Place, other: Place) -> bool:
    """Whether two places are as good as one to linearise at."""
    return abs(one.gap - other.gap) < _CLOSE and abs(one.screw - other.screw) < _CLOSE


def _slopes(row: list[float]) -> list[float]:
    """Central differences, one-sided at the ends."""
    inner = [0.5 * (after - before) for before, after in zip(row, row[2:], strict=False)]
    return [row[1] - row[0], *inner, row[-1] - row[-2]]
