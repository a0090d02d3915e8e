"""Limit cycles, tuning and maps of axes made of parts."""

import math

import numpy as np
import pytest

import servotwin as st
from servotwin.analysis.limit_cycles.cycle import CycleStatus
from servotwin.analysis.limit_cycles.describing import limit_cycle_near, predictions
from servotwin.errors import InvalidInput
from servotwin.plant.scales import scales

VELOCITY = st.Axis(
    st.VelocityDrive(5e-3),
    st.Transmission(1e-3 / math.pi),
    st.Load((5.2,) * 3, (1e4,) * 3, (36.9,) * 3),
    st.Controller(Kp=1000.0, Ki=4000.0, Kd=0.0, Tf=0.1),
)
TWO_MASS = st.Axis.preset("two-mass-drive").replace(sample_rate=None, voltage_limit=None)


@pytest.mark.parametrize(("axis", "gap"), [(VELOCITY, 0.2), (TWO_MASS, 0.02)], ids=["velocity", "two masses"])
def test_the_orbit_is_where_a_long_run_ends(axis: st.Axis, gap: float) -> None:
    cycle = st.limit_cycle(axis, gap)
    assert cycle.status is CycleStatus.CYCLE
    assert cycle.orbit is not None
    run = st.simulate(axis, 200.0, reference=1e-3, gap=gap, sample_rate=1000.0)
    last = run.position[-60_000:]
    assert [cycle.orbit.lowest, cycle.orbit.highest] == pytest.approx([last.min(), last.max()], abs=1e-5 * np.ptp(last))
    assert np.abs(cycle.orbit.multipliers).max() < 1.0


def test_the_describing_function_is_near_the_orbit() -> None:
    predicted = predictions(VELOCITY, 0.2)
    stable = [one for one in predicted if one.stable]
    assert len(stable) == 1
    orbit = limit_cycle_near(VELOCITY, 0.2, stable[0]).orbit
    assert orbit is not None
    assert stable[0].frequency == pytest.approx(orbit.frequency, rel=0.05)
    assert 2.0 * stable[0].amplitude == pytest.approx(orbit.highest - orbit.lowest, rel=0.25)


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        (TWO_MASS.replace(transmission=st.Transmission(1.0, 3300.0)), "or a shaft that is free in the gap"),
        (VELOCITY.replace(sensors=st.Sensors(feedback="motor")), "outside of a loop on the motor's encoder"),
        (VELOCITY.replace(load=st.Load((5.2,) * 3, (1e4,) * 3, (36.9,) * 3, friction=1.0)), "friction or a force too"),
    ],
)
def test_no_describing_function_is_said(axis: st.Axis, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        predictions(axis, 0.1)


def test_a_stage_that_goes_where_it_is_told_settles() -> None:
    axis = st.Axis.preset("stepper-stage").replace(sample_rate=None)
    assert st.limit_cycle(axis, 0.01, step=1e-4).status is CycleStatus.SETTLES


def test_an_axis_is_tuned_for_its_crossover() -> None:
    tuned = st.tune(TWO_MASS, 4.0, 1.0)
    first = TWO_MASS.margins(tuned.controller).gain_crossovers[0]
    assert (first.omega, first.phase_margin) == (pytest.approx(4.0), pytest.approx(1.0))


def test_a_map_of_an_axis_agrees_with_single_runs() -> None:
    result = st.stability_map(VELOCITY, tolerance=(0.3, 1.2), members=4)
    settled = result.grid("settled").ravel()
    # A dead zone that covers the gap settles, one of a third of it does not.
    assert settled[1] == 1.0
    assert settled[0] < 1.0


def test_an_axis_in_other_units_has_the_same_scales() -> None:
    """Slower, longer and on another command: the same machine in its own second, metre and volt."""
    reference, factor = scales(TWO_MASS), 100.0
    slow = st.Axis(
        st.TorqueDrive(J=0.4, lag=1e-3 * factor, friction=0.1 / factor),
        st.Transmission(1.0, 3300.0 / factor**2, 2.0 / factor, "free"),
        st.Load((5.6,), (0.0,), (1.0 / factor,), "rotary"),
        st.Controller(60.0 / factor**2, 40.0 / factor**3, 20.0 / factor, 0.02 * factor),
    )
    assert scales(slow).time == pytest.approx(factor * reference.time)
    assert scales(slow).voltage == pytest.approx(reference.voltage / factor**2)
