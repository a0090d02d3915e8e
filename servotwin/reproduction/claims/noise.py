"""Claims about the loop with its twin and measurement noise (section 4.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import signal

import servotwin as st
from servotwin.reproduction.claims.registry import Finding, decided, measures, measures_both
from servotwin.reproduction.measures import Array
from servotwin.reproduction.runs import AMPLITUDE, BIPOLAR, PERIOD, RATE, Runs, Square
from servotwin.reproduction.twin_runs import NOISY, SAMPLED, SEEDS, TwinJob, TwinRun

MM = 1e3
NOISE = st.Noise(std=0.22e-3, band=(10.0, 50.0))  # section 4.3


def noisy(runs: Runs, square: Square = BIPOLAR, k_dz: float = 1.0) -> list[TwinRun]:
    """Fig 16's run for every seed."""
    return [runs.get(TwinJob(runs.preset, NOISY, square, seed, k_dz)) for seed in SEEDS]


def quiet(runs: Runs, square: Square = BIPOLAR) -> TwinRun:
    """Fig 16's loop without its noise: Fig 15 sampled."""
    return runs.get(TwinJob(runs.preset, SAMPLED, square))


def deviations(records: Sequence[TwinRun]) -> Array:
    """(10,) m: standard deviation of the position over the last 5 s of each step, median over the seeds."""
    return np.median([[step.deviation for step in record.trace.steps] for record in records], axis=0)


@measures_both("snr-20-db")
def snr(_runs: Runs, square: Square) -> Finding:
    """Reference and noise, drawn and measured."""
    noise, reference = _rms(_noise()), _rms(_alternating(square))
    ratio = 20.0 * math.log10(reference / noise)
    why = f"noise of {noise * MM:.3g} mm rms under a reference of {reference * MM:.3g} mm rms makes {ratio:.3g} dB"
    return decided(abs(ratio - 20.0) < 1.0, why, ("signal to noise", ratio, "dB"), ("noise", noise * MM, "mm"))


@measures_both("quarter-of-step")
def quarter(_runs: Runs, square: Square) -> Finding:
    """Noise over the size of a step of the reference."""
    size = float(np.ptp(_alternating(square)))
    ratio = _rms(_noise()) / size
    why = f"the noise is {ratio:.3g} of a step of {size * MM:.3g} mm"
    return decided(0.2 < ratio < 0.3, why, ("noise over step", ratio))


@measures("noise-spectrum")
def spectrum(_runs: Runs) -> Finding:
    """Spectral density below 10 Hz against above 50 Hz."""
    frequency, density = signal.welch(_noise(), RATE, nperseg=1 << 14)
    stop = float(density[(frequency > 0.5) & (frequency < 10.0)].max())
    passed = float(density[frequency > 50.0].mean())
    attenuation = 10.0 * math.log10(passed / stop)
    order = len(NOISE.filter(RATE)) * 2
    why = f"up to 10 Hz the density lies at least {attenuation:.3g} dB under its mean above 50 Hz (order {order})"
    return decided(attenuation >= 40.0, why, ("attenuation", attenuation, "dB"))


@measures_both("noise-linear-negligible")
def linear_negligible(runs: Runs, square: Square) -> Finding:
    """The first step."""
    noisy_std, without = (float(deviations(records)[0]) for records in (noisy(runs, square), [quiet(runs, square)]))
    why = (
        f"in the last 5 s of step 1 the position's standard deviation is {noisy_std * MM:.2g} mm ({without * MM:.2g} mm"
        f" without noise), under a measurement noise of {NOISE.std * MM:.2g} mm"
    )
    return decided(
        noisy_std < 0.02 * AMPLITUDE,
        why,
        ("standard deviation, step 1", noisy_std * MM, "mm"),
        ("without noise", without * MM, "mm"),
    )


@measures_both("noise-steps-4-5")
def steps_4_and_5(runs: Runs, square: Square) -> Finding:
    """Steps 4 and 5 with and without noise."""
    noisy_stds, without = deviations(noisy(runs, square))[3:5], deviations([quiet(runs, square)])[3:5]
    reproduced = bool(np.all(noisy_stds > 0.005 * AMPLITUDE) and np.all(noisy_stds > 2.0 * without))
    why = (
        f"standard deviations of {noisy_stds[0] * MM:.2g} and {noisy_stds[1] * MM:.2g} mm, against"
        f" {without[0] * MM:.1g} and {without[1] * MM:.1g} mm without noise"
    )
    values = [(f"standard deviation, step {i}", value * MM, "mm") for i, value in zip((4, 5), noisy_stds, strict=True)]
    return decided(reproduced, why, *values)


@measures_both("noise-larger-dead-zone")
def larger_dead_zone(runs: Runs, square: Square) -> Finding:
    """Late steps against steps 4 and 5."""
    stds = deviations(noisy(runs, square))
    early, late = float(stds[3:5].mean()), float(stds[7:10].mean())
    why = f"the mean standard deviation is {early * MM:.2g} mm in steps 4 and 5 and {late * MM:.2g} mm in steps 8 to 10"
    return decided(late < early, why, *_each(stds))


@measures_both("noise-larger-gain")
def larger_gain(runs: Runs, square: Square) -> Finding:
    """k_DZ = 2 against 1 in steps 4 and 5."""
    once, twice = (float(deviations(noisy(runs, square, k_dz))[3:5].mean()) for k_dz in (1.0, 2.0))
    why = (
        f"the mean standard deviation of steps 4, 5 is {twice * MM:.2g} mm with k_DZ = 2 and {once * MM:.2g} mm with 1"
    )
    return decided(twice < once, why, ("k_DZ = 1", once * MM, "mm"), ("k_DZ = 2", twice * MM, "mm"))


@measures_both("noise-estimate-biased")
def estimate_biased(runs: Runs, square: Square) -> Finding:
    """Mean error of the estimates from steps 3 to 10."""
    mean, error = _bias(noisy(runs, square))
    reproduced = 2.0 * error < abs(mean) < 2.0
    why = f"the mean error over steps 3 to 10 and {len(SEEDS)} seeds is {mean:.2g} deg (standard error {error:.1g} deg)"
    return decided(reproduced, why, ("mean error", mean, "deg"), ("standard error", error, "deg"))


@measures_both("noise-bias-from-noise")
def bias_from_noise(runs: Runs, square: Square) -> Finding:
    """The same against the run without noise."""
    (mean, error), (without, error_without) = (_bias(each) for each in (noisy(runs, square), [quiet(runs, square)]))
    joint = math.hypot(error, error_without)
    reproduced = abs(mean) - abs(without) > 2.0 * joint
    why = f"the mean error is {mean:.2g} deg with noise and {without:.2g} deg without (difference known to {joint:.1g})"
    return decided(
        reproduced,
        why,
        ("with noise", mean, "deg"),
        ("without", without, "deg"),
        ("joint standard error", joint, "deg"),
    )


@measures_both("noise-copes")
def copes(runs: Runs, square: Square) -> Finding:
    """Largest swing at the end of any step."""
    amplitudes = [[step.amplitude for step in record.trace.steps] for record in noisy(runs, square)]
    worst, count = float(np.max(amplitudes)), np.size(amplitudes)
    loud = int(np.count_nonzero(np.array(amplitudes) >= 0.1 * AMPLITUDE))
    percent = 100.0 * worst / AMPLITUDE
    why = f"at the end of a step the position swings by up to {percent:.3g} % of 1 mm; {loud} of {count} exceed 10 %"
    return decided(loud == 0, why, ("largest amplitude", worst * MM, "mm"), ("steps over 10 %", loud))


def _bias(records: Sequence[TwinRun]) -> tuple[float, float]:
    """Mean and standard error of the estimates' errors from step 3 on, deg."""
    errors = np.degrees([one.error for record in records for one in record.estimates[2:]])
    return float(errors.mean()), float(errors.std(ddof=1) / math.sqrt(errors.size))


def _each(stds: Array) -> list[tuple[str, float, str]]:
    return [(f"standard deviation, step {i}", float(value) * MM, "mm") for i, value in enumerate(stds, start=1)]


def _noise() -> Array:
    """200 s of the noise."""
    return NOISE.samples(round(200.0 * RATE), RATE, np.random.default_rng(SEEDS[0]))


def _alternating(square: Square) -> Array:
    """One period of the reference about its mean, at 1 kHz."""
    values = square.signal.pieces(PERIOD).value(np.arange(0.0, PERIOD, 1e-3))
    return np.asarray(values - values.mean())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
