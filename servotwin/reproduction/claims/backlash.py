"""Claims about the gap and the dead zone without a twin (section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servotwin.reproduction import measures as measure
from servotwin.reproduction.claims.registry import Finding, decided, measures, measures_both
from servotwin.reproduction.figures.backlash import PLAY_DEG, fig7_data, fig10b_data
from servotwin.reproduction.measures import MeasuredCycle, MeasuredStep
from servotwin.reproduction.runs import AMPLITUDE, ESTIMATE_DEG, STRESS_DEG, FixedFamilyJob, Runs, Square, Trace

GAPS_DEG = (5.0, 10.0, 15.0)  # Fig 9's, as far as the text tells
_OVER_DEG = np.arange(0.0, ESTIMATE_DEG, 0.5)
_UNDER_DEG = np.arange(ESTIMATE_DEG, STRESS_DEG + 0.25, 0.5)
MM = 1e3


@measures("lost-motion")
def lost_motion(_runs: Runs) -> Finding:
    """Range of theta_m - theta_d, and the screw at rest in between."""
    d = fig7_data()
    lag = np.degrees(d.theta_m - d.theta_d)
    inside = np.abs(lag) < 0.5 * PLAY_DEG - 1e-9
    moved = float(np.degrees(np.abs(np.diff(d.theta_d))[inside[:-1] & inside[1:]].max()))
    span = float(np.ptp(lag))
    why = (
        f"the motor leads and trails by {span:.4g} deg in all, and the screw moves by {moved:.2g} deg while it crosses"
    )
    reproduced = abs(span - PLAY_DEG) < 0.01 and moved == 0.0
    return decided(reproduced, why, ("range of θm - θd", span, "deg"), ("screw's motion inside", moved, "deg"))


@measures("gap-in-eq-16")
def gap_in_eq_16(runs: Runs) -> Finding:
    """Fig 11's angles read as half gaps."""
    total = tuple(2.0 * gap for gap in (0.0, *GAPS_DEG))
    steps = runs.sweep(total)
    why = (
        f"read so, the total gaps are {_list(total)} deg, of which {_settled(total, steps)} settle; Fig 11's runs"
        " settle when the angle is the total gap"
    )
    values = [
        (f"amplitude, total gap {gap:g} deg", step.amplitude * MM, "mm") for gap, step in zip(total, steps, strict=True)
    ]
    return decided(all(step.settled for step in steps), why, *values)


@measures("limit-cycle")
def limit_cycle(runs: Runs) -> Finding:
    """Oscillation at the end of 60 s without a dead zone."""
    cycles = _cycles(runs)
    why = "after 60 s the position still swings by " + ", ".join(
        f"{cycle.amplitude * MM:.3g} mm at {cycle.frequency:.4g} Hz ({gap:g} deg)" for gap, cycle in cycles.items()
    )
    values = [(f"frequency, gap {gap:g} deg", cycle.frequency, "Hz") for gap, cycle in cycles.items()]
    reproduced = all(cycle.amplitude > measure.SETTLED * AMPLITUDE for cycle in cycles.values())
    return decided(reproduced, why, *values, *_amplitudes(cycles))


@measures("limit-cycle-growth")
def limit_cycle_growth(runs: Runs) -> Finding:
    """Amplitude over gap."""
    cycles = _cycles(runs)
    amplitudes = [cycle.amplitude for cycle in cycles.values()]
    ratios = [amplitude / gap * MM for gap, amplitude in zip(cycles, amplitudes, strict=True)]
    why = f"the amplitude is even proportional to the gap: {min(ratios):.5g} to {max(ratios):.5g} mm per deg"
    return decided(bool(np.all(np.diff(amplitudes) > 0.0)), why, *_amplitudes(cycles))


@measures("settle-0-5-10-15")
def settle(runs: Runs) -> Finding:
    """Fig 11."""
    gaps = (0.0, *GAPS_DEG)
    steps = runs.sweep(gaps)
    why = f"the runs with gaps of {_settled(gaps, steps)} deg settle"
    biases = [(f"bias, gap {gap:g} deg", step.bias * MM, "mm") for gap, step in zip(gaps, steps, strict=True)]
    return decided(all(step.settled for step in steps), why, *_worst(steps), *biases)


@measures("over-estimate-stable")
def over_estimate(runs: Runs) -> Finding:
    """Gaps below the estimate; the share over an ensemble beside it."""
    steps = runs.sweep(_OVER_DEG)
    members = [step for gap in (2.0, 5.0, 8.0) for step in runs.ensemble(gap, ESTIMATE_DEG)]
    share = _share(members)
    why = (
        f"{sum(step.settled for step in steps)} of {len(steps)} gaps settle from rest; over other amplitudes and"
        f" initial screw angles {100 * share:.3g} % of {len(members)} runs do"
    )
    return decided(
        all(step.settled for step in steps), why, *_worst(steps), ("share of the ensemble", 100 * share, "%")
    )


@measures("over-estimate-bias")
def over_estimate_bias(runs: Runs) -> Finding:
    """Spread of the biases over the gaps."""
    biases = [step.bias for step in runs.sweep(_OVER_DEG) if step.settled]
    spread = float(np.ptp(biases)) if biases else math.nan
    why = f"over gaps of 0 to 9.5 deg the bias varies from {min(biases) * MM:.3g} to {max(biases) * MM:.3g} mm"
    return decided(spread > 0.01 * AMPLITUDE, why, ("spread of the bias", spread * MM, "mm"))


@measures("bias-not-transparent")
def bias_not_transparent(runs: Runs) -> Finding:
    """Turns of the bias as a function of the gap."""
    biases = [step.bias for step in runs.sweep(_OVER_DEG) if step.settled]
    turns = int(np.count_nonzero(np.diff(np.sign(np.diff(biases)))))
    why = f"over {len(biases)} gaps in steps of 0.5 deg the bias changes its direction {turns} times"
    return decided(not measure.is_monotone(biases), why, ("changes of direction", turns))


@measures("under-estimate-limit")
def under_estimate(runs: Runs) -> Finding:
    """Largest gap up to which all settle, and largest gap that settles."""
    steps = runs.sweep(_UNDER_DEG)
    settled = [step.settled for step in steps]
    first = settled.index(False) if False in settled else len(settled)
    last = max((i for i, yes in enumerate(settled) if yes), default=-1)
    reproduced = 0 < first < len(settled) and last < first
    limit, latest = (float(_UNDER_DEG[i]) if i >= 0 else math.nan for i in (first - 1, last))
    why = f"every gap settles up to {limit:g} deg, and the largest that settles is {latest:g} deg"
    return decided(reproduced, why, ("all settle up to", limit, "deg"), ("largest that settles", latest, "deg"))


@measures("dead-zone-too-small")
def too_small(runs: Runs) -> Finding:
    """Dead zones for 1 and 2 deg with a gap of 10 deg."""
    steps = [runs.settle(10.0, dead_zone) for dead_zone in (1.0, 2.0)]
    why = "they end with amplitudes of " + " and ".join(f"{step.amplitude * MM:.3g} mm" for step in steps)
    values = [(f"amplitude, dead zone for {n} deg", s.amplitude * MM, "mm") for n, s in enumerate(steps, start=1)]
    return decided(not any(step.settled for step in steps), why, *values)


@measures("dead-zone-other-cycle")
def other_cycle(runs: Runs) -> Finding:
    """The limit cycle with and without a small dead zone."""
    without, small = (_cycle(runs.step(10.0, dead_zone)) for dead_zone in (None, 2.0))
    frequency, size = small.frequency / without.frequency, small.amplitude / without.amplitude
    why = f"frequency {small.frequency:.4g} against {without.frequency:.4g} Hz, amplitude {size:.3g} times as large"
    reproduced = abs(frequency - 1.0) > 0.01 and abs(size - 1.0) > 0.01
    return decided(reproduced, why, ("frequency ratio", frequency), ("amplitude ratio", size))


@measures("undriven-inside")
def undriven(runs: Runs) -> Finding:
    """Voltage inside and outside the tolerance."""
    d = fig10b_data(runs)
    inside = np.abs(d.error) < d.tolerance * (1.0 - 1e-9)
    outside = np.abs(d.error) > d.tolerance * (1.0 + 1e-9)
    largest = float(np.abs(d.voltage[inside]).max())
    idle = int(np.count_nonzero(d.voltage[outside] == 0.0))
    share = 100.0 * float(inside.mean())
    why = f"inside (for {share:.3g} % of the first 4 s) the largest voltage is {largest:.2g} V"
    return decided(
        largest == 0.0 and idle <= 1, why, ("largest voltage inside", largest, "V"), ("idle samples outside", idle)
    )


@measures("final-value-biased")
def final_value_biased(runs: Runs) -> Finding:
    """Share of the settled ensemble that ends away from the reference."""
    settled = [step for step in runs.ensemble(10.0, ESTIMATE_DEG) if step.settled]
    biased = [abs(step.bias) > 0.01 * step.reference for step in settled]
    share = float(np.mean(biased)) if biased else math.nan
    why = f"{100 * share:.3g} % of {len(settled)} settled runs end more than 1 % of the step away"
    return decided(share > 0.5, why, ("share biased by more than 1 %", 100 * share, "%"))


@measures("dead-zone-trade-off")
def trade_off(runs: Runs) -> Finding:
    """Settling and bias over the tolerance."""
    factors = (0.5, 1.0, 3.0)
    ensembles = [runs.ensemble(10.0, factor * ESTIMATE_DEG) for factor in factors]
    shares = [100.0 * _share(members) for members in ensembles]
    worst = [_worst_bias(members) * MM for members in ensembles]
    why = (
        f"at 0.5, 1 and 3 times the tolerance of Eq 21 {shares[0]:.3g}, {shares[1]:.3g} and {shares[2]:.3g} % of the"
        f" runs settle, and the worst bias grows from {worst[1]:.3g} mm at once to {worst[2]:.3g} mm at three times"
    )
    values = [(f"settled at {factor:g} times", share, "%") for factor, share in zip(factors, shares, strict=True)]
    biases = [(f"worst bias at {factor:g} times", bias, "mm") for factor, bias in zip(factors, worst, strict=True)]
    return decided(shares[2] > shares[0] and worst[2] > worst[1], why, *values, *biases)


@measures("conservative-band")
def conservative(runs: Runs) -> Finding:
    """Steps just below and just above the tolerance, from rest."""
    moved = {gap: [_largest_angle(runs, gap, share) for share in (0.99, 1.01)] for gap in (10.0, 20.0)}
    bands = {gap: runs.servo.tolerance_for(math.radians(gap)) * MM for gap in moved}
    reproduced = all(below == 0.0 < above for below, above in moved.values())
    why = (
        "errors of up to "
        + " and ".join(f"{band:.3g} mm ({gap:g} deg)" for gap, band in bands.items())
        + " go unanswered"
    )
    return decided(reproduced, why, *[(f"band for {gap:g} deg", band, "mm") for gap, band in bands.items()])


@measures_both("lost-near-17")
def lost_near_17(runs: Runs, square: Square) -> Finding:
    """Fig 12; the stress case beside it."""
    steps, stress = runs.wear(square).steps, runs.wear(square, STRESS_DEG).steps
    members = runs.get(FixedFamilyJob(runs.preset, square))
    share = 100.0 * float(np.mean([_lost_near_17(member) for member in members]))
    why = f"{_lost_steps(steps)}; with the gap growing to {STRESS_DEG:g} deg: {_lost_steps(stress)}"
    alike = (f"the same in {len(members)} runs with amplitudes 0.1 % apart", share, "%")
    return decided(_lost_near_17(steps), why, *_loss("", steps), *_loss("to 30 deg: ", stress), alike)


def _lost_near_17(steps: Sequence[MeasuredStep]) -> bool:
    """Decide: all settle up to a step that meets 16 to 18 deg, and none from there on."""
    settled = [step.settled for step in steps]
    first = settled.index(False) if False in settled else len(steps)
    return 0 < first < len(steps) and not any(settled[first:]) and _around_17(steps[first])


def _around_17(step: MeasuredStep) -> bool:
    """Decide: the gap at the begin or the end of a step is 16 to 18 deg."""
    return any(16.0 <= math.degrees(gap) <= 18.0 for gap in (step.gap_begin, step.gap_end))


def _lost_steps(steps: Sequence[MeasuredStep]) -> str:
    """Word the steps that did not settle, and the gap where the first of them begins."""
    lost = [i for i, step in enumerate(steps) if not step.settled]
    if not lost:
        return "every step settles"
    names = ", ".join(str(i + 1) for i in lost)
    first = math.degrees(steps[lost[0]].gap_begin)
    return f"not settled are the steps {names}, the first of which begins at {first:.3g} deg"


def _loss(prefix: str, steps: Sequence[MeasuredStep]) -> list[tuple[str, float, str]]:
    lost = [step for step in steps if not step.settled]
    gap = math.degrees(lost[0].gap_begin) if lost else math.nan
    return [(f"{prefix}steps not settled", len(lost), ""), (f"{prefix}gap where the first begins", gap, "deg")]


def _cycle(trace: Trace) -> MeasuredCycle:
    """The oscillation over the last half of the run."""
    last = measure.tail(trace.time, float(trace.time[-1]), 30.0)
    return measure.limit_cycle(trace.time[last], trace.position[last])


def _cycles(runs: Runs) -> dict[float, MeasuredCycle]:
    return {gap: _cycle(runs.step(gap)) for gap in GAPS_DEG}


def _amplitudes(cycles: dict[float, MeasuredCycle]) -> list[tuple[str, float, str]]:
    return [(f"amplitude, gap {gap:g} deg", cycle.amplitude * MM, "mm") for gap, cycle in cycles.items()]


def _largest_angle(runs: Runs, gap: float, share: float) -> float:
    """Largest angle of the motor after a step of `share` tolerances with that gap, rad."""
    tolerance = runs.servo.tolerance_for(math.radians(gap))
    return runs.reaction(gap, share * tolerance)


def _list(gaps: Sequence[float]) -> str:
    return ", ".join(f"{gap:g}" for gap in gaps)


def _settled(gaps: Sequence[float], steps: Sequence[MeasuredStep]) -> str:
    return _list([gap for gap, step in zip(gaps, steps, strict=True) if step.settled]) or "none"


def _share(members: Sequence[MeasuredStep]) -> float:
    return float(np.mean([step.settled for step in members]))


def _worst_bias(members: Sequence[MeasuredStep]) -> float:
    """Largest bias of the settled members, m."""
    return max((abs(step.bias) for step in members if step.settled), default=math.nan)


def _worst(steps: Sequence[MeasuredStep]) -> list[tuple[str, float, str]]:
    return [("largest amplitude at the end", max(step.amplitude for step in steps) * MM, "mm")]
