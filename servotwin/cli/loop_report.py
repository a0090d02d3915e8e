"""Report on a co-simulated loop: estimates beside the true gap, what became of the settings, ends of the steps."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from rich.table import Table

from servotwin.cosim import Loop
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.plant.display_units import gap_in_words, position_unit
from servotwin.simulation import Run

_ENDS, _RESTS, _COUNTS = 0.1, 0.01, 2.0
"""Last part of a step in which it must rest; largest error there, of the step; and counts of the sensor beside it."""
_NUMBER = re.compile(r"[-+]?\d[\d.e+-]*")
CHANGES = 0.02
"""Of the samples: a reference that changes in more of them does not step."""


class StepEnd(NamedTuple):
    """End of one step of the reference.

    Attributes
    ----------
    size : float
        m or rad.
    error : float
        Largest error in the last tenth of the time until the next step, m or rad.
    rests : bool
        True where that is at most 1 % of the step and two counts of the sensor.
    """

    size: float
    error: float
    rests: bool


def step_ends(run: Run) -> list[StepEnd]:
    """Ends of the steps of the reference, but for one that the run cuts short; empty where it does not step."""
    changes = np.flatnonzero(np.diff(run.reference)) + 1
    if changes.size > CHANGES * run.reference.size:
        return []
    counts = _COUNTS * run.servo.position_resolution
    edges = np.array([0, *changes, run.reference.size])
    shortest = 0.5 * float(np.median(np.diff(edges)))
    ends, before = [], float(run.position[0])
    for first, last in pairwise(edges.tolist()):
        size = abs(float(run.reference[first]) - before)
        before = float(run.reference[first])
        if size > 0.0 and last - first > shortest:
            tail = slice(last - max(1, round(_ENDS * (last - first))), last)
            error = float(np.max(np.abs(run.reference[tail] - run.position[tail])))
            ends.append(StepEnd(size, error, error <= _RESTS * size + counts))
    return ends


def summary(loop: Loop) -> Iterator[str]:
    """Sentences on a loop, with the units of its machine."""
    scenario = loop.scenario
    windows = f"{len(loop.windows)} windows reached the twin" if scenario.twin.enabled else "no twin"
    yield f"{scenario.name}: {scenario.duration:g} s, {windows}"
    if loop.estimates:
        yield from _of_estimates(loop)
    yield from of_settings(loop)
    yield from _of_steps(loop.run)


def _of_estimates(loop: Loop) -> Iterator[str]:
    accepted = [each for each in loop.estimates if each.ok]
    line = f"gap: {len(accepted)} of {len(loop.estimates)} windows accepted"
    if accepted:
        off = max(abs(each.gap - true_gap(loop, each)) for each in accepted)
        inside = sum(each.interval[0] <= true_gap(loop, each) <= each.interval[1] for each in accepted)
        words = gap_in_words(loop.scenario.servo, off, ".3g")
        line += f", off by at most {words}; the gap lies in {inside} of {len(accepted)} intervals"
    yield line
    yield from refusals(loop)


def refusals(loop: Loop) -> Iterator[str]:
    """Sentences on the windows that the twin refused, by their status, and on what would help."""
    others = [each for each in loop.estimates if not each.ok]
    for status, count in Counter(each.status for each in others).items():
        reasons = (reason for each in others if each.status is status for reason in each.reasons[:1])
        yield f"  {count} {status}: {_most(reasons)}"
    if loop.estimates and all(
        each.status in (GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND) for each in loop.estimates
    ):
        length = loop.scenario.commissioning.window
        yield (
            f"  no window of {length:.3g} s tells both flanks: record longer ones, best with a move each way "
            "([recording] window_s), or let the twin request them, and moves ([twin.excitation])"
        )


def of_settings(loop: Loop) -> Iterator[str]:
    """Sentences on what became of the settings of a loop; none without windows."""
    if not (loop.updates or loop.fallbacks):
        if loop.windows:
            yield f"settings: none sent; {_most(each.reason for each in loop.redesigns)}"
        return
    yield f"settings: {len(loop.updates)} sent, {len(loop.applied)} applied"
    refused = [each.reason for each in {r.version: r for r in loop.receipts if not r.applied}.values() if each.reason]
    for reason, count in Counter(map(str, refused)).items():
        yield f"  {count} refused by the edge: {reason}"
    for reason, count in Counter(str(each.cause) for each in loop.fallbacks).items():
        yield f"  {count} returns to the fallback set: {reason}"
    unsent = [each.reason for each in loop.redesigns if each.setting is None and each.reason]
    for reason, count in Counter(unsent).most_common(1):
        yield f"  after {count} window{'s' * (count > 1)} none was sent: {reason}"


def _of_steps(run: Run) -> Iterator[str]:
    ends = step_ends(run)
    if not ends:
        return
    unit = position_unit(run.servo).small
    errors = [unit.factor * each.error for each in ends]
    rests = sum(each.rests for each in ends)
    yield (
        f"steps: {rests} of {len(ends)} rest in their last tenth within 1 % and two counts; error there "
        f"{float(np.median(errors)):.3g} {unit.name} in the median, {max(errors):.3g} {unit.name} at most"
    )


def _most(reasons: Iterable[str]) -> str:
    """The most frequent reason."""
    found = Counter(reason for reason in reasons if reason)
    return found.most_common(1)[0][0] if found else "no reason was given"


def true_gap(loop: Loop, estimate: GapEstimate) -> float:
    """Gap of the simulated machine in the middle of a window, rad."""
    return float(np.interp(estimate.time, loop.run.time, loop.run.gap))


def window_table(loop: Loop) -> Table:
    """A line for each window: the gap, its estimate, and the setting."""
    table = Table(box=None, padding=(0, 1, 0, 0))  # 80 columns
    for heading in ("time, s", "gap, deg", "estimate, deg", "95 % interval, deg"):
        table.add_column(heading, justify="right")
    table.add_column("status")
    table.add_column("setting")
    for each, redesign in zip(loop.estimates, loop.redesigns, strict=True):
        known = math.isfinite(each.gap)
        setting = "kept" if redesign.setting is None else "fallback set" if redesign.reason else "found"
        table.add_row(
            f"{each.time:.4g}",
            f"{math.degrees(true_gap(loop, each)):.4g}",
            f"{math.degrees(each.gap):.4g}" if known else "-",
            f"{math.degrees(each.interval[0]):.4g} .. {math.degrees(each.interval[1]):.4g}" if known else "-",
            str(each.status),
            setting,
        )
    return table


def reasons(loop: Loop) -> Iterator[str]:
    """Reasons why windows gave no setting, or the fallback set; those that differ by numbers only count as one."""
    alike: dict[str, list[tuple[float, str]]] = {}
    for each, redesign in zip(loop.estimates, loop.redesigns, strict=True):
        if redesign.reason:
            alike.setdefault(_NUMBER.sub("", redesign.reason), []).append((each.time, redesign.reason))
    for (time, reason), *others in alike.values():
        more = f" and {len(others)} more, the first" if others else ""
        yield f"  {time:.4g} s{more}: {reason}"
