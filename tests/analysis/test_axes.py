"""Limit cycles, tuning and maps of axes made of parts."""

import math
from dataclasses import replace

import numpy as np
import pytest

import servotwin as st
from benchmarks.workloads import knocking_drive
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
TWO_MASS = knocking_drive().replace(sample_rate=None, voltage_limit=None)


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
        (TWO_MASS.replace(voltage_limit=60.0), r"controller torque_limit_n_m = 60 N m"),
        (VELOCITY.replace(actuator=st.VelocityDrive(5e-3, limit=9.0)), "speed_limit_rad_per_s = 9 rad/s"),
    ],
)
def test_no_describing_function_is_said(axis: st.Axis, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        predictions(axis, 0.1)


def test_a_dead_zone_without_anything_to_stop_is_refused() -> None:
    axis = VELOCITY.replace(controller=st.Cascade(1.0, 1e-3 / math.pi))
    for compute in (lambda: st.stability_map(axis, tolerance=(0.3, 1.2)), lambda: st.limit_cycle(axis, 0.2, 1e-5)):
        with pytest.raises(InvalidInput, match=r"dead zone changes nothing: .*give integral_only = false"):
            compute()
    assert st.stability_map(axis, tolerance=(0.0,), members=2).grid("settled").all()


def test_a_stage_that_goes_where_it_is_told_settles() -> None:
    axis = st.Axis.preset("stepper-stage").replace(sample_rate=None)
    assert st.limit_cycle(axis, 0.01, step=1e-4).status is CycleStatus.SETTLES


def test_a_motor_that_friction_holds_while_the_integral_grows_has_not_settled() -> None:
    axis, gap = st.Axis.preset("micro-positioner").replace(sample_rate=None), 0.01
    step = 0.3 * axis.p * gap
    found = st.limit_cycle(axis, gap, step=step)
    assert found.status is CycleStatus.IRREGULAR
    assert "friction holds motor and load" in found.reason
    run = st.simulate(axis, 260.0, reference=step, gap=gap, sample_rate=100.0)
    still, later = run.position[1000:6000], run.position[6000:]
    assert np.ptp(still) < 1e-9 * axis.p * gap < np.ptp(later)
    held = axis.replace(controller=replace(axis.controller, Ki=0.0))
    assert st.limit_cycle(held, gap, step=step).status is CycleStatus.SETTLES


def test_the_time_of_settling_is_that_of_an_integrator_of_its_own() -> None:
    # A belt on the motor's encoder alone, with friction at both ends. Euler steps of 1 and of 0.25 us, friction by
    # clipping, without this package's code: motor and load within 1 % of the gap from 0.477 s on.
    axis = st.Axis(
        st.TorqueDrive(4e-5, 3e-4, coulomb=0.03),
        st.Transmission(25.13e-3 / math.tau, 4e5, 120.0, in_gap="free"),
        st.Load((12.0,), c=(40.0,), friction=20.0),
        st.Cascade(20.0, 25.13e-3 / math.tau, 0.02, 0.03, on="motor", voltage_limit=3.9),
        sensors=st.Sensors(feedback="motor"),
    )
    found = st.limit_cycle(axis, math.radians(0.667))
    assert found.status is CycleStatus.SETTLES
    assert found.settling == pytest.approx(0.477, abs=2e-3)
    assert "within 1 % of the gap from 0.47" in found.reason


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


def test_a_map_of_a_linear_law_is_that_of_the_same_filtered_pid() -> None:
    """With a dead zone that opens the loop, and members in motion."""
    integral = st.LinearLaw(
        A=((0.0,),), B=((4000.0, 0.0, -4000.0),), C=(1.0,), D=(1000.0, 0.0, -1000.0), names=("integral",),
        holds=("integral",), integral_only=False,
    )  # fmt: skip
    options = {"gap": (0.1, 0.2), "k_dz": (0.0, 0.3, 1.5), "amplitude": (1e-3,), "members": 4}
    one, other = (st.stability_map(VELOCITY, controller=law, **options) for law in (None, integral))
    for name in ("settled", "swing", "settling"):
        assert np.array_equal(one.grid(name), other.grid(name)), name
    assert one.grid("effort") == pytest.approx(other.grid("effort"), rel=1e-9)
    assert 0.0 < one.grid("settled").mean() < 1.0


def test_a_map_of_a_cascade_agrees_with_single_runs() -> None:
    """On a free shaft, the motor's encoder inside: the first member is the run from rest."""
    cascade = st.Cascade(2.0, 1.0, velocity_gain=30.0, integral_time=0.5)
    axis = TWO_MASS.replace(controller=cascade)
    result = st.stability_map(
        axis, gap=(0.02,), k_dz=(0.0, 1.0), amplitude=(0.2,), members=1, duration=12.0, window=6.0
    )
    assert result.columns[-1] == "effort_n_m"
    rate = result.settings.sample_rate
    for tolerance, swing in zip((None, 0.02), result.grid("swing").ravel(), strict=True):
        run = st.simulate(axis, 12.0, reference=0.2, gap=0.02, tolerance=tolerance, sample_rate=rate)
        assert swing == pytest.approx(0.5 * np.ptp(run.position[-round(6.0 * rate) - 1 :]), rel=1e-5, abs=1e-12)
