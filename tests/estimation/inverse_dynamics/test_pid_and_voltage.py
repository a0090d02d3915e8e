"""A drive under a PID with a filtered derivative, and a DC motor whose command is a voltage."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drive_recordings import PARAMETERS, recording_of, simulated, strokes

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.fitted_cascade import GivenGains, fitted_cascade
from servotwin.estimation.inverse_dynamics.fitted_pid import FittedPid, GivenPid, fitted_pid
from servotwin.estimation.inverse_dynamics.identify import identify_drive, stated_law

P, RATE = 1e-3, 1000.0
R, K, J, B, TC = 2.0, 0.1, 2e-5, 1.5e-4, 0.012
# Volts per acceleration, speed and sign of the speed of the load, m/s^2 and m/s: back EMF is viscous friction.
VOLTS = {"inertia": R * J / (K * P), "viscous": (R * B / K + K) / P, "coulomb": R * TC / K}


def recorded(actuator, gains, scale=1.0):
    """A loop that follows strokes; gains in units of the command per m."""
    controller = st.Controller(*gains, sample_rate=RATE)
    mass = PARAMETERS["inertia"] if scale == P else J / P**2
    axis = st.Axis(actuator, st.Transmission(P), st.Load((mass,)), controller, st.Sensors(feedback="motor"))
    reference = strokes(cycles=2, rate=RATE)
    time = np.arange(reference.size) / RATE
    run = st.simulate(axis, time[-1], reference=st.Samples(tuple(time), tuple(reference)), sample_rate=RATE)
    return recording_of(run.theta_m * P, run.voltage / scale, reference, rate=RATE)


@cache
def torque(Ki=0.0):
    drive = st.TorqueDrive(
        PARAMETERS["inertia"] * P * P, friction=PARAMETERS["viscous"] * P * P, coulomb=PARAMETERS["coulomb"] * P
    )
    return recorded(drive, (60_000.0 * P, Ki * P, 2400.0 * P, 2e-3), scale=P)


@cache
def voltage():
    return recorded(st.DcMotor(J, R, K, K, friction=B, coulomb=TC), (2500.0, 0.0, 60.0, 2e-3))


@pytest.mark.slow
@pytest.mark.parametrize("Ki", [0.0, 5e5])
def test_gains_and_filter_of_a_pid_are_found(Ki):
    law = fitted_pid(torque(Ki))
    assert (law.Kp, law.Kd, law.Tf) == pytest.approx((60_000.0, 2400.0, 2e-3), rel=2e-3)
    assert pytest.approx(Ki, rel=1e-2, abs=1e-6) == law.Ki
    assert law.left < 1e-3


@pytest.mark.slow
def test_a_pid_is_chosen_where_a_cascade_does_not_explain_the_command_and_the_loop_is_simulated():
    drive = identify_drive([torque()], p=P)
    assert isinstance(drive.law, FittedPid)
    assert drive.refinement is not None
    assert drive.refinement.converged
    assert drive.refinement.simulated.position_error < 1e-4
    for name in ("inertia", "viscous", "coulomb"):
        assert drive.refinement.symmetric[name] == pytest.approx(PARAMETERS[name], rel=2e-3), name


@pytest.mark.slow
def test_gains_of_a_pid_that_are_stated_are_kept_and_the_others_fitted():
    law = fitted_pid(torque(), GivenPid(Kp=60_000.0, Tf=2e-3))
    assert (law.Kp, law.Ki, law.Tf) == (60_000.0, 0.0, 2e-3)
    assert law.Kd == pytest.approx(2400.0, rel=2e-3)
    stated = GivenPid(60_000.0, 0.0, 2400.0, 2e-3)
    assert fitted_pid(torque(), stated).left < 1e-3
    drive = identify_drive([torque()], stated, p=P)
    assert drive.refinement is not None
    assert drive.refinement.symmetric["inertia"] == pytest.approx(PARAMETERS["inertia"], rel=2e-3)
    bare = replace(torque(), reference=None)
    assert identify_drive([bare], stated, p=P).law == FittedPid(60_000.0, 0.0, 2400.0, 2e-3)


@pytest.mark.slow
def test_gains_of_a_pid_that_are_not_those_that_ran_are_told():
    drive = identify_drive([torque()], GivenPid(20_000.0, 0.0, 900.0, 2e-3), p=P)
    assert drive.refinement is None
    assert "with the gains that are given leaves" in drive.doubts[0]


def test_gains_of_two_laws_are_refused():
    assert stated_law(GivenGains(), GivenPid(Kp=1.0)) == GivenPid(Kp=1.0)
    assert stated_law(GivenGains(position_gain=1.0), GivenPid()) == GivenGains(position_gain=1.0)
    with pytest.raises(InvalidInput, match="state one of the two"):
        stated_law(GivenGains(position_gain=1.0), GivenPid(Kp=1.0))
    with pytest.raises(InvalidInput, match=r"--kp -1\.0: must be positive"):
        GivenPid(Kp=-1.0)


@pytest.mark.slow
def test_a_cascade_stays_one():
    assert not isinstance(identify_drive([simulated()], p=P).law, FittedPid)
    assert fitted_pid(simulated()).left > 3.0 * fitted_cascade(simulated(), GivenGains()).left


@pytest.mark.slow
def test_a_dc_motor_is_found_in_volts():
    drive = identify_drive([voltage()], p=P)
    assert isinstance(drive.law, FittedPid)
    assert (drive.law.Kp, drive.law.Kd) == pytest.approx((2500.0, 60.0), rel=2e-3)
    for name, true in VOLTS.items():
        assert drive.refinement.symmetric[name] == pytest.approx(true, rel=5e-3), name
