"""Claims about the loop with its twin, without noise (sections 4 to 4.2, 5)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from servotwin.reproduction.claims.linear import linear_settling_time
from servotwin.reproduction.claims.registry import Finding, Verdict, decided, listed, measures, measures_both
from servotwin.reproduction.measures import Array, MeasuredStep
from servotwin.reproduction.runs import AMPLITUDE, BIPOLAR, FixedFamilyJob, Runs, Square
from servotwin.reproduction.twin_runs import CONTINUOUS, SAMPLED, TwinFamilyJob, TwinJob, TwinRun, WindowJob

_RATE_BITS = 100e6  # bit/s, section 4
_UNBIASED_DEG = 0.05
MM = 1e3
Family = Sequence[Sequence[MeasuredStep]]


def fig15(runs: Runs, square: Square = BIPOLAR, scenario: str = CONTINUOUS) -> TwinRun:
    """Fig 15's run."""
    return runs.get(TwinJob(runs.preset, scenario, square))


def family(runs: Runs, square: Square, exact: bool = False) -> Family:
    """The steps of nine runs like Fig 15's, whose reference amplitudes differ by 0.1 % each."""
    return runs.get(TwinFamilyJob(runs.preset, square, exact))


@measures_both("always-restabilised")
def restabilised(runs: Runs, square: Square) -> Finding:
    """Every step of every run settles."""
    runs_steps, sampled = family(runs, square), fig15(runs, square, SAMPLED).trace.steps
    moving = _unsettled_counts(runs_steps)
    shown = ", ".join(f"{step} in {count}" for step, count in moving.items())
    why = (
        f"of {len(runs_steps)} runs, whose reference amplitudes differ by 0.1 %, these steps still move after 20 s:"
        f" {shown or 'none'}; in one sampled at 5 kHz {_settled_counts([sampled])[0]} of 10 steps settle"
    )
    values = [
        (f"step {step} not settled, share of the runs", 100.0 * n / len(runs_steps), "%") for step, n in moving.items()
    ]
    worst = max(step.amplitude for steps in runs_steps for step in steps)
    return decided(
        not moving, why, *_mean_settled("twin", runs_steps), *values, ("largest amplitude", worst * MM, "mm")
    )


@measures_both("wider-range-than-fixed")
def wider_range(runs: Runs, square: Square) -> Finding:
    """Settled steps with the twin and with the fixed dead zone."""
    with_twin, with_fixed = family(runs, square), runs.get(FixedFamilyJob(runs.preset, square))
    twin, fixed = (float(np.mean(_settled_counts(each))) for each in (with_twin, with_fixed))
    why = f"in the mean {twin:.3g} of 10 steps settle with the twin and {fixed:.3g} with the fixed dead zone"
    return decided(twin > fixed, why, *_mean_settled("twin", with_twin), *_mean_settled("fixed dead zone", with_fixed))


@measures_both("settling-lengthened")
def settling_lengthened(runs: Runs, square: Square) -> Finding:
    """Median settling time of the settled steps against the linear loop's."""
    times = [step.settling_time for steps in family(runs, square) for step in steps if step.settled]
    median, linear = float(np.median(times)), linear_settling_time(runs)
    why = (
        f"the median is {median:.3g} s (longest {max(times):.3g} s) against {linear:.3g} s of the linear loop; updates"
        " take effect 3 s after each step"
    )
    return decided(
        median > linear,
        why,
        ("median settling time", median, "s"),
        ("longest", max(times), "s"),
        ("linear", linear, "s"),
    )


@measures_both("bias-present")
def bias_present(runs: Runs, square: Square) -> Finding:
    """Smallest bias of a step."""
    biases = np.abs([[step.bias for step in steps] for steps in family(runs, square)])
    share = 100.0 * float(np.mean(biases > 1e-3 * AMPLITUDE))
    least, most = float(biases.min()) * MM, float(biases.max()) * MM
    why = f"{share:.3g} % of the steps end more than 0.1 % away; the biases are {least:.1g} to {most:.2g} mm"
    return decided(share == 100.0, why, ("share with a clear bias", share, "%"), ("smallest", least, "mm"))


@measures_both("bias-under-5-percent")
def bias_under_5_percent(runs: Runs, square: Square) -> Finding:
    """Largest bias of a step in each run; sampled, and with the exact gap, beside it."""
    ours, exact = (_worst_biases(family(runs, square, exact=exact)) for exact in (False, True))
    sampled = _worst_biases([fig15(runs, square, SAMPLED).trace.steps])
    low, high, share = float(ours.min()), float(ours.max()), 100.0 * float(np.mean(ours < 5.0))
    why = (
        f"the worst bias of a run is {low:.2g} to {high:.2g} % of 1 mm, below 5 % in {share:.0f} % of {len(ours)}"
        " runs whose reference amplitudes differ by 0.1 %"
    )
    return decided(
        high < 5.0,
        why,
        ("runs below 5 %", share, "%"),
        ("worst bias", high, "%"),
        ("one run sampled", float(sampled.max()), "%"),
        ("worst with the gap known exactly", float(exact.max()), "%"),
    )


@measures_both("estimate-good-enough")
def good_enough(runs: Runs, square: Square) -> Finding:
    """Settled steps with estimates and with the truth."""
    estimated, exact = (family(runs, square, exact=exact) for exact in (False, True))
    ours, best = (float(np.mean(_settled_counts(each))) for each in (estimated, exact))
    error = math.degrees(max(abs(one.error) for one in fig15(runs, square).estimates))
    why = (
        f"in the mean {ours:.3g} of 10 steps settle with estimates that are off by up to {error:.2g} deg, and"
        f" {best:.3g} with the true gap sent over the same delays"
    )
    return decided(
        ours >= best,
        why,
        *_mean_settled("estimates", estimated),
        *_mean_settled("truth", exact),
        ("largest error", error, "deg"),
    )


@measures("update-delay")
def update_delay(runs: Runs) -> Finding:
    """Measure the delay from each reference change to the tick that applies the update."""
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
    two, whole = (8e3 * max(count) / _RATE_BITS for count in (record.channel_bytes, record.message_bytes))
    why = (
        f"two channels of int16 take {two:.4g} ms; our whole message, which also carries voltage and reference, takes"
        f" {whole:.4g} ms; int16 rounds the position by at most {record.quantisation * 1e6:.2g} µm"
    )
    return decided(
        abs(two - 1.6) < 0.016,
        why,
        ("two channels", two, "ms"),
        ("whole message", whole, "ms"),
        ("rounding", record.quantisation * 1e6, "µm"),
    )


@measures("router-microseconds")
def router(_runs: Runs) -> Finding:
    """Delay of a router, which is not simulated."""
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
    means = {settle: float(np.mean(list(by_gap.values()))) for settle, by_gap in errors.items()}
    why = (
        f"its mean error is {means[0.25]:.2g} deg when 0.25 s are left out, {means[0.3]:.2g} deg for 0.30 s and"
        f" {means[0.4]:.2g} deg for 0.40 s: the observer's leftover transient biases it"
    )
    each = [(f"mean error, gap {gap:g} deg", error, "deg") for gap, error in errors[0.25].items()]
    values = [(f"mean error, {settle:g} s left out", mean, "deg") for settle, mean in means.items()]
    return decided(abs(means[0.25]) < _UNBIASED_DEG, why, *values, *each)


def _settled_counts(runs_steps: Family) -> list[int]:
    """Number of settled steps, for each run."""
    return [sum(step.settled for step in steps) for steps in runs_steps]


def _unsettled_counts(runs_steps: Family) -> dict[int, int]:
    """Number of runs in which a step does not settle, by the step's number; steps that always settle left out."""
    counts = Counter(i for steps in runs_steps for i, step in enumerate(steps, start=1) if not step.settled)
    return dict(sorted(counts.items()))


def _mean_settled(name: str, runs_steps: Family) -> list[tuple[str, float, str]]:
    return [(f"settled steps of 10, {name}", float(np.mean(_settled_counts(runs_steps))), "")]


def _worst_biases(runs_steps: Family) -> Array:
    """Largest bias of a step, in % of 1 mm, for each run."""
    return 100.0 / AMPLITUDE * np.max(np.abs([[step.bias for step in steps] for steps in runs_steps]), axis=1)
