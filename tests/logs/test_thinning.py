"""Thinned logs: stretches at the full rate, and what a play remembers of the rest."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import recording

from servotwin.estimation.driven_load.estimate import gap_of_driven_load
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.logs.gathering import THINNED, Gathering
from servotwin.logs.thinning import Stretches, play_extremes
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate


@pytest.mark.random
@pytest.mark.parametrize("seed", range(20))
def test_a_play_ends_where_it_ends_on_all_samples(seed):
    random = np.random.default_rng(seed)
    motor = np.cumsum(random.standard_normal(400)) + 0.3 * random.standard_normal(400)
    table = play_extremes(np.column_stack([np.arange(400.0), motor]))
    assert len(table) < 60
    assert np.all(np.diff(table[:, 0]) > 0.0)
    assert table[-1, 0] == 399.0
    for gap in random.uniform(0.0, 0.9, 10) * np.ptp(motor):
        assert play(table[:, 1], gap)[-1] == pytest.approx(play(motor, gap)[-1])


def test_a_machine_at_rest_leaves_two_samples():
    chatter = np.where(np.arange(1000) % 3 == 1, 1e-3, 0.0)
    assert len(play_extremes(np.column_stack([np.arange(1000.0), chatter]))) == 2
    assert len(play_extremes(np.zeros((1000, 2)))) == 1


def test_stretches_stay_whole_and_the_more_lively_of_two_stays():
    kept = Stretches(1600)
    time = np.arange(20_000.0)
    motor = np.where(time // 100 % 4 == 2, np.sin(time / 30.0), 0.0)
    for part in np.array_split(np.column_stack([time, motor]), 33):
        kept.add(part)
    table, alone = kept.thinned()
    assert len(table) <= 1600
    assert len(table) + kept.dropped == 20_000
    whole = table[~alone]
    assert np.all(np.diff(table[:, 0]) > 0.0)
    assert np.mean(np.diff(whole[:, 0]) == 1.0) > 0.98
    assert np.mean(whole[:, 1] != 0.0) > 0.8
    # As many from each part of the log, whenever it was read.
    counts, _ = np.histogram(whole[:, 0], 4, (0.0, 20_000.0))
    assert counts.max() < 1.6 * counts.min()


@pytest.mark.parametrize(("lag", "speed"), [(3e-3, 1.0), (12e-3, 3.0)])
def test_a_lag_far_below_the_steps_of_a_thinned_log_is_found(lag, speed):
    # Every third of the highest, lowest and first of six samples left 27 ms between them, and no answer.
    made = recording(gap=0.05, ratio=0.1, lag=lag, seconds=120.0, rate=1000.0, speed=speed)
    gathering = Gathering({}, 6000)
    for part in np.array_split(np.arange(made.time.size), 40):
        gathering.add(made.time[part], {"motor": made.motor[part], "load": made.load[part]})
    clean = gathering.cleaned()
    assert clean.found[THINNED] > 0.94 * made.time.size
    motor, load = clean.channels["motor"], clean.channels["load"]
    found = estimate_lost_motion(
        EncoderRecording(clean.time, motor, load, motor_count=1e-3, load_count=1e-6, alone=clean.alone)
    )
    assert found.ok, found.reasons
    low, high = found.interval_motor
    assert low < 0.05 < high < low + 0.003
    assert found.lag == pytest.approx(lag, abs=2e-4)


@pytest.mark.slow
def test_a_log_of_an_hour_shows_the_swinging_load_that_five_minutes_show():
    # Stretches of a second held no stroke of this motion: an hour was refused, where 60 s of it told the gap.
    run = simulate(Axis.preset("two-mass-drive"), 300.0, reference=SquareWave(0.2, 4.0), gap=0.02, sample_rate=1000.0)
    gathering = Gathering({})
    for part in range(12):
        motor, load = (1e-4 * np.round(angle[:-1] / 1e-4) for angle in (run.theta_m, run.position))
        gathering.add(run.time[:-1] + 300.0 * part, {"motor": motor, "load": load})
    clean = gathering.cleaned()
    assert clean.found[THINNED] > 2_000_000
    made = EncoderRecording(clean.time, *clean.channels.values(), motor_count=1e-4, load_count=1e-4, alone=clean.alone)
    minute = replace(made, **{name: getattr(made, name)[:60_000] for name in ("time", "motor", "load", "alone")})
    found = gap_of_driven_load(made, estimate_lost_motion(minute))
    assert found.gap is not None, found.reason
    low, high = found.gap.lost.interval_motor
    assert low < 0.02 < high < 1.02 * low
