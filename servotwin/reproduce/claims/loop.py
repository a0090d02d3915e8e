"""Claims about the loop with its twin, without noise (sections 4 to 4.2, 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servotwin.reproduce.claims.claim import Finding, Verdict, decided, listed, measures, measures_both
from servotwin.reproduce.claims.linear import linear_settling_time
from servotwin.reproduce.loops import CONTINUOUS, SAMPLED, LoopJob, Record
from servotwin.reproduce.measures import Step
from servotwin.reproduce.runs import AMPLITUDE, BIPOLAR, Runs, Square
from servotwin.reproduce.windows import WindowJob

RATE_BITS = 100e6  # bit/s, section 4
UNBIASED_DEG = 0.05
MM = 1e3


def fig15(runs: Runs, square: Square = BIPOLAR, scenario: str = CONTINUOUS, exact: bool = False) -> Record:
    """Fig 15's run."""
    return runs.get(LoopJob(runs.preset, scenario, square, exact=exact))


@measures_both("always-restabilised")
def restabilised(runs: Runs, square: Square) -> Finding:
    """Every step settles."""
    found, sampled = (fig15(runs, square, scenario).trace.steps for scenario in (CONTINUOUS, SAMPLED))
    moving = unsettled(found)
    why = f"{told(found)} at the end of its 20 s; sampled at 5 kHz, {told(sampled)}"
    values = [(f"amplitude of step {i + 1}", found[i].amplitude * MM, "mm") for i in moving]
    counts = (("steps not settled", len(moving)), ("steps not settled, sampled", len(unsettled(sampled))))
    return decided(not moving, why, *counts, *values)


@measures_both("wider-range-than-fixed")
def wider_range(runs: Runs, square: Square) -> Finding:
    """Settled steps with the twin and with the fixed dead zone."""
    twin, fixed = (sum(s.settled for s in trace.steps) for trace in (fig15(runs, square).trace, runs.wear(square)))
    why = f"{twin} of 10 steps settle with the twin and {fixed} with the fixed dead zone"
    return decided(twin > fixed, why, ("settled with the twin", twin), ("settled with the fixed dead zone", fixed))


@measures_both("settling-lengthened")
def settling_lengthened(runs: Runs, square: Square) -> Finding:
    """Median settling time of the settled steps against the linear loop's."""
    times = [step.settling_time for step in fig15(runs, square).trace.steps if step.settled]
    median, linear = float(np.median(times)), linear_settling_time(runs)
    why = (
        f"the median is {median:.3g} s (longest {max(times):.3g} s) against {linear:.3g} s of the linear loop; updates"
        " take effect 3 s after each step"
    )
    values = (("median settling time", median, "s"), ("longest", max(times), "s"), ("linear", linear, "s"))
    return decided(median > linear, why, *values)


@measures_both("bias-present")
def bias_present(runs: Runs, square: Square) -> Finding:
    """Smallest bias of a step."""
    biases = [abs(step.bias) for step in fig15(runs, square).trace.steps]
    clear = sum(bias > 1e-3 * AMPLITUDE for bias in biases)
    least, most = min(biases) * MM, max(biases) * MM
    why = f"{clear} of {len(biases)} steps end more than 0.1 % away; the biases are {least:.2g} to {most:.2g} mm"
    return decided(clear == len(biases), why, ("steps with a clear bias", clear), ("smallest", least, "mm"))


@measures_both("bias-under-5-percent")
def bias_under_5_percent(runs: Runs, square: Square) -> Finding:
    """Largest bias of a step; with the exact gap beside it."""
    worst = {name: 100.0 * worst_bias(fig15(runs, square, *how).trace.steps) / AMPLITUDE for name, how in _WAYS.items()}
    why = f"the worst bias is {worst['continuous']:.3g} % of 1 mm" + "".join(
        f", {percent:.3g} % {name}" for name, percent in worst.items() if name != "continuous"
    )
    return decided(
        worst["continuous"] < 5.0, why, *[(f"worst bias, {name}", value, "%") for name, value in worst.items()]
    )


_WAYS: dict[str, tuple[str, bool]] = {
    "continuous": (CONTINUOUS, False),
    "sampled": (SAMPLED, False),
    "with the gap known exactly": (CONTINUOUS, True),
}


@measures_both("estimate-good-enough")
def good_enough(runs: Runs, square: Square) -> Finding:
    """Settled steps with estimates and with the truth."""
    estimated, exact = (fig15(runs, square, exact=exact) for exact in (False, True))
    ours, best = (sum(step.settled for step in record.trace.steps) for record in (estimated, exact))
    worst = max(abs(one.error) for one in estimated.estimates)
    why = (
        f"{ours} of 10 steps settle with estimates that are off by up to {math.degrees(worst):.2g} deg, and {best} with"
        " the true gap sent over the same delays"
    )
    values = (("settled with estimates", ours), ("settled with the truth", best))
    return decided(ours >= best, why, *values, ("largest error", math.degrees(worst), "deg"))


@measures("update-delay")
def update_delay(runs: Runs) -> Finding:
    """From each reference change to the tick that takes the update."""
    delays = [applied - begin for applied, begin in fig15(runs).applied]
    why = f"{len(delays)} updates took effect {min(delays):.4f} to {max(delays):.4f} s after their reference change"
    reproduced = len(delays) > 0 and all(abs(delay - 3.0) < 0.01 for delay in delays)
    return decided(reproduced, why, ("shortest", min(delays), "s"), ("longest", max(delays), "s"))


@measures("samples-10000")
def samples(runs: Runs) -> Finding:
    """Samples of both channels in each window."""
    counts = fig15(runs).channel_samples
    why = f"each of {len(counts)} windows holds {min(counts)} to {max(counts)} samples of motor angle and position"
    return decided(set(counts) == {10_000}, why, ("fewest", min(counts)), ("most", max(counts)))


@measures("transmission-1-6-ms")
def transmission(runs: Runs) -> Finding:
    """Time for the two channels, and for the whole message, at 100 Mbit/s."""
    record = fig15(runs)
    two, whole = (8e3 * max(count) / RATE_BITS for count in (record.channel_bytes, record.message_bytes))
    why = (
        f"two channels of int16 take {two:.4g} ms; our whole message, which also carries voltage and reference, takes"
        f" {whole:.4g} ms; int16 rounds the position by at most {record.quantisation * 1e6:.2g} µm"
    )
    values = (("two channels", two, "ms"), ("whole message", whole, "ms"))
    return decided(abs(two - 1.6) < 0.016, why, *values, ("rounding", record.quantisation * 1e6, "µm"))


@measures("router-microseconds")
def router(_runs: Runs) -> Finding:
    """Nothing here routes packets."""
    why = "a simulated link has the delay it is given; a router would have to be measured"
    return Finding(Verdict.CANNOT_BE_CHECKED, why, listed())


@measures("faster-than-real-time")
def faster(runs: Runs) -> Finding:
    """Median wall time of an estimate."""
    seconds = _seconds(runs)
    median = float(np.median(seconds))
    why = (
        f"a window of 1 s is estimated in {median * 1e3:.2g} ms (median), {1.0 / median:.0f} times as fast as real time"
    )
    return decided(median < 0.1, why, ("median wall time", median * 1e3, "ms"))


@measures("converges-within-delay")
def converges(runs: Runs) -> Finding:
    """Longest wall time of an estimate."""
    longest = max(_seconds(runs))
    why = f"the slowest estimate took {longest * 1e3:.2g} ms of the 1 s delay"
    return decided(longest < 1.0, why, ("longest wall time", longest * 1e3, "ms"))


def _seconds(runs: Runs) -> list[float]:
    """Wall time of Fig 15's estimates, the first one (which loads code) left out."""
    return [one.seconds for one in fig15(runs).estimates[1:]]


@measures("unbiased")
def unbiased(runs: Runs) -> Finding:
    """The published estimator on noise-free windows, after 0.25 s and after 0.40 s."""
    errors = {settle: runs.get(WindowJob(runs.preset, settle)) for settle in (0.25, 0.30, 0.40)}
    means = {settle: float(np.mean(list(found.values()))) for settle, found in errors.items()}
    why = (
        f"its mean error is {means[0.25]:.2g} deg when 0.25 s are left out, {means[0.3]:.2g} deg for 0.30 s and"
        f" {means[0.4]:.2g} deg for 0.40 s: the observer's leftover transient biases it"
    )
    each = [(f"mean error, gap {gap:g} deg", error, "deg") for gap, error in errors[0.25].items()]
    values = [(f"mean error, {settle:g} s left out", mean, "deg") for settle, mean in means.items()]
    return decided(abs(means[0.25]) < UNBIASED_DEG, why, *values, *each)


def unsettled(steps: Sequence[Step]) -> list[int]:
    """Indices of the steps that did not settle."""
    return [i for i, step in enumerate(steps) if not step.settled]


def told(steps: Sequence[Step]) -> str:
    """Which steps still move, in words."""
    moving = [f"{i + 1} (by {steps[i].amplitude * MM:.2g} mm)" for i in unsettled(steps)]
    return f"still moving: step {', '.join(moving)}" if moving else "every step rests"


def worst_bias(steps: Sequence[Step]) -> float:
    """Largest bias of a step, m."""
    return max(abs(step.bias) for step in steps)
