"""Where no setting is verified, the refusal names changes after which one is."""

from collections.abc import Callable

import pytest

import servotwin as st
from servotwin.redesign.certified import ways_out as module
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.ways_out import ways_out

# Two inertias of 1 g m^2 behind a gear of 100; the load floats in the gap, and the loop closes over its encoder.
AXIS = st.Axis.loads(
    """
[actuator]
kind = "torque"
inertia_kg_m2 = 0.0056
viscous_friction_n_m_s_per_rad = 9e-4
[transmission]
kind = "gear"
ratio = 100.0
stiffness_n_m_per_rad = 1220.0
damping_n_m_s_per_rad = 50.0
in_gap = "free"
[load]
kind = "rotary"
inertia_kg_m2 = 190.0
damping_n_m_s_per_rad = 47.0
[controller]
kind = "filtered_pid"
kp_n_m_per_rad = 0.159
ki_n_m_per_rad_s = 0.0
kd_n_m_s_per_rad = 3.67
filter_time_s = 0.608
sample_rate_hz = 50.0
""",
    "axis.toml",
)
RANGES = st.Uncertainty(gap=(0.0, 0.16), step=(0.02, 0.16), input_bias=(-1e-4, 1e-4))
DEMANDS = Demands()
TRIAL = trial_for(AXIS, RANGES, DEMANDS)

Verified = Callable[[st.Axis, st.Uncertainty], bool]


@pytest.fixture
def verified(monkeypatch: pytest.MonkeyPatch) -> Callable[[Verified], str]:
    """The sentence where an axis and its ranges are verified as a function tells."""

    def sentence(function: Verified) -> str:
        monkeypatch.setattr(module, "_is_verified", lambda servo, ranges, *_: function(servo, ranges))
        return ways_out(AXIS, RANGES, DEMANDS, TRIAL)

    return sentence


def test_of_each_kind_the_first_that_is_verified_is_named(verified: Callable[[Verified], str]) -> None:
    cascade = r"with a cascade and an encoder at the motor (servotwin tune 1.27 60 --type cascade)"
    bias = "where there is no input bias (input_bias_n_m)"
    assert verified(lambda *_: True) == f"a setting is verified {bias}, or {cascade}"
    assert verified(lambda _, ranges: not any(ranges.input_bias)) == f"a setting is verified {bias}"
    slower = cascade.replace("1.27", "0.633")
    found = verified(lambda axis, _: isinstance(axis.controller, st.Cascade) and axis.controller.speed_filter > 0.1)
    assert found == f"a setting is verified {slower}"
    assert verified(lambda _, ranges: ranges.gap[1] < 0.05).startswith(
        "a setting is verified for gaps of at most 2.29 deg"
    )
    nothing = verified(lambda *_: False)
    assert nothing.startswith(f"none is verified {bias}, nor for gaps of at most 4.58 deg (gap_deg), nor for ")
    assert nothing.endswith(f"{cascade.replace('1.27', '0.317')} either")


def test_no_cascade_is_named_where_there_can_be_none() -> None:
    servo = st.Servo.preset("paper")
    for plant in (
        servo,
        AXIS.replace(sensors=st.Sensors(motor_encoder=False)),
        AXIS.replace(controller=st.Cascade(1.0, 0.01, velocity_gain=1.0)),
    ):
        found = {words for words, _ in module._cascades(plant, RANGES, DEMANDS)}
        assert not found


@pytest.mark.slow
def test_what_the_refusal_names_is_verified() -> None:
    """The loop over the load's encoder swings in the gap whatever its gains; the cascade damps the motor."""
    assert not isinstance(certify(AXIS, RANGES, DEMANDS, TRIAL), st.Certificate)
    words = ways_out(AXIS, RANGES, DEMANDS, TRIAL)
    assert (
        words
        == "a setting is verified with a cascade and an encoder at the motor (servotwin tune 1.27 60 --type cascade)"
    )
