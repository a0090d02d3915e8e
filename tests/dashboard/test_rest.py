"""Word on the end of a window: rest, a swing that dies away, a limit cycle."""

import numpy as np
import pytest

from servotwin.dashboard.rest import at_rest
from servotwin.messages import WindowMessage, checksum, pack_channel


def window_of(position, changes=((0.0, 1e-3),), begun=10):
    reference = np.full(position.size, 1e-3)
    reference[:begun] = -1e-3
    channels = tuple(pack_channel(name, "m", each) for name, each in (("reference", reference), ("position", position)))
    return WindowMessage("s", "b", 0, 0.0, 100.0, channels, changes, 0, "", "reference", checksum(channels))


SECONDS = np.arange(800) / 100.0


@pytest.mark.parametrize(
    ("motion", "word"),
    [
        (1e-3 + 2e-4 * np.sin(2 * np.pi * 1.5 * SECONDS), "limit cycle"),
        (1e-3 + 2e-3 * np.exp(-0.4 * SECONDS) * np.sin(2 * np.pi * 1.5 * SECONDS), "swings down"),
        (1e-3 + 1e-3 * np.exp(-3.0 * SECONDS), "rest"),
        (1e-3 + 1e-4 * SECONDS, "not seen"),
    ],
)
def test_a_machine_rests_swings_down_or_goes_on_swinging(motion, word):
    found = at_rest(window_of(motion))
    assert found["word"] == word
    assert found["seconds"] == 8.0
    if word == "limit cycle":
        assert found["swing"] == pytest.approx(2e-4, rel=0.01)
        assert found["frequency"] == pytest.approx(1.5, rel=0.1)
    late = window_of(motion[20:], begun=0)  # it begins with the change
    assert at_rest(late)["word"] == word
    assert at_rest(window_of(motion, ((7.9, 1e-3),)))["word"] == "not seen"


@pytest.mark.parametrize(("amplitude", "word"), [(0.0, "noise"), (0.4e-3, "limit cycle"), (1e-3, "limit cycle")])
def test_noise_of_the_encoder_is_no_limit_cycle(amplitude, word):
    random = np.random.default_rng(0)
    motion = 1e-3 + amplitude * np.sin(2 * np.pi * 1.5 * SECONDS)
    for _ in range(200):
        found = at_rest(window_of(motion + 5e-5 * random.standard_normal(motion.size), begun=30))
        assert found["word"] == word
    if word == "limit cycle":
        assert found["frequency"] == pytest.approx(1.5, rel=0.1)
