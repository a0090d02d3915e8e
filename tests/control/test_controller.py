"""The controller's description: validation and discretisation."""

import math
from typing import Any

import pytest

from servotwin.control import Controller
from servotwin.control.law import start, tick
from servotwin.errors import InvalidInput

PAPER = Controller(Kp=1377.7, Ki=18907.6, Kd=-135.1, Tf=0.1, sample_rate=5000.0)


def test_law_discretises_exactly() -> None:
    law = PAPER.replace(loop_filter_hz=20.0, rate_limit=500.0, voltage_limit=24).law(1e-3)
    assert law.integral_step == 18907.6 / 5000.0
    assert law.derivative_gain == -135.1 / 0.1
    assert law.filter_step == pytest.approx(1.0 - math.exp(-2e-3), rel=1e-13)
    assert law.loop_step == pytest.approx(1.0 - math.exp(-2.0 * math.pi * 20.0 / 5000.0), rel=1e-13)
    assert law.rate_step == pytest.approx(0.1, rel=1e-15)
    assert law.voltage_limit == 24.0
    assert law.tracking_step == pytest.approx(2e-4 / math.sqrt(135.1 / 18907.6), rel=1e-12)
    assert all(type(value) is float for value in law)


def test_everything_optional_is_off_by_default() -> None:
    law = PAPER.law()
    assert (law.voltage_limit, law.rate_step, law.loop_step) == (math.inf, math.inf, 1.0)


@pytest.mark.parametrize("share", [0.01, 0.02, 0.03])
def test_a_slow_integral_does_not_run_down_while_the_proportional_part_saturates(share: float) -> None:
    """It grows by the limit's share of the error, as if only that had been asked for."""
    slow = PAPER.replace(Ki=share * PAPER.Ki, voltage_limit=1.0)
    law, state = slow.law(), start(0.0)
    for _ in range(5000):  # 1 s under an error that asks for three times the limit
        before, state = state.integral, tick(law, state, 3.0 / slow.Kp, 0.0)
        assert state.integral >= before
    assert state.voltage == 1.0
    reset = slow.Kp / slow.Ki
    grown = 1.0 - math.exp(-1.0 / reset)  # V, towards the limit; faster until that is reached
    assert grown < state.integral < grown + 0.3 / reset


def test_thresholds_are_multiples_of_the_tolerance() -> None:
    controller = PAPER.replace(enter=0.5, leave=1.5)
    assert controller.thresholds(2e-4) == (1e-4, 1.5 * 2e-4)
    assert controller.thresholds(None) == controller.thresholds(0.0) == (-1.0, -1.0)


def test_tracking_time_has_a_default_for_every_structure() -> None:
    assert Controller(2.0, 8.0, 0.0, 0.1).tracking == 0.25
    assert Controller(2.0, 8.0, -2.0, 0.1).tracking == 0.5
    assert Controller(2.0, 8.0, 0.04, 0.1).tracking == math.sqrt(0.005)
    assert Controller(2.0, 8.0, 0.03, 0.1).tracking == 0.25
    assert Controller(2.0, 0.0, 0.5, 0.1, sample_rate=10.0).law().tracking_step == 0.0
    assert Controller(0.0, 8.0, 0.0, 0.1, sample_rate=10.0).law().tracking_step == 1.0
    assert Controller(2.0, 8.0, 1.0, 0.1, sample_rate=10.0, tracking_time=0.5).law().tracking_step == 0.2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"Tf": 0.0}, "Tf = 0.0"),
        ({"Tf": -1.0}, "Tf"),
        ({"Kp": math.nan}, "Kp"),
        ({"Ki": math.inf}, "finite"),
        ({"Kd": "1"}, "Kd"),
        ({"Kp": True}, "Kp"),
        ({"Kp": None}, "Kp"),
        ({"enter": -0.1}, "enter"),
        ({"enter": 1.0, "leave": 0.5}, "leave"),
        ({"loop_filter_hz": 0.0}, "loop_filter_hz"),
        ({"voltage_limit": -24.0}, "voltage_limit"),
        ({"rate_limit": math.inf}, "rate_limit"),
        ({"sample_rate": 0}, "sample_rate"),
        ({"tracking_time": 0.0}, "tracking_time"),
        ({"gain": 1.0}, "'gain'"),
    ],
)
def test_bad_values_are_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        PAPER.replace(**change)


@pytest.mark.parametrize("tolerance", [-1e-3, math.nan, math.inf])
def test_bad_tolerances_are_refused(tolerance: float) -> None:
    with pytest.raises(InvalidInput, match="tolerance"):
        PAPER.law(tolerance)


def test_a_continuous_controller_has_no_sampled_law() -> None:
    with pytest.raises(InvalidInput, match="sample_rate"):
        PAPER.replace(sample_rate=None).law(1e-3)
