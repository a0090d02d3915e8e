"""The ratio of a rigid screw, which does not wear, learnt by a twin across windows."""

import math
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.signals import Array
from servotwin.twin.estimating import estimator_of
from servotwin.twin.settings import TwinSettings

STAGE, GAP, RATIO = Axis.preset("stepper-stage"), math.radians(2.0), 1.003
TWO_PLACES, MANY_PLACES = (1.0, -1.0, 1.0), (1.0, -0.6, 0.2, -1.0, 0.8, -0.3, 1.0)


def creeping(places: Sequence[float]) -> Array:
    """Motor's angle (N,) of an axis that goes to places, shares of 150 um, 1 s each."""
    ends, time = 150e-6 / STAGE.p * np.array(places), np.arange(1000) / 1000.0
    parts = [b + (a - b) * np.exp(-8.0 * time) for a, b in pairwise(ends)]
    return np.concatenate(parts)


def window(places: Sequence[float], start: float, growth: float = 0.0) -> Window:
    """What the encoders of a stage show whose screw is 0.3 % off its lead, the gap growing by a share of itself."""
    angle = creeping(places)
    gap = GAP * (1.0 + growth * np.linspace(-0.5, 0.5, angle.size))
    position = RATIO * STAGE.p * play(angle, gap, angle[0])
    counts = STAGE.sensors.position_resolution, STAGE.sensors.encoder_resolution
    seen = [step * np.round(values / step) for step, values in zip(counts, (position, angle), strict=True)]
    return Window(*seen, sample_rate=1000.0, start=start)


@pytest.mark.slow
def test_one_window_of_moves_of_different_lengths_makes_steps_between_two_places_tell_the_gap() -> None:
    """Alone these do not tell gap from ratio; five fits of a second each."""
    settings = TwinSettings(policy="paper", k_dz=0.0)
    estimator, wear, statuses = estimator_of(STAGE, settings), Wear(0.0), []
    for number, places in enumerate((TWO_PLACES, MANY_PLACES, TWO_PLACES, TWO_PLACES)):
        seen = window(places, 1000.0 * number)
        now = seen.mid_time
        estimate = estimator(seen, wear.expect(settings.trend, "boot", now, now, settings.learning))
        wear, _ = wear.update(settings.trend, "boot", estimate, now, settings.learning)
        statuses.append(estimate.status)
        if estimate.ok:
            assert estimate.interval[0] <= GAP <= estimate.interval[1]
            assert abs(estimate.gap / GAP - 1.0) < 0.02
        # Windows of two places tell the ratio no better, and their errors repeat: they do not count.
        assert (estimate.machine is not None) == (places is MANY_PLACES)
    assert statuses == [GapStatus.UNIDENTIFIABLE, GapStatus.OK, GapStatus.OK, GapStatus.OK]
    learnt = wear.known_machine(LearningSettings(), 4000.0)
    assert learnt is not None
    mean, std = learnt.pitch
    assert abs(mean - math.log(RATIO)) < 3.0 * std < 1e-3


@cache
def taught_pitch(growth: float) -> tuple[float, float]:
    """Logarithm of the ratio and its spread after moves of different lengths in a gap that grows."""
    settings = TwinSettings(policy="paper", k_dz=0.0)
    expected = Wear(0.0).expect(settings.trend, "boot", 1.0, 1.0, settings.learning)
    told = estimator_of(STAGE, settings)(window(MANY_PLACES, 0.0, growth), expected).machine
    assert told is not None
    return FactorPrior.of_reading(told).pitch


@pytest.mark.slow
@pytest.mark.parametrize("growth", [0.05, 0.14])
def test_a_gap_that_grows_while_moves_teach_the_ratio_widens_what_is_learnt(growth: float) -> None:
    """What it grows by would be taken for ratio, and later gaps be wrong with narrow intervals."""
    still, grown = taught_pitch(0.0), taught_pitch(growth)
    for mean, std in (still, grown):
        assert abs(mean - math.log(RATIO)) < 2.0 * std
    assert still[1] < 1e-4
    assert grown[1] > 2.0 * still[1]


def test_a_ratio_that_is_stated_better_is_known_so() -> None:
    """Two places tell the gap where the lead is stated to 0.02 %."""
    sure = TwinSettings(policy="paper", k_dz=0.0, learning=LearningSettings(pitch=2e-4))
    angle = creeping(TWO_PLACES)
    seen = window(TWO_PLACES, 0.0)
    exact = Window(seen.position / RATIO, angle, sample_rate=1000.0)
    known = Wear(0.0).expect(sure.trend, "boot", 1.0, 1.0, sure.learning)
    assert estimator_of(STAGE, sure)(exact, known).ok
    assert not estimator_of(STAGE, TwinSettings(policy="paper", k_dz=0.0))(exact, known).ok
