"""What the dead zone may switch (docs/decisions/0004): the loop with Eq 20 read in five ways, at 5 kHz.

A small simulation of its own, so that readings which servotwin does not offer can be compared with the one it does.
"""

import math

import numpy as np
import pytest
from exploration import explored

from servotwin.hybrid.compiled import compiled
from servotwin.plant.backlash import play_step
from servotwin.plant.linear import zero_order_hold
from servotwin.plant.servo import Servo

HOLD, DURATION, STEP = 2e-4, 40.0, 1e-3
GAPS = (0.0, 5.0, 10.0, 15.0)
GATED, UNGATED, KEPT, SHIFTED, SHIFTED_UNGATED, RESET = range(6)


@compiled
def position(reading, motor, structure, output, gains, half_gap, tolerance):
    """(N,) m, last mass after a step of the reference; `reading` says what is done inside the dead zone."""
    Kp, integral_step, derivative_gain, filter_step = gains
    (A, B), (G, H) = motor, structure
    x, z, theta_d = np.zeros(B.size), np.zeros(H.size), 0.0
    integral, derivative, voltage = 0.0, 0.0, 0.0
    positions = np.empty(round(DURATION / HOLD))
    for i in range(positions.size):
        positions[i] = output @ z
        error = STEP - positions[i]
        inside = abs(error) <= tolerance
        if reading in (SHIFTED, SHIFTED_UNGATED):
            error -= math.copysign(tolerance, error)
        driven = 0.0 if inside else error
        if inside and reading == RESET:
            integral, derivative = 0.0, 0.0
        wanted = Kp * driven + integral + derivative_gain * (driven - derivative)
        if not inside or reading in (UNGATED, SHIFTED_UNGATED):
            voltage = wanted
        elif reading != KEPT:
            voltage = 0.0
        integral += integral_step * driven
        derivative += filter_step * (driven - derivative)
        x = A @ x + B * voltage
        theta_d = play_step(theta_d, x[2], half_gap)
        z = G @ z + H * theta_d
    return positions


def over_a_tick(system):
    return tuple(np.ascontiguousarray(part) for part in zero_order_hold(system.A, system.B, HOLD))


def swing(servo, reading, gap_deg):
    """Peak to peak over the last 5 s, mm."""
    structure = servo.G2()
    law = servo.controller.replace(sample_rate=1.0 / HOLD).law(None)
    gains = law.Kp, law.integral_step, law.derivative_gain, law.filter_step
    positions = position(
        reading,
        over_a_tick(servo.G1()),
        over_a_tick(structure),
        structure.C,
        gains,
        0.5 * math.radians(gap_deg),
        servo.tolerance_for(math.radians(10.0)),
    )
    return 1e3 * np.ptp(positions[-round(5.0 / HOLD) :])


@pytest.fixture(scope="module", params=explored(["paper", "table1", "paper-gain2"], 0))
def servo(request):
    return Servo.preset(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("gap_deg", GAPS)
def test_zero_error_and_zero_voltage_inside_settle(servo, gap_deg):
    assert swing(servo, GATED, gap_deg) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("gap_deg", GAPS[1:])
@pytest.mark.parametrize("reading", [UNGATED, KEPT, SHIFTED_UNGATED])
def test_any_voltage_inside_keeps_the_loop_oscillating(servo, reading, gap_deg):
    assert swing(servo, reading, gap_deg) > 0.05


@pytest.mark.parametrize("gap_deg", GAPS)
@pytest.mark.parametrize("name", ["paper", "paper-gain2"])
def test_resetting_the_controller_inside_diverges(name, gap_deg):
    assert swing(Servo.preset(name), RESET, gap_deg) > 10.0


def test_shifting_the_error_settles_too_when_the_voltage_is_gated():
    assert max(swing(Servo.preset("paper"), SHIFTED, gap_deg) for gap_deg in GAPS) < 1e-3
