"""Stability maps: every cell is what direct runs say, only ratios matter, and cells do not depend on one another."""

import dataclasses
import math

import numpy as np
import pytest
from scaling import Units, scaled

from servotwin.analysis.maps.axes import Cells, PhysicalAxes, RatioAxes
from servotwin.analysis.maps.measures import MEASURES, automaton, joined, measured, starts, trajectories
from servotwin.analysis.maps.settings import MapSettings
from servotwin.errors import InvalidInput
from servotwin.plant.servo import Servo
from servotwin.simulation import simulate

PAPER = Servo.preset("paper")
DEGREE = math.radians(1.0)
WORN = PhysicalAxes((10.0 * DEGREE, 20.0 * DEGREE), k_dz=(0.25, 1.0, 2.0), estimate=(10.0 * DEGREE,))
QUICK = {"duration": 25.0, "window": 12.0}


def cells_of(settings):
    return settings.axes.cells(settings.servo)


def whole(settings):
    return measured(settings, range(settings.count))


def same(one, other):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in MEASURES)


@pytest.mark.slow
def test_a_cell_is_the_run_from_rest():
    settings = MapSettings(PAPER, WORN, members=1, **QUICK)
    found, rate = whole(settings), settings.sample_rate
    for i, (gap, tolerance, step) in enumerate(zip(*cells_of(settings), strict=True)):
        run = simulate(PAPER, 25.0, reference=step, gap=gap, tolerance=tolerance, sample_rate=rate)
        tail = run.position[run.time > 25.0 - 12.0 - 1e-9]
        swing = 0.5 * (tail.max() - tail.min())
        assert found.settled[i] == (swing < 1e-6)
        assert found.swing[i] == pytest.approx(swing, rel=1e-6, abs=1e-12)
        assert found.error[i] == pytest.approx(np.abs(step - tail).max(), rel=1e-6)
        assert found.effort[i] == pytest.approx(np.sqrt(np.mean(run.voltage**2)), rel=1e-6)
        outside = np.flatnonzero(np.abs(run.position - tail.mean()) > 0.05 * step)
        within = outside[-1] + 1 if outside.size else 0
        assert found.settling[i] == (within / rate if within / rate <= 13.0 else math.inf)
    assert {*found.settled} == {0.0, 1.0}


def test_every_member_at_rest_is_a_run_with_its_screw():
    settings = MapSettings(PAPER, PhysicalAxes((8.0 * DEGREE,)), members=4, motion=0.0, **QUICK)
    cells, loop = cells_of(settings), automaton(settings)
    position, voltage = trajectories(settings, cells, range(1))
    screws = starts(settings, loop, cells, range(1))[0, :, loop.automaton.index("theta_d")]
    assert screws[0] == 0.0
    assert len(set(screws.tolist())) == 4
    for k, screw in enumerate(screws.tolist()):
        options = {"gap": cells.gap[0], "tolerance": cells.tolerance[0], "sample_rate": settings.sample_rate}
        run = simulate(PAPER, 25.0, reference=1e-3, theta_d0=screw, **options)
        assert np.abs(position[0, k] - run.position).max() < 1e-11
        assert np.abs(voltage[0, k] - run.voltage).max() < 1e-7


def test_half_of_the_members_start_in_motion_within_bounds():
    settings = MapSettings(PAPER, PhysicalAxes((10.0 * DEGREE,)), members=400, motion=0.5)
    loop = automaton(settings)
    states = starts(settings, loop, cells_of(settings), range(1))[0]
    crossover = PAPER.margins().gain_crossovers[0].omega
    bounds = {"theta_d": 5.0 * DEGREE, "speed": 0.5e-3 * crossover / PAPER.p, "integral": 0.5e-3 * PAPER.controller.Ki}
    bounds["integral"] /= crossover
    for name, bound in bounds.items():
        values = np.abs(states[:, loop.automaton.index(name)])
        assert 0.95 * bound < values.max() <= bound, name
    moving = np.any(states[:, [loop.automaton.index(name) for name in ("speed", "integral")]] != 0.0, axis=1)
    assert not moving[0]
    assert not moving[1::2].any()
    assert moving[2::2].all()


def test_only_ratios_matter():
    axes = RatioAxes((0.5, 1.4, 3.0), (0.7, 20.0), gap=10.0 * DEGREE)
    settings = MapSettings(PAPER, axes, members=4, **QUICK)
    doubled = dataclasses.replace(settings, axes=dataclasses.replace(axes, gap=20.0 * DEGREE), still=2e-6)
    one, two = whole(settings), whole(doubled)
    for name in ("settled", "settled_short", "settling"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    for name in ("error", "swing", "effort"):
        assert np.array_equal(2.0 * getattr(one, name), getattr(two, name))
    assert np.ptp(one.settled) > 0.0


def test_a_pitch_half_as_large_with_gains_twice_as_large_is_the_same_loop():
    axes = RatioAxes((0.5, 1.4, 3.0), (0.7, 20.0))
    one = whole(MapSettings(PAPER, axes, members=4, **QUICK))
    other = whole(MapSettings(Servo.preset("paper-gain2"), axes, members=4, **QUICK))
    assert np.array_equal(one.settled, other.settled)
    assert np.allclose(one.effort, other.effort, rtol=1e-6)
    assert np.allclose(one.swing, 2.0 * other.swing, rtol=1e-6, atol=1e-11)


@pytest.mark.parametrize("units", [Units(time=1e-3), Units(time=1e3, length=1e-6), Units(length=1e6, voltage=1e-2)])
def test_a_machine_in_other_units_has_the_same_map_with_as_many_samples(units):
    axes = RatioAxes((0.5, 1.4, 3.0), (0.7, 20.0))
    here, there = (MapSettings(servo, axes, members=4) for servo in (PAPER, scaled(PAPER, *units)))
    assert (here.run_time, here.last_part, here.stillness) == (120.0, 40.0, 1e-6)
    one, other = whole(here), whole(there)
    assert there.samples == here.samples
    assert np.array_equal(one.settled, other.settled)
    assert np.array_equal(one.settled_short, other.settled_short)
    assert other.settling / units.time == pytest.approx(one.settling, rel=1e-9)
    assert other.effort / units.voltage == pytest.approx(one.effort, rel=1e-6)
    assert other.error / units.length == pytest.approx(one.error, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("axes", "still"),
    [
        (RatioAxes((1.0,), (1.0,), gap=20.0 * DEGREE), 2e-6),
        (PhysicalAxes((0.0, 20.0 * DEGREE)), 1e-6),
        (PhysicalAxes((0.05 * DEGREE,)), 1e-8),
        (PhysicalAxes((0.0,), amplitude=(2e-3,)), 2e-6),
    ],
)
def test_rest_is_relative_to_the_gap(axes, still):
    assert MapSettings(PAPER, axes).stillness == pytest.approx(still)
    assert MapSettings(PAPER, axes, still=3e-6).stillness == 3e-6


def test_a_ratio_is_the_physical_cell_that_it_stands_for():
    ratio = MapSettings(PAPER, RatioAxes((2.0,), (36.0,), gap=10.0 * DEGREE), members=3, **QUICK)
    step = 36.0 * 0.5 * PAPER.p * 10.0 * DEGREE
    physical = MapSettings(PAPER, PhysicalAxes((10.0 * DEGREE,), amplitude=(step,)), members=3, **QUICK)
    for one, other in zip(cells_of(ratio), cells_of(physical), strict=True):
        assert one == pytest.approx(other, rel=1e-15)
    assert whole(ratio).effort == pytest.approx(whole(physical).effort, rel=1e-6)


def test_cells_do_not_depend_on_how_they_are_put_together():
    settings = MapSettings(PAPER, RatioAxes((0.5, 1.1, 2.0), (1.0, 30.0, 100.0)), members=3, **QUICK)
    parts = [measured(settings, range(first, last)) for first, last in ((0, 1), (1, 5), (5, 9))]
    assert same(whole(settings), joined(parts))
    assert [cell for chunk in settings.chunks for cell in chunk] == list(range(settings.count))


def test_the_seed_decides_and_nothing_else():
    settings = MapSettings(PAPER, RatioAxes((1.1, 1.3), (1.5, 30.0)), members=6, **QUICK)
    assert same(whole(settings), whole(dataclasses.replace(settings)))
    assert not same(whole(settings), whole(dataclasses.replace(settings, seed=1)))


def test_rest_that_does_not_last_is_not_settled_and_is_marked():
    """With little integral action a cycle of 27 s lies beside the rest: ten seconds do not tell them apart."""
    slow = PAPER.replace(Ki=200.0)
    settings = MapSettings(slow, RatioAxes((0.0,), (0.5,)), members=16, duration=200.0)
    found = whole(settings)
    assert found.settled[0] == 0.0
    assert found.settled_short[0] > 0.1
    assert math.isinf(found.settling[0])


def test_loop_filter_limit_and_feedforward_are_the_direct_run_s():
    law = PAPER.controller.replace(loop_filter_hz=20.0, voltage_limit=2.0, feedforward=0.01)
    settings = MapSettings(PAPER, PhysicalAxes((10.0 * DEGREE,), k_dz=(1.5,)), law, members=1, **QUICK)
    cells = cells_of(settings)
    position, _ = trajectories(settings, cells, range(1))
    options = {"gap": cells.gap[0], "tolerance": cells.tolerance[0], "sample_rate": settings.sample_rate}
    run = simulate(PAPER, 25.0, controller=law, reference=1e-3, **options)
    assert np.abs(position[0, 0] - run.position).max() < 1e-11


def test_an_estimate_is_the_truth_where_none_is_given():
    gaps = (5.0 * DEGREE, 10.0 * DEGREE)
    known = PhysicalAxes(gaps, k_dz=(1.0, 2.0)).cells(PAPER)
    assert known.tolerance == pytest.approx(PAPER.p * np.array([5.0, 10.0, 10.0, 20.0]) * DEGREE)
    fixed = PhysicalAxes(gaps, estimate=(10.0 * DEGREE,)).cells(PAPER)
    assert fixed.tolerance == pytest.approx(PAPER.p * np.array([10.0, 10.0]) * DEGREE)
    assert isinstance(fixed, Cells)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RatioAxes((-1.0,), (1.0,)), "tolerance"),
        (lambda: RatioAxes((1.0,), (0.0,)), "amplitude"),
        (lambda: RatioAxes((), (1.0,)), "empty"),
        (lambda: RatioAxes((1.0, 1.0), (1.0,)), "twice"),
        (lambda: RatioAxes((1.0,), (1.0,), gap=0.0), "gap"),
        (lambda: PhysicalAxes((math.nan,)), "gap"),
        (lambda: RatioAxes(tuple(range(2000)), tuple(range(1, 2001))), "too many"),
        (lambda: MapSettings(PAPER, WORN, members=0), "members"),
        (lambda: MapSettings(PAPER, WORN, seed=-1), "seed"),
        (lambda: MapSettings(PAPER, WORN, duration=math.inf), "duration"),
        (lambda: MapSettings(PAPER, WORN, duration=30.0), "window"),
        (lambda: MapSettings(PAPER, WORN, motion=-1.0), "motion"),
        (lambda: MapSettings(PAPER, WORN, duration=1e6), "samples"),
        (lambda: MapSettings(PAPER, WORN, PAPER.controller.replace(sample_rate=1e3)), "sample_rate"),
        (lambda: MapSettings(PAPER, WORN, PAPER.controller.replace(Kp=-1.0)), "unstable"),
    ],
)
def test_a_map_out_of_range_is_refused(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


def test_the_fingerprint_names_everything_that_matters():
    base = MapSettings(PAPER, WORN)
    others = [
        dataclasses.replace(base, servo=Servo.preset("table1")),
        dataclasses.replace(base, axes=dataclasses.replace(WORN, k_dz=(0.25, 1.0, 2.1))),
        dataclasses.replace(base, controller=PAPER.controller.replace(enter=0.5)),
        *(dataclasses.replace(base, **{name: 11}) for name in ("members", "motion", "seed", "window", "still")),
        dataclasses.replace(base, duration=121.0),
    ]
    assert len({one.fingerprint for one in (base, *others)}) == len(others) + 1
    assert dataclasses.replace(base, controller=PAPER.controller).fingerprint == base.fingerprint
