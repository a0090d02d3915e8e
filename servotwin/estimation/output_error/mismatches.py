"""Mismatches of a window and its fit: motion left over, numbers of the model far off, halves that differ."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servotwin.estimation.output_error.fit import Search, descend
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.rounding import all_rounding, influence, moved_by, rounded
from servotwin.estimation.output_error.search import LEFT_COUNTS, rms
from servotwin.estimation.output_error.unexplained import slow
from servotwin.plant.signals import Array

_UNUSUAL = 3.3  # standard deviations of one of the model's numbers beforehand
_HELD_STEPS = 40  # of a fit
APART = 4.0  # standard deviations between the halves of a window
UNEXPLAINED = 0.05  # of the position's variation, or of half the gap where there are no dynamics
_OUTLYING = 7.0  # standard deviations
# The noise's spectrum, the model's numbers and the contacts come from the same window: tails are longer than normal.
DOUBT = 2.0  # interval over the computed one
_EVENLY = 1.0 / math.sqrt(12.0)  # standard deviation of a place anywhere in an interval, of its length
_ROUNDED = 1.0  # of a count: standard deviation of an error that does not average out
_DIFFERENCE = 1e-6  # of the way between motor and load, that makes a derivative


def mismatches(found: Search, likely: Array, rate: float, least: float) -> tuple[str, ...]:
    """List the signs that the model is not that of the machine; a `least` error (m or rad at the load) is none.

    `likely` (u,) are the unknowns as the window makes them likely: errors of rounding bend those of the best fit.
    """
    best, problem = found.best, found.problem
    sentences = []
    left = _left(found)
    if (share := _share(found)) > UNEXPLAINED and not all_rounding(found):
        sentences.append(f"the model leaves {100.0 * share:.0f} % of the position's motion unexplained")
    elif problem.model.speed == 0.0 and left > max(UNEXPLAINED * best.values[HALF], problem.count):
        sentences.append(
            f"the model leaves motion of {100.0 * left / best.values[HALF]:.0f} % of half the gap unexplained"
        )
    sentences += unusual_numbers(found, likely, shown=True, rate=rate)
    sentences += _outliers(found, least)
    sentences += differing_halves(found, rate)
    return tuple(sentences)


def too_small(found: Search) -> str:
    """Sentence for a motion of so few counts that they hide whether the model explains it; empty: it is larger."""
    if (share := _share(found)) <= UNEXPLAINED or not all_rounding(found):
        return ""
    counts = float(np.ptp(found.problem.position)) / found.problem.count
    return (
        f"the position moves by only {counts:.2g} counts of the coarser encoder, whose rounding may be all that the "
        f"model leaves ({100.0 * share:.0f} % of the motion): larger moves are needed"
    )


def _left(found: Search) -> float:
    """rms (m or rad at the load) of the slow motion that the best fit leaves."""
    raw = found.best.raw
    return slow(raw, max(1, raw.size // 100))


def _share(found: Search) -> float:
    """The same, of the position's variation."""
    variation = float(np.std(found.problem.position))
    return _left(found) / variation if variation > 0.0 else math.inf


def unusual_numbers(found: Search, likely: Array, shown: bool = False, rate: float = 0.0) -> tuple[str, ...]:
    """List the unknowns (u,), as they are `likely`, that would have to be far off what is known of them.

    Rounding may have moved them: a motor that touches softly, within few counts of its encoder, looks soft and late. So
    may a gap that grows at a `rate` (1/s, of the half gap).
    With `shown` only those count, of them at whose limit the search ended, that the window shows to be off.
    """
    problem, sentences = found.problem, list[str]()
    limits = problem.limits()
    for i, unknown in enumerate(problem.model.unknowns):
        size = abs(float(likely[i]))
        known = math.isfinite(unknown.std) and unknown.unit != "damping"
        far = known and (size > _UNUSUAL * unknown.std or size >= limits[i])
        at_limit = bool(size >= limits[i])
        if (
            far
            and not _errors_explain(found, i, size, at_limit, rate)
            and not (shown and at_limit and hidden(found, i))
        ):
            late = unknown.unit == "time"
            change = f"{1e3 * likely[i]:+.3g} ms" if late else f"{100.0 * math.expm1(likely[i]):+.2g} %"
            sentences.append(f"the {unknown.name} would be off by {change}")
    return tuple(sentences)


def _errors_explain(found: Search, which: int, size: float, at_limit: bool, rate: float) -> bool:
    """Tell whether an unknown may be off by a size because of rounding and of a growing gap: by these alone where the
    search ended at its limit."""
    (grown,), known = moved_by_growth(found, rate, [which]), found.problem.model.unknowns[which].std
    errors = math.hypot(rounded(found, which), grown)
    return size <= _UNUSUAL * (errors if at_limit else math.hypot(errors, known))


def hidden(found: Search, which: int) -> bool:
    """Tell whether rounding may hide what an unknown is.

    Errors of rounding follow the motion, and a noise that was learnt of them speaks for an unknown that follows them:
    held at what is known of it, the model may leave no more than rounding.
    """
    problem, rate = found.problem, found.problem.model.slowing[-1] * found.problem.model.speed
    start, free = found.best.values.copy(), found.free.copy()
    start[which], free[which] = 0.0, False
    held = descend(problem, start, found.noise, free, _HELD_STEPS, rate)
    return rate > 0.0 and rms(held.raw) <= LEFT_COUNTS * problem.count


def differing_halves(found: Search, rate: float) -> tuple[str, ...]:
    """Sentence for a window whose halves differ by more than a growth at a `rate` (1/s, of the half gap) explains."""
    difference, spread = between_halves(found)
    apart = abs(difference) / math.hypot(spread, 0.5 * rate * found.problem.duration)
    return (f"the gaps of the window's halves are {apart:.2g} standard deviations apart",) if apart > APART else ()


def _outliers(found: Search, least: float) -> tuple[str, ...]:
    """Sentence for a motion without dynamics whose model errs in a few places: play errs evenly.

    Errors up to a `least` one (m or rad at the load) count as none.
    """
    raw = found.best.raw
    most, rms = float(np.max(np.abs(raw))), float(np.sqrt(np.mean(raw**2)))
    if found.problem.model.speed > 0.0 or most <= _OUTLYING * max(rms, found.problem.count, least):
        return ()
    return (f"in a few places the model errs by {most / rms:.2g} times as much as in the others",)


def between_halves(found: Search, which: int = HALF) -> tuple[float, float]:
    """Difference of an unknown between the second and the first half of a window, linearised, and its std.

    The standard deviation is inf where a half does not show it.
    """
    data = found.best.raw.size
    prior = np.arange(data, found.best.residual.size)
    parts = np.array_split(np.arange(data), 2)
    (one, *first), (two, *second) = (influence(found, np.concatenate([part, prior]), which) for part in parts)
    return two - one, math.hypot(*first, *second, _ROUNDED * found.problem.count)


def grown(found: Search, rate: float) -> float:
    """Standard deviation of the half gap that its growth makes: the fit's is that of whenever the motor crossed it.

    The growth within the window is as likely as a `rate` (1/s, of the half gap) says, or what the halves of the window
    show of it, whichever is less: the rate may be a mere assumption.
    """
    apart, spread = between_halves(found)
    return _EVENLY * min(rate * found.problem.duration, 2.0 * math.hypot(apart, DOUBT * spread))


def moved_by_growth(found: Search, rate: float, places: Sequence[int]) -> Array:
    """(f,) changes of unknowns at places (f,) by a gap that grows within the window, as likely as in `grown`.

    It touches the flanks a little later each time, as a soft shaft does. Linearised: a contact shows the half gap of
    its time.
    """
    if rate == 0.0:
        return np.zeros(len(places))
    problem, best = found.problem, found.best
    apart, spread = between_halves(found)
    growth = min(rate * problem.duration, 2.0 * math.hypot(apart, DOUBT * spread))
    observer, step = problem.model.slowing[-1] * problem.model.speed, _DIFFERENCE * problem.range
    wider = best.values.copy()
    wider[HALF] += step
    change = (problem.misfit(wider, observer) - best.raw) / step
    change *= growth * np.linspace(-0.5, 0.5, change.size)
    return np.array([moved_by(found, change, place) for place in places])
