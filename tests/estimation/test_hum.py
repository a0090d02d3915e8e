"""Hum on the position: a sine that the fit takes as its own, and not as noise."""

import math

import numpy as np

import servotwin as st
from servotwin.estimation.whitened.hum import hum, sines

SAMPLES, LEAST = 300, 0.3


def test_a_sine_in_noise_is_found_at_its_frequency() -> None:
    """Within a tenth of what the window tells apart; nothing is left of it."""
    rng = np.random.default_rng(4)
    for frequency in rng.uniform(0.4, 2.8, 20).tolist():
        series = 5.0 * np.sin(frequency * np.arange(SAMPLES) + rng.uniform(0.0, 6.0)) + rng.normal(0.0, 1.0, SAMPLES)
        (found,) = hum(series, 16, LEAST)
        assert abs(found - frequency) < 0.1 * 2.0 * math.pi / SAMPLES
        rows = sines((found,), SAMPLES)
        rest = series - np.linalg.lstsq(rows.T, series, rcond=None)[0] @ rows
        assert abs(np.std(rest) - 1.0) < 0.2


def test_noise_without_a_sine_shows_none() -> None:
    """White, and coloured as the decimated residual of a window may be; nor does a sine among the structure's modes."""
    rng, time = np.random.default_rng(5), np.arange(SAMPLES)
    for _ in range(100):
        white = rng.normal(0.0, 1.0, SAMPLES)
        coloured = np.convolve(rng.normal(0.0, 1.0, SAMPLES + 40), 0.9 ** np.arange(40), "valid")[:SAMPLES]
        assert hum(white, 16, LEAST) == hum(coloured, 16, LEAST) == ()
    assert hum(5.0 * np.sin(0.1 * time) + white, 16, LEAST) == ()


def test_hum_leaves_the_spread_of_the_gap_as_it_is_without() -> None:
    """An autoregression that follows the hum errs in the level of the noise beside it: 12 % in half of 16 windows."""
    servo = st.Servo.preset("paper")
    run = st.simulate(servo, 8.0, reference=st.SquareWave(1e-3, 10.0), gap=math.radians(10.0))
    window = st.Window.from_run(run, start=5.0, duration=1.0)
    time, ratios = np.arange(window.position.size) / window.sample_rate, []
    for seed in range(16):
        noise = np.random.default_rng(seed).normal(0.0, 1e-6, time.size)
        clean = st.estimate_gap(window.replace(position=window.position + noise), servo)
        humming = 5e-6 * np.sin(2.0 * math.pi * 50.0 * time)
        with_hum = st.estimate_gap(window.replace(position=window.position + noise + humming), servo)
        assert clean.ok
        assert with_hum.ok
        assert abs(with_hum.gap - clean.gap) < 0.5 * clean.std
        ratios.append(with_hum.std / clean.std)
    assert np.median(np.abs(np.log(ratios))) < 0.05
