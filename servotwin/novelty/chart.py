"""Control chart of the gap, window by window: a learnt baseline and a two-sided cumulative sum.

The baseline is the weighted mean of all windows since it began; a window is compared with those before it, and then
added. Such recursive residuals are independent with one variance, however few windows the baseline stands on, so the
limits mean the same from the second window on (Hawkins 1987). An error of the model shifts every window alike and is
part of the baseline. The ratio of the windows' scatter to their stated spreads is learnt as a factor, from the median
of second differences, which neither steady wear nor a single step moves.
"""

from math import copysign, log1p, sqrt
from statistics import median
from typing import NamedTuple

from msgspec import Struct, structs

from servotwin.novelty.settings import NoveltyRules

_QUARTILE = 0.6744897501960817  # of a standard normal: the median of its size
_PRIOR, _MOST = 5, 120  # second differences that the stated spread counts as; most that are stored
_TRUSTED, _EACH = 10.0, 0.2  # degrees of freedom of the stated spread, and of one second difference in a median


class ChartPoint(Struct, frozen=True, array_like=True):
    """A window's gap (rad) and its own variance (rad^2)."""

    gap: float
    variance: float


class Chart(Struct, frozen=True):
    """Baseline, cumulative sums and scatter.

    Attributes
    ----------
    gap, weight : float
        rad, the baseline, and 1/rad^2, one over its variance; 0: none yet.
    anchor : float
        rad, the baseline where it began.
    up, down : float
        Cumulative sums, standard deviations.
    last : tuple of ChartPoint
        The last two windows, whatever the baseline.
    bends : tuple of float
        Sizes of the last second differences, standard deviations.
    """

    gap: float = 0.0
    weight: float = 0.0
    anchor: float = 0.0
    up: float = 0.0
    down: float = 0.0
    last: tuple[ChartPoint, ...] = ()
    bends: tuple[float, ...] = ()

    @property
    def factor(self) -> float:
        """Factor of the windows' own spreads."""
        return median((*self.bends, *(_QUARTILE,) * _PRIOR)) / _QUARTILE

    @property
    def freedom(self) -> float:
        """Degrees of freedom that the factor has."""
        return _TRUSTED + _EACH * len(self.bends)


class ChartResult(NamedTuple):
    """The chart with a window added, the window's standardised change, and whether it is news by either limit.

    A window that is news begins a new baseline.
    """

    chart: Chart
    change: float
    sudden: bool
    slow: bool


def add_window(chart: Chart, gap: float, std: float, rules: NoveltyRules) -> ChartResult:
    """Compare a window (gap and standard deviation, rad) with the baseline, then add it."""
    own = std * std + rules.resolution * rules.resolution
    variance = max(own * chart.factor * chart.factor, rules.resolution * rules.resolution)
    change = up = down = 0.0
    if chart.weight > 0.0:
        change = normal((gap - chart.gap) / sqrt(variance + 1.0 / chart.weight), chart.freedom)
        up, down = summed(chart.up, chart.down, change, rules.allowance)
    after = structs.replace(_bent(chart, ChartPoint(gap, own)), up=up, down=down)
    sudden, slow = abs(change) > rules.score_limit, max(up, down) > rules.cusum_limit
    if (sudden or slow) and abs(gap - chart.anchor) >= rules.worth:
        return ChartResult(restarted(after, gap, 1.0 / variance), change, sudden, slow)
    return ChartResult(_learnt(after, gap, variance), change, sudden=False, slow=False)


def summed(up: float, down: float, change: float, allowance: float) -> tuple[float, float]:
    """Page's two sums after one more standardised change."""
    return max(0.0, up + change - allowance), max(0.0, down - change - allowance)


def _bent(chart: Chart, new: ChartPoint) -> Chart:
    """Add one more second difference."""
    last = (*chart.last, new)[-3:]
    if len(last) < 3:
        return structs.replace(chart, last=last)
    first, second, third = last
    size = abs(first.gap - 2.0 * second.gap + third.gap)
    bend = size / sqrt(first.variance + 4.0 * second.variance + third.variance)
    return structs.replace(chart, last=last[1:], bends=(*chart.bends, bend)[-_MOST:])


def _learnt(chart: Chart, gap: float, variance: float) -> Chart:
    """Add one more window to the baseline."""
    weight = chart.weight + 1.0 / variance
    mean = chart.gap + (gap - chart.gap) / (variance * weight)
    return structs.replace(chart, gap=mean, weight=weight, anchor=chart.anchor if chart.weight > 0.0 else mean)


def restarted(chart: Chart, gap: float = 0.0, weight: float = 0.0) -> Chart:
    """Begin another baseline; the learnt factor of the spread stays, the sums begin anew."""
    return structs.replace(chart, gap=gap, weight=weight, anchor=gap, up=0.0, down=0.0)


def with_fewer_windows(chart: Chart, windows: int) -> Chart:
    """Reduce the baseline's weight to at most so many windows like the last, so that the next ones can move it."""
    most = windows / chart.last[-1].variance if chart.last else chart.weight
    return restarted(chart, chart.gap, min(chart.weight, most))


def normal(student: float, freedom: float) -> float:
    """Convert a Student's t to the standard normal number that is as unlikely (Wallace 1959)."""
    ratio = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return copysign(ratio * sqrt(freedom * log1p(student * student / freedom)), student)
