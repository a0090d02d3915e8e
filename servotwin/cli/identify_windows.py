"""Estimates of a log's windows in their order, and the start afresh where the log becomes that of another machine.

Of a free shaft the windows of another payload or shaft contradict what was learnt. Within the usual freedom they are
learnt anew (`servotwin.estimation.learning.machine`); beyond it every later one would be refused. A reader of a log may
start afresh there with hardly anything known, where a twin must not: settings of a running machine would rest on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from servotwin.estimation.estimate import NORMAL_95, GapEstimate
from servotwin.estimation.learning.machine import LearntMachine
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array
from servotwin.twin.estimating import Estimator, estimator_of
from servotwin.twin.settings import TwinSettings

Report: TypeAlias = Callable[[int, int], None]

_WIDE = 0.5  # standard deviation of the logarithms of another machine's stiffness and damping over its inertia
_TOLD = 0.5  # of what was known: a window that leaves no more tells a number
# Times the errors of the windows before: those of another machine are as small (at most 2.1 times on the machines that
# were tried), those of belts that slip, soft tools and shafts that harden 9 times and more.
_AS_WELL = 3.0
_APART = 5.0  # standard deviations between the numbers of two machines


class Followed(NamedTuple):
    """Estimates of windows in the order of time, remarks on each, and the trend after the last one."""

    estimates: tuple[GapEstimate, ...]
    remarks: tuple[tuple[str, ...], ...]
    trend: Trend | None


class _Step(NamedTuple):
    """A window's estimate, the knowledge after it, the remarks, and whether it counted as a gap."""

    estimate: GapEstimate
    wear: Wear
    remarks: tuple[str, ...]
    counts: bool


def followed(windows: Sequence[Window], seen: Plant, settings: TwinSettings, progress: Report) -> Followed:
    """Estimate windows, each with what the ones before tell of gap and machine.

    Parameters
    ----------
    windows : sequence of Window
        In the order of time.
    seen : Servo or Axis
        The machine with the sensors that the windows show.
    settings : TwinSettings
    progress : callable
        Called with the number of estimated windows and that of all.
    """
    estimator, enough = estimator_of(seen, settings), settings.learning.restart_after
    wear, steps, begun = Wear(settings.initial_gap), list[_Step](), 0
    for done, window in enumerate(windows):
        progress(done, len(windows))
        steps.append(_step(wear, window, estimator, settings))
        if _may_be_another(seen) and len(steps) - begun > enough:
            anew = _another_machine(windows[len(steps) - enough : len(steps)], steps[begun:], estimator, settings)
            if anew:
                begun = len(steps) - enough
                steps[begun:] = anew
        wear = steps[-1].wear
    return Followed(
        tuple(step.estimate for step in steps), tuple(step.remarks for step in steps), wear.trend(settings.trend)
    )


def _step(wear: Wear, window: Window, estimator: Estimator, settings: TwinSettings) -> _Step:
    """Estimate the next window."""
    now, trends, learning = window.mid_time, settings.trend, settings.learning
    estimate = estimator(window, wear.expect(trends, "log", now, now, learning))
    after, rejection = wear.update(trends, "log", estimate, now, learning)
    outlier = [rejection] if estimate.ok and rejection else []
    remarks = (*outlier, *after.remarks(wear, estimate, trends, learning))
    return _Step(estimate, after, remarks, not rejection)


def _may_be_another(seen: Plant) -> bool:
    """True for axes on which starts afresh were tried: one free mass behind a damped shaft that is free in the gap."""
    return (
        isinstance(seen, Axis)
        and seen.backlash_kind is BacklashKind.FREE
        and not seen.at_motor
        and seen.n == 1
        and seen.load.free
        and seen.load.force == 0.0
        and seen.transmission.c_d > 0.0
    )


def _another_machine(
    windows: Sequence[Window], steps: Sequence[_Step], estimator: Estimator, settings: TwinSettings
) -> list[_Step]:
    """Steps of the last windows as those of another machine; empty where they may be of this one with a fault.

    All of them must have been refused, and afresh each must be accepted, explained as well as those of the machine
    before, and tell stiffness and damping. A friction that nobody stated does not: on a load that hardly swings its
    wind-up looks like a wider gap behind a stiffer shaft (of six machines one showed thrice the gap, known to 15 %).
    Nor may the gap be none: a constant force that nobody stated holds the load on one flank.
    """
    before, last = steps[: -len(windows)], steps[-len(windows) :]
    errors = [step.estimate.rms for step in before if step.counts]
    learnt = before[-1].wear.machine
    if not errors or learnt is None or any(step.estimate.ok for step in last):
        return []
    usual = OutputErrorSettings()
    known = FactorPrior.of_spreads(_WIDE, _WIDE, usual.ratio, usual.mass_ratio)
    none = LearntMachine(known.reading.factors, known.reading.covariance, windows[0].mid_time, windows=0)
    wear, anew = Wear(settings.initial_gap, machine=none), list[_Step]()
    for window in windows:
        step = _step(wear, window, estimator, settings)
        if not (step.counts and _is_told(step.estimate, _AS_WELL * max(errors))):
            return []
        anew.append(step)
        wear = step.wear
    assert wear.machine is not None
    said = _other_machine(learnt, wear.machine)
    if not said:
        return []
    return [anew[0]._replace(remarks=(said, *anew[0].remarks)), *anew[1:]]


def _is_told(estimate: GapEstimate, error: float) -> bool:
    """True for a gap above none with a machine's numbers, and an error (m or rad at the load) no larger than that."""
    if estimate.machine is None or not estimate.interval[0] > 0.0 or not estimate.rms <= error:
        return False
    return bool(np.all(_spreads(estimate.machine.covariance)[:2] < _TOLD * _WIDE))


def _spreads(covariance: Sequence[float]) -> Array:
    """(4,) standard deviations of a machine's numbers."""
    return np.asarray(np.sqrt(np.array(covariance).reshape(4, 4).diagonal()))


def _other_machine(before: LearntMachine, after: LearntMachine) -> str:
    """Sentence on a machine that has become another one; empty where its numbers may be the same."""
    change = np.array(after.factors) - np.array(before.factors)
    spread = np.hypot(_spreads(before.covariance), _spreads(after.covariance))
    if not np.any(np.abs(change[:2]) > _APART * spread[:2]):
        return ""
    heavier, stiffer, known = math.exp(-change[0]), math.exp(change[0]), NORMAL_95 * float(spread[0])
    return (
        f"the machine is another one from here on, as of a load {heavier:.3g} ± {heavier * known:.1g} times as heavy "
        f"or a shaft {stiffer:.3g} ± {stiffer * known:.1g} times as stiff: {after.words()} off the model, and "
        f"{before.words()} before; gap and wear are followed afresh"
    )
