"""Estimating the gap: one entry, several methods."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TypeAlias

from servotwin.errors import InvalidInput
from servotwin.identify import paper
from servotwin.identify.estimate import GapEstimate
from servotwin.identify.window import Window
from servotwin.plant.servo import Servo

Method: TypeAlias = Callable[[Window, Servo, float | None, paper.Settings | None], GapEstimate]
METHODS: Mapping[str, Method] = {paper.METHOD: paper.estimate}


def estimate_gap(
    window: Window,
    servo: Servo,
    method: str = paper.METHOD,
    prior: float | GapEstimate | None = None,
    settings: paper.Settings | None = None,
) -> GapEstimate:
    """The total gap that a window of measurements shows, with its spread, and whether it may be believed.

    Parameters
    ----------
    window : Window
    servo : Servo
        The model; its controller does not matter.
    method : str
        "paper", the published one: `servotwin.identify.paper`.
    prior : float or GapEstimate, optional
        What was known before, rad, total gap; an estimate that is not OK counts as nothing.
    settings : Settings, optional
        The method's own.

    Raises
    ------
    InvalidInput
        An unknown method, a prior that is not a gap, settings of another method, a window that lacks a channel or
        is too short.
    """
    if method not in METHODS:
        raise InvalidInput(f"method {method!r} does not exist: allowed are {', '.join(METHODS)}")
    if settings is not None and not isinstance(settings, paper.Settings):
        raise InvalidInput(f"settings {settings!r} do not belong to method {method!r}: give identify.paper.Settings")
    return METHODS[method](window, servo, _gap_of(prior), settings)


def _gap_of(prior: float | GapEstimate | None) -> float | None:
    """The prior as a total gap, rad."""
    if isinstance(prior, GapEstimate):
        return prior.gap if prior.ok else None
    if prior is not None and not (math.isfinite(prior) and prior >= 0.0):
        raise InvalidInput(f"prior = {prior!r} rad: must be a finite total gap of at least 0")
    return prior
