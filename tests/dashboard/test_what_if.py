"""Steps that the dashboard asks for."""

import math
from pathlib import Path

import numpy as np
import pytest

import servotwin as st
from servotwin.dashboard.what_if import WhatIf, read_what_if, simulated_step
from servotwin.errors import InvalidInput
from servotwin.twin.model_registry import ModelRegistry

FILE = """
[models.paper]
servo = "paper"
[models.paper.twin]
policy = "paper"
[models.drive]
servo = "two-mass-drive"
[models.drive.twin]
policy = "paper"
[servos]
"p" = "paper"
"d" = "drive"
"""


@pytest.fixture(scope="module")
def registry():
    return ModelRegistry.loads(FILE, "twin.toml", Path())


def test_the_step_is_the_exact_simulation_s(registry):
    asked = WhatIf(gap=0.1, k_dz=0.5, step=1e-3, duration=4.0, gains={"Kp": 1000.0})
    found = simulated_step(registry.model_of("p"), asked)
    servo = st.Servo.preset("paper")
    run = st.simulate(
        servo,
        duration=4.0,
        controller=servo.controller.replace(Kp=1000.0),
        reference=st.Step(1e-3),
        gap=0.1,
        tolerance=0.5 * servo.p * 0.1,
        sample_rate=1000.0,
    )
    at = np.rint(np.array(found["time"]) * 1000).astype(int)
    assert np.array(found["position"]) == pytest.approx(run.position[at], rel=1e-6, abs=1e-10)
    assert max(found["command"]) == pytest.approx(run.voltage.max(), rel=1e-6)
    assert found["overshoot"] == pytest.approx(run.position.max() / 1e-3 - 1.0)
    assert found["tolerance"] == 0.5 * servo.p * 0.1
    assert found["k_dz"] == pytest.approx(0.5)
    assert found["gains"]["Kp"] == 1000.0
    assert found["sensitivity_peak"] == pytest.approx(servo.replace(Kp=1000.0).margins().Ms)
    assert len(found["time"]) < 3300


def test_a_wide_dead_zone_stops_the_limit_cycle_that_a_gap_causes(registry):
    model = registry.model_of("p")
    free = simulated_step(model, WhatIf(gap=math.radians(10), k_dz=0.0, duration=20.0))
    held = simulated_step(model, WhatIf(gap=math.radians(10), k_dz=3.0, duration=20.0))
    assert free["settled"] is None
    assert free["last_motion"] > 1e-4
    assert held["last_motion"] < 0.01 * free["last_motion"]
    assert held["settled"] > 0.0


def test_an_axis_of_another_kind_has_its_own_units_and_names(registry):
    found = simulated_step(registry.model_of("d"), WhatIf(gap=0.0))
    assert found["travel_unit"] == "rad"
    assert found["last_error"] < 0.1 * found["step"]
    assert found["k_dz"] is None


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"[", "cannot be read"),
        (b"{}", "gap"),
        (b'{"gap": 0.1, "gapp": 1}', "gapp"),
        (b'{"gap": 1e999}', "gap"),
        (b'{"gap": -0.1}', "negative"),
        (b'{"gap": 0.1, "tolerance": -1e-5}', "tolerance"),
        (b'{"gap": 0.1, "tolerance": 1e-5, "k_dz": 1}', "exclude each other"),
        (b'{"gap": 0.1, "k_dz": -1}', "k_dz"),
        (b'{"gap": 0.1, "gains": {"Kq": 1}}', "gains.Kq: this machine's law has Kp"),
        (b'{"gap": 0.1, "gains": {"Tf": 0}}', "Tf"),
        (b'{"gap": 0.1, "gains": {"Kp": 1e9}}', "unstable on this servo even without a gap"),
        (b'{"gap": 0.1, "step": 1.0}', "step = 1: must be above 0 and at most 0.025"),
        (b'{"gap": 0.1, "duration": 1000}', "at most 30 s"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_words(registry, body, said):
    with pytest.raises(InvalidInput, match=said):
        simulated_step(registry.model_of("p"), read_what_if(body))
