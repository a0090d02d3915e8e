"""What a cut window says of the gap, at the edge: a score statistic, its spread, and what moved the screw.

The motor's angle goes through the play operator at a gap, the screw's angle through the structure; what the position
has beyond that is regressed on its sensitivity to the gap, db = phi'r / phi'phi. Where the screw began is unknown, and
so are the encoder's offset, the structure's motion from before the window and a delay between the channels: columns
beside it. Of the noise nothing is known but what the window shows: an autoregression of what is left makes it white.
The sensitivity is piecewise constant, so the response to it is a sum of step responses, made once. Where the gap has
moved by more than a little, the same is done once more at the new one.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import isfinite, sqrt
from typing import NamedTuple

from servotwin.edge.noveltyalgebra import Predictors, burg, dot, fit
from servotwin.edge.noveltymodel import Fixed, NoveltyModel, Signal, fixed

_STEPS = 5  # linearisations at most
_CLOSE = 2e-3  # rad, or a hundredth of the gap: nearer than that one more linearisation changes nothing that matters
_STARTS = 0.0, 0.9, -0.9  # where in the gap the screw may have begun, tried until one leads somewhere
_ORDER = 8  # of the autoregression, at most
_PASSES = 2  # fits in the noise that the one before has left
_ROUNDING = 1e-13  # of the largest motion
_LEAST = 24  # judged samples


class Place(NamedTuple):
    """A total gap and the screw's angle at the first sample, rad from the motor's there."""

    gap: float
    screw: float


class Motion(NamedTuple):
    """The screw behind a gap.

    Attributes
    ----------
    angle : list of float
        (n,) rad.
    contacts : list of (int, int)
        First sample and side (1 forwards, -1 backwards) of each contact on another side than the last.
    """

    angle: list[float]
    contacts: list[tuple[int, int]]


class Score(NamedTuple):
    """What a window says of the gap.

    Attributes
    ----------
    gap, std : float
        rad, with the standard deviation in the window's own noise.
    screw : float
        rad from the motor, at the first sample.
    travel : float
        rad, how far the screw was pushed, the way in which it was pushed less.
    noise : float
        m, root mean square of what the fit leaves of the judged samples.
    """

    gap: float
    std: float
    screw: float
    travel: float
    noise: float


def play(theta_m: Signal, place: Place) -> Motion:
    """The screw's angle (n,) rad for the motor's (n,), the first of which is 0."""
    half = 0.5 * place.gap
    screw, side = place.screw, 0
    low, high = screw - half, screw + half
    angle: list[float] = []
    contacts: list[tuple[int, int]] = []
    for x in theta_m:
        if x > high:
            high, low, screw = x, x - place.gap, x - half
            if side != 1:
                side = 1
                contacts.append((len(angle), 1))
        elif x < low:
            low, high, screw = x, x + place.gap, x + half
            if side != -1:
                side = -1
                contacts.append((len(angle), -1))
        angle.append(screw)
    return Motion(angle, contacts)


def score(theta_m: Signal, position: Signal, model: NoveltyModel, gap: float) -> Score | None:
    """What a window says of the gap; None: nothing, or it is too short.

    Parameters
    ----------
    theta_m, position : (n,) sequences
        rad and m, at the model's rate.
    model : NoveltyModel
    gap : float
        rad, where to begin.
    """
    if len(theta_m) // model.factor - 3 < _LEAST or not all(map(isfinite, (sum(theta_m), sum(position)))):
        return None
    window, gap = _Window.of(theta_m, position, model), max(gap, 0.0)
    found = (window.settled(Place(gap, start * 0.5 * gap)) for start in _STARTS)
    return next((each for each in found if each is not None), None)


class _Window(NamedTuple):
    """A window made ready: angle and position from their first samples on, the position as it is judged."""

    theta_m: list[float]
    position: list[float]
    model: NoveltyModel
    fixed: Fixed
    floor: float

    @classmethod
    def of(cls, theta_m: Signal, position: Signal, model: NoveltyModel) -> "_Window":
        angle, load = ([x - signal[0] for x in signal] for signal in (theta_m, position))
        size = max(max(map(abs, load)), abs(model.static_gain) * max(map(abs, angle)))
        return cls(angle, model.decimated(load), model, fixed(model, len(angle)), (_ROUNDING * size) ** 2)

    def settled(self, place: Place) -> Score | None:
        """Linearise until nothing moves any more, and fit in the noise that the last fit has left."""
        noise, fits = None, 0
        for _ in range(_STEPS):
            columns = self.columns(place)
            if columns is None:
                return None
            moved = place
            while _near(place, moved) and fits <= _PASSES:
                found = columns.fitted(self.fixed, noise)
                noise = burg(found.left, min(_ORDER, len(found.left) // 8), self.floor)
                moved, fits = self.moved(place, found), fits + 1
            if _near(place, moved):
                return columns.score(place, found)
            place, fits = moved, min(fits, _PASSES)
        return None

    def columns(self, place: Place) -> "_Columns | None":
        """Everything at a place; None where the screw was pushed one way at most."""
        motion, factor = play(self.theta_m, place), self.model.factor
        if len(motion.contacts) < 2:
            return None
        response = self.model.decimated(self.model.respond([x - motion.angle[0] for x in motion.angle]))
        sides = [0, *(side for _, side in motion.contacts)]
        turns = [0.5 * (before - after) for before, after in pairwise(sides)]
        steps = [(sample, turn) for (sample, _), turn in zip(motion.contacts, turns, strict=True)]
        seen = motion.angle[: max(1, len(motion.angle) - round(self.model.unseen * self.model.rate))]
        return _Columns(
            [x - y for x, y in zip(self.position, response, strict=True)],
            _slopes(response),
            self.fixed.stepped([(motion.contacts[0][0], -1.0)], factor),
            self.fixed.stepped(steps, factor),
            _travel(seen),
        )

    def moved(self, place: Place, found: "_Found") -> Place:
        """Where a fit leads; the screw lies within the gap."""
        gap = max(0.0, place.gap + found.gap)
        return Place(gap, min(max(place.screw + found.start, -0.5 * gap), 0.5 * gap))


class _Found(NamedTuple):
    """Changes (rad) of the screw's first angle and of the gap, the latter's deviation, and what is left, (m,) m."""

    start: float
    gap: float
    deviation: float
    left: list[float]


class _Columns(NamedTuple):
    """Residual and what it is regressed on: by a delay, by the screw's first angle, by the gap; (m,) each."""

    residual: list[float]
    by_delay: list[float]
    by_start: list[float]
    by_gap: list[float]
    travel: float

    def fitted(self, known: Fixed, noise: Predictors | None) -> _Found:
        """In white noise, or in that of an autoregression."""
        columns = [*known.nuisances, self.by_delay, self.by_start, self.by_gap]
        white = columns if noise is None else [noise.whitened(column) for column in columns]
        target = self.residual if noise is None else noise.whitened(self.residual)
        coefficients, deviation, rest = fit(white, target)
        left = self.residual
        for share, column in zip(coefficients, columns, strict=True):
            left = [x - share * y for x, y in zip(left, column, strict=True)]
        spread = sqrt(dot(rest, rest) / (len(rest) - len(columns)))
        return _Found(coefficients[-2], coefficients[-1], deviation * spread, left)

    def score(self, place: Place, found: _Found) -> Score | None:
        """What a fit at a place comes to; None: nothing."""
        if not isfinite(found.deviation):
            return None
        noise = sqrt(dot(found.left, found.left) / len(found.left))
        return Score(place.gap + found.gap, found.deviation, place.screw + found.start, self.travel, noise)


def _near(one: Place, other: Place) -> bool:
    """Whether two places are as good as one to linearise at."""
    return abs(one.gap - other.gap) < _CLOSE and abs(one.screw - other.screw) < _CLOSE


def _slopes(row: Sequence[float]) -> list[float]:
    """Central differences, one-sided at the ends."""
    inner = [0.5 * (after - before) for before, after in zip(row, row[2:], strict=False)]
    return [row[1] - row[0], *inner, row[-1] - row[-2]]


def _travel(angle: Sequence[float]) -> float:
    """How far it went up, or down if that is less: half of the whole way, less half of what it ended off."""
    whole = sum(map(abs, map(float.__sub__, angle[1:], angle[:-1])))
    return 0.5 * (whole - abs(angle[-1] - angle[0]))
