"""Candidate models from simple to rich, and their comparison on strokes that they were not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from servotwin.estimation.kinematic.regression import (
    INERTIA,
    LAG,
    OFFSET,
    RATIO,
    WIND_UP,
    Regression,
    interpolated,
    least_gap,
    solved,
    squares_of,
)
from servotwin.plant.signals import Array

_FOLDS = 5
# A richer model must predict unseen strokes better by this many standard errors of the difference.
_EVIDENCE = 2.0
_WORTH = 0.02  # and by this share
_TIMES = 3.0  # shares beyond are said as multiples


class Model(NamedTuple):
    """A model of the load's position.

    Attributes
    ----------
    name : str
    used : tuple of str
        Columns of the regression.
    """

    name: str
    used: tuple[str, ...]

    def places(self, design: Regression) -> list[int]:
        """Places of its columns."""
        return [design.names.index(name) for name in self.used]


def models(design: Regression) -> tuple[Model, ...]:
    """From simple to rich, as far as the design has the columns."""
    cyclic = tuple(name for name in design.names if name.startswith("cycle"))
    parts = [((), "rigid"), ((LAG,), "lag")]
    if WIND_UP in design.names:
        parts += [((WIND_UP,), "wind-up"), ((LAG, WIND_UP), "lag and wind-up")]
    else:
        parts += [((LAG, INERTIA), "lag and wind-up by acceleration")]
    found = [Model(name, (RATIO, OFFSET, *extra)) for extra, name in parts]
    if cyclic:
        found += [Model(f"{each.name}, cyclic error", (*each.used, *cyclic)) for each in found]
    return tuple(found)


class ModelScore(NamedTuple):
    """Errors of a model on strokes that it was not fitted to.

    Attributes
    ----------
    model : Model
    gap : float
        The motor's unit, fitted to all strokes.
    squares : (f,) array
        Mean square error on each left-out group.
    rms : float
        Root mean square over all groups, the load's unit.
    """

    model: Model
    gap: float
    squares: Array
    rms: float


def compared(design: Regression, grid: Array, tensor: Array, counts: Array) -> tuple[ModelScore, ...]:
    """Compare all models, and the best without a gap, out of sample.

    Parameters
    ----------
    grid : (g,) array
        Gaps; the first is 0.
    tensor : (g, m, p, p) array
        Sums of products by stroke.
    counts : (m,) array
        Rows of each stroke.
    """
    folds = np.array_split(np.arange(tensor.shape[1]), min(_FOLDS, tensor.shape[1]))
    result = []
    for model in models(design):
        places = model.places(design)
        result.append(_comparison(model, places, grid, tensor, counts, folds))
    bare = [
        _comparison(
            Model(f"no gap, {each.model.name}", each.model.used),
            each.model.places(design),
            grid[:1],
            tensor[:1],
            counts,
            folds,
        )
        for each in result
    ]
    return (*result, min(bare, key=lambda each: each.rms))


def _comparison(
    model: Model, places: Sequence[int], grid: Array, tensor: Array, counts: Array, folds: Sequence[Any]
) -> ModelScore:
    total = tensor.sum(axis=1)
    squares, sizes = [], []
    for fold in folds:
        left = tensor[:, fold].sum(axis=1)
        fit = solved(total - left, places)
        unseen = squares_of(left, places, fit.coefficients)
        squares.append(max(interpolated(grid, unseen, float(least_gap(grid, fit.squares))), 0.0))
        sizes.append(counts[fold].sum())
    gap = float(least_gap(grid, solved(total, places).squares))
    rms = float(np.sqrt(np.sum(squares) / max(np.sum(sizes), 1)))
    return ModelScore(model, gap, np.array(squares) / np.maximum(sizes, 1), rms)


def chosen(comparisons: Sequence[ModelScore]) -> ModelScore:
    """The simplest model that no richer one beats by two standard errors."""
    best = comparisons[0]
    for each in comparisons[1:]:
        if _gain(best, each).enough:
            best = each
    return best


def undecided(best: ModelScore, comparisons: Sequence[ModelScore]) -> tuple[ModelScore, ...]:
    """The models that contain the chosen one and would be chosen if the log were longer."""
    wider = [each for each in comparisons if set(best.model.used) < set(each.model.used)]
    return tuple(each for each in wider if 1.0 - _gain(best, each).share > _WORTH)


class _Gain(NamedTuple):
    """Mean square error of a model over that of a simpler one, and standard errors by which it is less."""

    share: float
    errors: float

    @property
    def enough(self) -> bool:
        return self.errors > _EVIDENCE and 1.0 - self.share > _WORTH

    def said(self, before: ModelScore) -> str:
        """In words."""
        less = f"{100.0 * self.share:.3g} % of" if self.share < _TIMES else f"{self.share:.3g} times"
        sense = "better" if self.errors >= 0.0 else "worse"
        return f"{less} the square error of {before.model.name} ({abs(self.errors):.1f} standard errors {sense})"


def _gain(before: ModelScore, after: ModelScore) -> _Gain:
    gain = before.squares - after.squares
    error = float(gain.std(ddof=1)) / np.sqrt(gain.size) if gain.size > 1 else np.inf
    least = np.finfo(float).tiny
    return _Gain(
        float(after.squares.mean() / max(before.squares.mean(), least)), float(gain.mean() / max(error, least))
    )


class ModelTrial(NamedTuple):
    """A model that was tried, and what speaks for it or against it.

    Attributes
    ----------
    name : str
    gap : float
        Lost motion that it finds, the motor's unit; NaN for none.
    rms : float
        Error on unseen strokes, the load's unit; NaN where it was judged otherwise.
    evidence : str
    """

    name: str
    gap: float
    rms: float
    evidence: str


def trials(comparisons: Sequence[ModelScore]) -> tuple[ModelTrial, ...]:
    """Say of each model of `compared` why `chosen` took it or did not; the last one has no gap."""
    if not comparisons:
        return ()
    best, said = comparisons[0], ["the simplest"]
    for each in comparisons[1:-1]:
        gain = _gain(best, each)
        said.append(f"{'taken' if gain.enough else 'not taken'}: {gain.said(best)}")
        best = each if gain.enough else best
    without = comparisons[-1]
    needed = best.rms < without.rms
    said.append(f"{'a gap is needed' if needed else 'no gap is needed'}; with one {_gain(without, best).said(without)}")
    return tuple(
        ModelTrial(each.model.name, each.gap, each.rms, words) for each, words in zip(comparisons, said, strict=True)
    )
