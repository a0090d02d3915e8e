"""The change of the gap, window by window: a baseline that learns itself, and a two-sided cumulative sum on top.

The baseline is the weighted mean of all windows since it began; a window is compared with those before it, and then
learnt. Such recursive residuals are independent with one variance, however few windows the baseline stands on, so the
limits mean the same from the second window on (Hawkins 1987). What the model has wrong shifts every window alike and
is in the baseline; what it scatters beyond the windows' own spread is learnt as a factor of that spread, never below 1.
"""

from math import copysign, log1p, sqrt
from typing import NamedTuple

from msgspec import Struct, structs

from servotwin.edge.noveltyrules import NoveltyRules

_TRUSTED = 10.0  # windows that the stated spread counts as
_MOST = 100.0  # windows that what was learnt of the spread counts as
_CLIPPED = 3.0  # standard deviations that one window teaches at most


class Chart(Struct, frozen=True):
    """What was learnt.

    Attributes
    ----------
    gap, weight : float
        rad, the baseline, and 1/rad^2, one over its variance; 0: none yet.
    scale, freedom : float
        Square of the factor on the windows' own spreads, and how many windows it stands on.
    up, down : float
        Cumulative sums, standard deviations.
    """

    gap: float = 0.0
    weight: float = 0.0
    scale: float = 1.0
    freedom: float = _TRUSTED
    up: float = 0.0
    down: float = 0.0


class Looked(NamedTuple):
    """The chart with a window learnt, the window's standardised change, and whether either limit is passed."""

    chart: Chart
    change: float
    sudden: bool
    slow: bool


def look(chart: Chart, gap: float, variance: float, rules: NoveltyRules) -> Looked:
    """Compare a window (rad, rad^2) with the baseline, then learn it."""
    if chart.weight == 0.0:
        return Looked(learnt(chart, gap, variance), 0.0, sudden=False, slow=False)
    raw = (gap - chart.gap) / sqrt(variance + 1.0 / chart.weight)
    change = normal(raw / sqrt(max(chart.scale, 1.0)), chart.freedom)
    up = max(0.0, chart.up + change - rules.allowance)
    down = max(0.0, chart.down - change - rules.allowance)
    square = min(raw * raw, _CLIPPED * _CLIPPED * max(chart.scale, 1.0))
    scale = (chart.freedom * chart.scale + square) / (chart.freedom + 1.0)
    freedom = min(chart.freedom + 1.0, _MOST)
    after = structs.replace(chart, scale=scale, freedom=freedom, up=up, down=down)
    sudden, slow = abs(change) > rules.score_limit, max(up, down) > rules.cusum_limit
    return Looked(learnt(after, gap, variance), change, sudden, slow)


def learnt(chart: Chart, gap: float, variance: float) -> Chart:
    """With one more window in the baseline."""
    weight = chart.weight + 1.0 / variance
    return structs.replace(chart, gap=chart.gap + (gap - chart.gap) / (variance * weight), weight=weight)


def begun(chart: Chart, gap: float = 0.0, weight: float = 0.0) -> Chart:
    """Another baseline; what was learnt of the spread stays, sums begin anew."""
    return Chart(gap, weight, chart.scale, chart.freedom)


def normal(student: float, freedom: float) -> float:
    """The standard normal number that is as unlikely as a Student's t (Wallace 1959)."""
    ratio = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return copysign(ratio * sqrt(freedom * log1p(student * student / freedom)), student)
