"""Estimating the gap: one entry, several methods."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from servotwin.errors import InvalidInput
from servotwin.estimation import paper, whitened
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.window import MINIMUM_SAMPLES, Window
from servotwin.plant.servo import Servo


class Method(NamedTuple):
    """An estimator, and the class of its settings."""

    estimate: Callable[..., GapEstimate]
    settings: type


METHODS: Mapping[str, Method] = {
    whitened.METHOD: Method(whitened.estimate, whitened.WhitenedSettings),
    paper.METHOD: Method(paper.estimate, paper.PaperSettings),
}


def estimate_gap(
    window: Window,
    servo: Servo,
    method: str = whitened.METHOD,
    prior: float | GapEstimate | None = None,
    settings: Any = None,
) -> GapEstimate:
    """The total gap that a window of measurements shows, with its spread, and whether it may be believed.

    Parameters
    ----------
    window : Window
    servo : Servo
        The model; its controller does not matter.
    method : str
        "whitened", the default (`servotwin.estimation.whitened`), or "paper", the published one
        (`servotwin.estimation.paper`).
    prior : float or GapEstimate, optional
        What was known before, rad, total gap; an estimate that is not OK counts as nothing. The search starts there,
        among other places; "whitened" also gives it back when the window says nothing.
    settings : optional
        The method's own `Settings`.

    Raises
    ------
    InvalidInput
        An unknown method, a prior that is not a gap, settings of another method, a window that lacks a channel or
        is too short.
    """
    chosen = settings_of(method, settings)
    known = _believed(prior)
    if method == paper.METHOD and isinstance(known, GapEstimate):
        known = known.gap
    return METHODS[method].estimate(window, servo, known, chosen)


def settings_of(method: str, settings: Any = None) -> Any:
    """The settings, or the method's own where they are None.

    Raises
    ------
    InvalidInput
        An unknown method, settings of another method.
    """
    if method not in METHODS:
        raise InvalidInput(f"method {method!r} does not exist: allowed are {', '.join(METHODS)}")
    kind = METHODS[method].settings
    if settings is not None and not isinstance(settings, kind):
        wanted = f"{kind.__module__.removeprefix('servotwin.')}.{kind.__name__}"
        raise InvalidInput(f"settings {settings!r} do not belong to method {method!r}: give {wanted}")
    return kind() if settings is None else settings


def shortest_window(method: str, sample_rate: float, settings: Any = None) -> tuple[float, str]:
    """The shortest window (s) that a method accepts at a sample rate (Hz), and why, in words."""
    chosen = settings_of(method, settings)
    if isinstance(chosen, paper.PaperSettings):
        settle = chosen.settle_s
        return settle + MINIMUM_SAMPLES / sample_rate, f"the observer, which takes {settle!r} s to settle"
    return whitened.SHORTEST / sample_rate, f"method {method!r}, which needs {whitened.SHORTEST} samples"


def _believed(prior: float | GapEstimate | None) -> float | GapEstimate | None:
    """The prior, if it is one."""
    if isinstance(prior, GapEstimate):
        return prior if prior.ok else None
    if prior is not None and not (math.isfinite(prior) and prior >= 0.0):
        raise InvalidInput(f"prior = {prior!r} rad: must be a finite total gap of at least 0")
    return prior
