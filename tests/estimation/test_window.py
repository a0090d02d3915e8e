"""Windows say what is wrong with their samples, and where."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.estimation.window import MINIMUM_SAMPLES, Window

RAMP = np.linspace(0.0, 1.0, 50)


def test_keeps_its_samples_read_only():
    samples = RAMP.copy()
    window = Window(samples, theta_m=list(samples), sample_rate=100.0, start=2.0)
    samples[0] = 7.0
    assert window.position[0] == 0.0
    assert set(window.channels) == {"position", "theta_m"}
    with pytest.raises(ValueError, match="read-only"):
        window.position[0] = 1.0


def test_a_window_has_its_sample_times():
    window = Window(RAMP, sample_rate=100.0, start=2.0)
    assert window.duration == 0.5
    assert window.mid_time == pytest.approx(2.245, abs=1e-12)
    assert np.array_equal(window.time, 2.0 + np.arange(50) / 100.0)


def test_time_stamps_give_rate_and_start_even_when_rounded():
    stamps = np.round(3.0 + np.arange(50) / 3000.0, 5)
    window = Window(RAMP, time=stamps)
    assert window.start == 3.0
    assert window.sample_rate == pytest.approx(3000.0, rel=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["position", "theta_m", "voltage", "reference"])
def test_names_the_sample_that_is_not_finite(name, bad):
    channels = {"position": RAMP, name: np.where(np.arange(50) == 31, bad, RAMP)}
    with pytest.raises(InvalidInput, match=rf"log\.csv: {name}\[31\] = .*must be a finite number"):
        Window(**channels, sample_rate=100.0, source="log.csv")


def test_names_the_sample_whose_square_is_no_number():
    with pytest.raises(InvalidInput, match=r"position\[31\] = -1e\+200 m: every .* number of at most 1e\+100"):
        Window(np.where(np.arange(50) == 31, -1e200, RAMP), sample_rate=100.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"theta_m": RAMP[:-1]}, "theta_m has 49 samples and position 50: must be equally many"),
        ({"position": RAMP[: MINIMUM_SAMPLES - 1]}, r"position has shape \(15,\): must be \(n,\) with n >= 16 samples"),
        ({"position": RAMP.reshape(2, 25)}, r"position has shape \(2, 25\)"),
        ({"position": ["a"] * 50}, "position must be an array of numbers in m"),
        ({"sample_rate": None}, "exactly one of sample_rate"),
        ({"time": RAMP}, "exactly one of sample_rate"),
        ({"sample_rate": 0.0}, "sample_rate = 0.0 Hz: must be greater than 0"),
        ({"sample_rate": math.nan}, "sample_rate = nan Hz: must be a finite number"),
        ({"sample_rate": "fast"}, "sample_rate = 'fast' Hz: must be a finite number"),
        ({"start": math.inf}, "start = inf s: must be a finite number"),
        ({"sample_rate": None, "time": RAMP[::-1]}, "uniformly spaced"),
        (
            {"sample_rate": None, "time": np.delete(np.arange(53.0), [30, 31, 32])},
            r"time\[30\] = 33.0 s, 4 s after the sample before: must be finite, increasing, uniformly spaced",
        ),
        ({"sample_rate": None, "time": RAMP**2}, r"time\[1\] = .* uniformly spaced"),
        ({"sample_rate": None, "time": np.append(RAMP[:-1], np.nan)}, r"time\[49\] = nan s: must be finite"),
        ({"sample_rate": None, "time": np.zeros(50)}, r"time\[.*\] = 0.0 s, .*: must be .* increasing"),
        ({"sample_rate": None, "time": RAMP[:-1]}, r"time has shape \(49,\) and position \(50,\)"),
        ({"sample_rate": None, "time": RAMP, "start": 1.0}, "start = 1.0 s: must be left out"),
    ],
)
def test_bad_input_is_one_sentence(arguments, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        Window(**{"position": RAMP, "sample_rate": 100.0, **arguments})
    assert "\n" not in str(caught.value)


@given(st.integers(0, 30), st.integers(MINIMUM_SAMPLES, 20))
def test_slices_on_its_own_clock(first, count):
    window = Window(RAMP, theta_m=2.0 * RAMP, sample_rate=100.0, start=5.0)
    part = window.slice(5.0 + first / 100.0, count / 100.0)
    assert np.array_equal(part.position, RAMP[first : first + count])
    assert np.array_equal(part.theta_m, 2.0 * RAMP[first : first + count])
    assert part.start == pytest.approx(5.0 + first / 100.0, abs=1e-12)


def test_a_slice_must_lie_inside():
    with pytest.raises(InvalidInput, match=r"0\.4 s from 5\.2 s does not lie within .* from 5 s to 5\.5 s"):
        Window(RAMP, sample_rate=100.0, start=5.0).slice(5.2, 0.4)


def test_cut_from_a_run_it_holds_what_the_sensors_gave():
    channels = {"position": RAMP + 1.0, "theta_m": RAMP + 2.0, "voltage": RAMP + 3.0, "reference": RAMP + 4.0}
    run = SimpleNamespace(time=np.arange(50) / 100.0, sample_rate=100.0, measured=channels.__getitem__)
    window = Window.from_run(run, start=0.1, duration=0.2)
    assert (window.sample_rate, window.start) == (100.0, 0.1)
    for name, samples in channels.items():
        assert np.array_equal(getattr(window, name), samples[10:30])


def test_replacing_a_channel_validates_again():
    window = Window(RAMP, sample_rate=100.0)
    assert np.array_equal(window.replace(position=RAMP + 1.0).position, RAMP + 1.0)
    with pytest.raises(InvalidInput, match="finite"):
        window.replace(position=RAMP * np.nan)


def test_a_position_that_is_the_motor_s_angle_times_the_ratio_follows_it() -> None:
    angle = np.sin(np.linspace(0.0, 20.0, 4000))
    own = Window(1e-3 * angle + 0.02, angle, sample_rate=1000.0)
    counted = Window(1e-3 * angle + 1e-6 * (np.arange(4000) % 2), angle, sample_rate=1000.0)
    assert own.follows_motor(1e-3)
    assert not own.follows_motor(1.001e-3)
    assert not counted.follows_motor(1e-3)
    assert counted.follows_motor(1e-3, within=1e-6)
    assert not Window(1e-3 * angle, sample_rate=1000.0).follows_motor(1e-3)
    assert not Window(theta_m=angle, sample_rate=1000.0).follows_motor(1e-3)
