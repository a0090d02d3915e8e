"""Sensor noise: its standard deviation in closed form, its band, and that blocks make no difference."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from servotwin.errors import InvalidInput
from servotwin.plant.noise import Noise, noise_gain, state_space

RATE = 5000.0


def test_the_paper_s_filter() -> None:
    """Erratum E18: about a fourth-order Butterworth near 42 Hz, at least 40 dB down at 10 Hz, at most 1 dB at 50 Hz."""
    sections = Noise(0.22e-3).filter(RATE)
    assert len(sections) == 2
    _, at = signal.sosfreqz(sections, worN=np.array([10.0, 42.2336, 50.0, 2400.0]), fs=RATE)
    decibels = 20.0 * np.log10(np.abs(at) / np.abs(at[-1]))
    assert decibels[0] < -40.0
    assert decibels[1] == pytest.approx(-3.0, abs=0.05)
    assert -1.0 <= decibels[2] < 0.0


@given(stop=st.floats(1.0, 50.0), ratio=st.floats(1.5, 10.0), rate=st.floats(1200.0, 20000.0))
def test_noise_gain_agrees_with_the_impulse_response(stop: float, ratio: float, rate: float) -> None:
    sections = Noise(1.0, (stop, stop * ratio)).filter(rate)
    impulse = np.zeros(200_000)
    impulse[0] = 1.0
    response = signal.sosfilt(sections, impulse)
    assert np.sum(response**2) == pytest.approx(1.0, rel=1e-6)
    assert noise_gain(sections) == pytest.approx(1.0, rel=1e-6)


def test_state_space_agrees_with_scipy() -> None:
    sections = Noise(1.0).filter(RATE)
    A, B, C, D = state_space(sections)
    _, response = signal.dimpulse((A, B[:, None], C[None, :], D, 1.0 / RATE), n=400)
    impulse = np.zeros(400)
    impulse[0] = 1.0
    np.testing.assert_allclose(response[0][:, 0], signal.sosfilt(sections, impulse), atol=1e-13)


@pytest.mark.parametrize("noise", [Noise(0.22e-3), Noise(0.22e-3, kind="white"), Noise(3.0, (100.0, 400.0))])
def test_long_samples_have_the_stated_standard_deviation(noise: Noise) -> None:
    drawn = noise.samples(1_000_000, RATE, np.random.default_rng(7))
    assert np.std(drawn) == pytest.approx(noise.std, rel=5e-3)
    assert np.mean(drawn) == pytest.approx(0.0, abs=5e-3 * noise.std)


@pytest.mark.slow
def test_noise_is_stationary_from_the_first_sample() -> None:
    runs = np.array([Noise(1.0).samples(60, RATE, np.random.default_rng(seed)) for seed in range(1000)])
    np.testing.assert_allclose(np.std(runs, axis=0), 1.0, atol=5.0 / math.sqrt(2 * 1000))


def test_the_spectrum_is_the_filter_s() -> None:
    drawn = Noise(1.0).samples(500_000, RATE, np.random.default_rng(3))
    frequency, density = signal.welch(drawn, RATE, nperseg=5000, detrend=False)
    assert np.mean(density[frequency <= 10.0]) < 1e-4 * np.mean(density[frequency >= 100.0])


@given(st.lists(st.integers(0, 200), min_size=1, max_size=6), st.sampled_from(["highpass", "white"]))
def test_block_sizes_do_not_change_the_noise(sizes: list[int], kind: str) -> None:
    noise = Noise(0.22e-3, kind=kind)  # type: ignore[arg-type]
    source = noise.source(RATE, np.random.default_rng(5))
    pieces = np.concatenate([source.block(size) for size in sizes])
    np.testing.assert_array_equal(pieces, noise.samples(sum(sizes), RATE, np.random.default_rng(5)))


def test_the_seed_decides_the_noise_and_std_scales_it() -> None:
    one = Noise(1.0).samples(100, RATE, np.random.default_rng(1))
    assert not np.array_equal(one, Noise(1.0).samples(100, RATE, np.random.default_rng(2)))
    np.testing.assert_array_equal(Noise(0.5).samples(100, RATE, np.random.default_rng(1)), 0.5 * one)
    np.testing.assert_array_equal(Noise(0.0).samples(100, RATE, np.random.default_rng(1)), np.zeros(100))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Noise(-1.0), "noise std = -1.0 m: must be a number, at least 0, finite"),
        (lambda: Noise(math.nan), "noise std = nan m"),
        (
            lambda: Noise(1.0, (50.0, 10.0)),
            r"noise band = \(50.0, 10.0\) Hz: must be two numbers, .*, the lower one",
        ),
        (lambda: Noise(1.0, (0.0, 10.0)), "noise band"),
        (lambda: Noise(1.0, kind="pink"), "noise kind = 'pink'"),  # type: ignore[arg-type]
        (lambda: Noise(1.0).filter(90.0), "below half the sample rate of 90.0 Hz"),
    ],
)
def test_bad_noise_settings_are_refused(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidInput, match=message):
        make()
