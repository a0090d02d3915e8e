"""`servotwin bench novelty`: false alarms, detection delays, messages saved, and what a window costs."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.accuracy import limited, target
from benchmarks.estimator_figures import ANY, Figure
from benchmarks.novelty import loops
from benchmarks.novelty.loops import Account, LoopCase
from benchmarks.novelty.sequences import Delays, delays, one_window, run_length, wearing
from benchmarks.novelty.windows import (
    CONDITIONS,
    KNOWN_GAP,
    RATE,
    NoveltyCondition,
    PoolTask,
    ScorePool,
    pools,
    recorded,
)
from servotwin.analysis.maps.pool import workplace
from servotwin.novelty.score import model_of, score
from servotwin.novelty.settings import NoveltyRules
from servotwin.plant.servo import Servo

SCHEMA = "servotwin-bench-novelty/1"
NAME = "novelty"
STEPS = (0.05, 0.1, 0.2, 0.5)  # deg
WEAR = (0.01, 0.003, 0.001)  # deg per window
FALSE_ALARMS = 1.0 / 120.0
LEAST = 1000.0  # windows per false alarm


@dataclass(frozen=True)
class Size:
    """How much is measured: windows without change and with one, windows drawn, trials, loops."""

    quiet: int = 2000
    changed: int = 300
    drawn: int = 200_000
    trials: int = 400
    loops: tuple[tuple[str, float, bool], ...] = loops.FULL


QUICK = Size(200, 60, 20_000, 40, loops.QUICK)
Clock = Callable[[], float]


def novelty(
    date: str = "", output: Path | None = None, size: Size | None = None, console: Console | None = None
) -> tuple[Figure, ...]:
    """Measure, print, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    size : Size, optional
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    size, console = size or Size(), console or Console()
    report.check(output)
    figures: list[Figure] = []
    with console.status("judging windows") as status, workplace():
        for condition in CONDITIONS:
            figures += charted(condition, size)
            status.update(f"judging windows, {condition.name} is done")
        figures += cost(size)
        status.update("closing loops")
        sent = list(loops.accounts(size.loops))
    console.print(shown(figures))
    console.print(saved(sent))
    report.write(output, dumps(figures, sent, date), console)
    return tuple(figures)


def charted(condition: NoveltyCondition, size: Size, seed: int = 2026) -> Iterator[Figure]:
    """All figures of one condition."""
    gaps = [KNOWN_GAP + math.radians(step) for step in (0.0, *STEPS)]
    counts = [size.quiet, *(size.changed for _ in STEPS)]
    resting, *changed = pools(condition, gaps, counts, seed)
    rules, rng = NoveltyRules(), np.random.default_rng(seed)
    name, windows = condition.name, resting.scores.shape[1] * 2
    yield Figure(f"{name}: windows that say nothing, share", resting.silent / (windows + resting.silent), ANY, windows)
    yield Figure(f"{name}: scatter of the score, deg", math.degrees(_scatter(resting)), ANY, windows)
    length, alarms = run_length(resting, rules, size.drawn, rng)
    remark = f"{alarms} false alarms"
    yield Figure(f"{name}: windows per false alarm", length, (LEAST, math.inf), size.drawn, remark)
    for step, pool in zip(STEPS, changed, strict=True):
        power = one_window(resting, pool, FALSE_ALARMS)
        yield Figure(f"{name}: {step} deg in one window, one false alarm in 120: power", power, ANY, windows)
        result = delays(resting, pool, rules, size.trials, rng)
        yield _delay(f"{name}: {step} deg", result, size.trials)
        fresh = delays(resting, pool, rules, size.trials, rng, fresh=True)
        yield _delay(f"{name}: {step} deg in the window after news", fresh, size.trials)
    for rate in WEAR:
        result = wearing(resting, math.radians(rate), rules, size.trials // 4, rng)
        yield _delay(f"{name}: wear of {rate} deg per window", result, size.trials // 4)


def _scatter(pool: ScorePool) -> float:
    return float(np.mean(pool.scores[..., 0].std(axis=1)))


def _delay(name: str, result: Delays, trials: int) -> Figure:
    remark = f"90 % within {result.late:g}; in the first {result.at_once:.0%}"
    return Figure(f"{name}: seen after, windows (median)", result.median, ANY, trials, remark)


def cost(size: Size, clock: Clock = time.perf_counter) -> Iterator[Figure]:
    """Measure the time of one score: 1 s at 5 kHz, in plain floats."""
    known, spent = Servo.preset("paper"), []
    model = model_of(known, RATE)
    for seed in range(1 + size.quiet // 200):
        for window in recorded(PoolTask(CONDITIONS[0], KNOWN_GAP, seed), known):
            assert window.theta_m is not None
            theta_m, position = array("d", window.theta_m), array("d", window.position)
            begin = clock()
            score(theta_m, position, model, KNOWN_GAP, usual=math.inf)
            spent.append(1e3 * (clock() - begin))
    remark = f"slowest {max(spent):.1f} ms"
    yield Figure("one window of 1 s at 5 kHz, ms (median)", median(spent), ANY, len(spent), remark)


def shown(figures: Sequence[Figure]) -> Table:
    """The figures as a table for the terminal."""
    result = Table(title="novelty: when the edge sees a change", title_justify="left", box=None, pad_edge=False)
    for heading, justify in (("what", "left"), ("measured", "right"), ("target", "right"), ("windows", "right")):
        result.add_column(heading, justify=justify)  # type: ignore[arg-type]
    result.add_column("")
    for figure in figures:
        judged = ("met" if figure.met else "missed") if limited(figure) else ""
        words = "; ".join(filter(None, (judged, figure.remark)))
        result.add_row(figure.name, f"{figure.value:.4g}", target(figure), str(figure.windows), words)
    return result


def saved(sent: Sequence[tuple[LoopCase, str, Account]]) -> Table:
    """What was sent and what it cost."""
    result = Table(title="messages of the closed loop", title_justify="left", box=None, pad_edge=False)
    result.add_column("loop")
    result.add_column("sent is")
    headings = "windows", "sent", "updates", "kB up", "gap held\ndeg rms", "worst\ndeg", "trend\ndeg rms"
    for heading in (*headings, "error\num rms", "error at the\nend, um"):
        result.add_column(heading, justify="right")
    for case, name, a in sent:
        wear = "20 deg of wear" if case.wears else "no wear"
        angles = (f"{math.degrees(x):.3f}" for x in (a.held, a.worst, a.known))
        counts = map(str, (a.windows, a.sent, a.updates, a.up // 1000))
        where = f"{case.scenario}, {wear}, {case.seconds:g} s"
        result.add_row(where, name, *counts, *angles, f"{1e6 * a.error:.1f}", f"{1e6 * a.end:.1f}")
    return result


def dumps(figures: Sequence[Figure], sent: Sequence[tuple[LoopCase, str, Account]], date: str) -> str:
    """The document: schema, date, machine, figures, loops."""
    rows = [
        {
            "name": figure.name,
            "value": figure.value,
            "met": figure.met if limited(figure) else None,
            "windows": figure.windows,
            "remark": figure.remark,
        }
        for figure in figures
    ]
    closed = [
        {**dict(zip(LoopCase._fields[:3], case, strict=False)), "sent is": name, **a._asdict()}
        for case, name, a in sent
    ]
    return report.text(SCHEMA, date, figures=rows, loops=closed)
