"""The whole twin in the loop of axes made of parts."""

import math

import numpy as np
import pytest

import servotwin as st
from servotwin.commissioning.edge_settings import Recording
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.twin.settings import TwinSettings

PAPER = st.Servo.preset("paper")
# N m/V: a torque drive with the paper's rotor, back EMF and winding; command and gains are in N m.
TORQUE = PAPER.k_T / PAPER.R
OWN = PAPER.controller
DRIVE = st.Axis(
    st.TorqueDrive(PAPER.J, PAPER.L / PAPER.R, PAPER.k_T * PAPER.k_B / PAPER.R),
    st.Transmission(PAPER.p),
    st.Load(tuple(PAPER.masses), tuple(PAPER.stiffnesses), tuple(PAPER.dampings)),
    OWN.replace(Kp=TORQUE * OWN.Kp, Ki=TORQUE * OWN.Ki, Kd=TORQUE * OWN.Kd),
)


FEW = Demands(machines=40, screened=4, conditions=4, integral=(0.0,), beyond=Beyond(machines=8), settled=0.9)
"""A verification that takes a second."""


def true_gaps(loop: st.Loop) -> np.ndarray:
    """(N,) total gap at the estimates, rad."""
    return np.interp([estimate.time for estimate in loop.estimates], loop.run.time, loop.run.gap)


@pytest.mark.slow
def test_the_paper_s_twin_runs_on_a_torque_drive() -> None:
    """Its estimates are those on the servo, whose machine is the same but for the winding's back EMF."""
    scenario = st.Scenario.preset("fig15")
    on_servo, on_drive = st.cosimulate(scenario), st.cosimulate(scenario.with_servo(DRIVE))
    gaps = [[estimate.gap for estimate in loop.estimates] for loop in (on_servo, on_drive)]
    assert gaps[0] == pytest.approx(gaps[1], abs=math.radians(0.05))
    assert all(receipt.applied for receipt in on_drive.receipts)
    assert {estimate.model_version for estimate in on_drive.estimates} == {DRIVE.version}


@pytest.mark.slow
def test_verified_settings_reach_a_torque_drive() -> None:
    """Gap, bias and gains as on the servo, the bias in N m.

    The gap grows by up to 0.12 deg/s, which makes one window or the other tell too little, depending on the law.
    """
    scenario = st.Scenario.preset("certified").with_servo(DRIVE).replace(duration=80.0)
    twin = scenario.twin
    bias = tuple(TORQUE * end for end in twin.uncertainty.input_bias)
    scenario = scenario.replace(
        twin=twin.replace(uncertainty=twin.uncertainty.replace(input_bias=bias), demands=FEW),
        input_bias=TORQUE * scenario.input_bias,
    )
    loop = st.cosimulate(scenario)
    accepted = [estimate.ok for estimate in loop.estimates]
    assert sum(accepted) >= 3
    gaps = np.array([estimate.gap for estimate in loop.estimates])
    assert gaps[accepted] == pytest.approx(true_gaps(loop)[accepted], abs=math.radians(0.01))
    assert loop.updates
    assert all(receipt.applied for receipt in loop.receipts)
    last = (loop.run.reference - loop.run.position)[-2000:-1]
    assert np.abs(last).max() < 1e-5


@pytest.mark.slow
def test_a_twin_follows_the_gap_of_a_free_shaft() -> None:
    """Two masses with a dead zone between them that wears to ten times its healthy width."""
    scenario = st.Scenario(
        servo=st.Axis.preset("two-mass-drive"),
        duration=40.0,
        reference=st.SquareWave(0.2, 20.0),
        gap=st.SCurve(0.002, 0.02, duration=40.0, begin=0.0),
        recording=Recording(window=2.0, sample_rate=2000.0),
        twin=TwinSettings(policy="paper", initial_gap=0.002, k_dz=1.0),
        seed=1,
    )
    loop = st.cosimulate(scenario)
    inside = [
        estimate.interval[0] <= true <= estimate.interval[1]
        for estimate, true in zip(loop.estimates, true_gaps(loop), strict=True)
    ]
    assert all(estimate.ok for estimate in loop.estimates)
    assert all(inside)
    assert [e.gap for e in loop.estimates] == pytest.approx(true_gaps(loop), abs=math.radians(0.05))
    assert len(loop.receipts) == len(loop.windows) == 4
    assert all(receipt.applied for receipt in loop.receipts)
