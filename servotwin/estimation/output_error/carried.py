"""A load that something else than the flanks carries: it follows its motor without the stretch of the shaft.

Friction in the gap (stiff grease, a nut that is tight) takes a light load along, which then need not come near a flank.
The window looks like one without a gap, and delay and dampings of the fit, which are hardly known, make up for the
stretch that is missing: the force that accelerates a load against a flank stretches the shaft by what its inertia over
the stiffness says.
"""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.mismatches import DOUBT
from servotwin.estimation.output_error.models import ShaftModel
from servotwin.estimation.output_error.problem import Problem

# Of the stretch: 30 simulated loads that a flank carries had 0.87 to 1.32, four that friction carries 0.02 to 0.05.
_LEAST = 0.5
_BAND, _HIGHEST = 2.0, 0.2  # corner of the low-pass: times the shaft's frequency, and of the sample rate at most
_ORDER = 4  # of that filter, forth and back
_TURNS = 0.02  # of the largest speed, within which the friction's sign is not known


def carried(found: Search) -> str:
    """Sentence for a single mass whose acceleration shows less than half of the shaft's stretch for sure; or empty."""
    problem = found.problem
    if not isinstance(problem, Problem) or not isinstance(problem.model, ShaftModel) or problem.model.axis.n > 1:
        return ""
    share, std = stretch_share(problem)
    if not share + NORMAL_95 * DOUBT * std < _LEAST:
        return ""
    return (
        f"the load accelerates with {100.0 * max(share, 0.0):.0f} % of the shaft's stretch that its inertia needs: "
        "friction in the gap may carry it, and hides the gap"
    )


def stretch_share(problem: Problem) -> tuple[float, float]:
    """Part of the way between motor and load that goes with the load's acceleration, over that of the stated shaft.

    Returns
    -------
    tuple of float
        The share, and its standard deviation. What goes with place, speed and its sign is ratio, damping, delay and
        friction, and does not count.
    """
    from scipy import signal  # most of a second to import, and few windows come here

    rate, omega = 1.0 / problem.interval, problem.model.speed
    corner = min(_BAND * omega / (2.0 * math.pi), _HIGHEST * rate)
    sections = signal.butter(_ORDER, corner, fs=rate, output="sos")
    ways = np.stack([problem.lead - problem.lead[0], problem.position - problem.position[0]])
    lead, place = signal.sosfiltfilt(sections, ways)
    speed = np.gradient(place, problem.interval)
    acceleration = np.gradient(speed, problem.interval)
    side = np.tanh(speed / (_TURNS * max(float(np.abs(speed).max()), np.finfo(float).tiny)))
    inner = slice(edge := math.ceil(rate / corner), place.size - edge)
    columns = np.column_stack([acceleration / omega**2, speed / omega, place, side, np.ones_like(place)])[inner]
    size = np.linalg.norm(columns, axis=0)
    if not (columns.shape[0] > columns.shape[1] and np.all(size > 0.0)):
        return 0.0, math.inf
    scaled = columns / size
    fit = np.linalg.lstsq(scaled, lead[inner], rcond=None)[0]
    left = lead[inner] - scaled @ fit
    # Behind the filter so many samples hang together.
    variance = float(np.var(left)) * rate / (2.0 * corner)
    return float(fit[0] / size[0]), math.sqrt(variance * float(np.linalg.pinv(scaled.T @ scaled)[0, 0])) / float(
        size[0]
    )
