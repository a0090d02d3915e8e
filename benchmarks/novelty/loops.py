"""Windows sent in the closed loop, and the accuracy that is left, where the edge selects the windows to send."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from servotwin.analysis.maps.pool import shared
from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.edge.outlet import FILTERED
from servotwin.novelty.settings import NoveltyRules
from servotwin.plant.signals import Array, SCurve

GROWTH = math.radians(20.0)
_SAMPLES, _KNOWN = 200.0, 5.0  # Hz, at which errors of the loop and of the gap are summed up


class LoopCase(NamedTuple):
    """A packaged scenario, its wear of 20 deg (or none, at 10 deg) over so many seconds, and what the edge sends."""

    scenario: str
    seconds: float
    wears: bool
    rules: NoveltyRules | None


class Account(NamedTuple):
    """Windows that one loop sent, and the accuracy of its twin.

    Attributes
    ----------
    windows, sent, updates, up : int
        Cut, sent, updates applied, bytes towards the twin.
    reasons : dict
        Of what was sent.
    held, known : float
        rad, root mean square over time of the gap's error: as last estimated, and as the twin's trend predicts it.
    worst : float
        rad, the largest of the former from the first estimate on.
    error, end : float
        m: root mean square of the tracking error, and its largest value in the last quarter between two steps.
    """

    windows: int
    sent: int
    updates: int
    up: int
    reasons: dict[str, int]
    held: float
    known: float
    worst: float
    error: float
    end: float


RULES = (
    ("every one", None),
    ("news", NoveltyRules()),
    ("news of 0.2 deg", NoveltyRules(worth=math.radians(0.2))),
    ("news of 0.5 deg", NoveltyRules(worth=math.radians(0.5))),
)
FULL = (("fig15", 200.0, True), ("fig15", 2000.0, True), ("fig16", 2000.0, False), ("certified", 2000.0, True))
QUICK = (("fig15", 200.0, True), ("fig15", 400.0, False))


def accounts(loops: Sequence[tuple[str, float, bool]]) -> Iterator[tuple[LoopCase, str, Account]]:
    """All loops under all rules, each rule with its name, in their order."""
    cases = {LoopCase(*loop, rules): name for loop in loops for name, rules in RULES}
    results = dict(shared(account, cases))
    for case, name in cases.items():
        yield case, name, results[case]


def account(case: LoopCase) -> Account:
    """Run one loop and sum it up."""
    return summary(cosimulate(scenario(case)))


def scenario(case: LoopCase) -> Scenario:
    """Vary the packaged scenario: stretch its wear."""
    packaged = Scenario.preset(case.scenario)
    gap = SCurve(0.0, GROWTH, duration=case.seconds) if case.wears else 0.5 * GROWTH
    recording = replace(packaged.recording, novelty=case.rules)
    return packaged.replace(duration=case.seconds, gap=gap, recording=recording)


def summary(loop: Loop) -> Account:
    """Sum up the windows that a loop sent, and the accuracy of its twin."""
    run = loop.run
    every, seldom = (max(1, round(run.sample_rate / rate)) for rate in (_SAMPLES, _KNOWN))
    errors, known = (values - run.gap[::seldom] for values in _knowledge(loop, run.time[::seldom]))
    known_from = np.isfinite(errors)
    error = (run.reference - run.position)[::every]
    sent = [m for m in loop.messages if m.direction == "up"]
    rms = (float(np.sqrt(np.mean(np.square(x[known_from])))) for x in (errors, known))
    return Account(
        len(loop.windows) + loop.accounts[FILTERED],
        len(loop.windows),
        len(loop.applied),
        sum(len(m.data) for m in sent),
        dict(Counter(window.reason for window in loop.windows)),
        next(rms),
        next(rms),
        float(np.max(np.abs(errors[known_from]))),
        float(np.sqrt(np.mean(np.square(error)))),
        _at_the_end(run.reference[::every], error),
    )


def _knowledge(loop: Loop, time: Array) -> tuple[Array, Array]:
    """(n,) gap of the last estimate, and gap that the trend predicts; NaN before the first estimate."""
    estimated, known = np.full((2, time.size), math.nan)
    pairs = [(e, t) for e, t in zip(loop.estimates, loop.trends, strict=True) if e.ok and t is not None]
    ends = [*(estimate.time for estimate, _ in pairs[1:]), math.inf]
    for (estimate, trend), end in zip(pairs, ends, strict=True):
        part = np.flatnonzero((time >= estimate.time) & (time < end))
        estimated[part] = estimate.gap
        known[part] = [trend.predict(float(t)).gap if t > trend.time else trend.gap for t in time[part]]
    return estimated, known


def _at_the_end(reference: Array, error: Array) -> float:
    """Largest error in the last quarter of each time between two changes of the reference."""
    changes = [0, *(np.flatnonzero(np.diff(reference)) + 1).tolist(), len(reference)]
    ends = [error[last - (last - first) // 4 : last] for first, last in pairwise(changes)]
    return max((float(np.max(np.abs(end))) for end in ends if end.size), default=0.0)
