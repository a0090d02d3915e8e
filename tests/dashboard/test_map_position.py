"""Place of a setting in a coarse stability map, each cell of which is the exact map's."""

import math
import time

import pytest

import servotwin as st
from servotwin.analysis.maps.axes import RatioAxes
from servotwin.analysis.maps.measures import measured
from servotwin.analysis.maps.settings import MapSettings
from servotwin.dashboard import map_position
from servotwin.dashboard.map_position import MEMBERS, CoarseMaps

SERVO = st.Servo.preset("paper")
GAP = math.radians(10.0)


@pytest.fixture
def few(monkeypatch):
    """Axes of few cells."""
    monkeypatch.setattr(map_position, "TOLERANCES", (0.0, 2.0))
    monkeypatch.setattr(map_position, "STEPS", (1.0, 4.0))


def complete(maps, *asked):
    end = time.monotonic() + 60.0
    while (found := maps.position(*asked))["left"] and not found["why"]:
        assert time.monotonic() < end
        time.sleep(0.01)
    return found


def test_a_place_is_known_at_once_and_the_cells_are_those_of_the_exact_map(few):
    maps, unit = CoarseMaps(), 0.5 * SERVO.p * GAP
    first = maps.position(SERVO, SERVO.controller, GAP, 1.9 * unit, 3.5 * unit)
    assert (first["tolerance"], first["step"]) == pytest.approx((1.9, 3.5))
    assert (first["row"], first["column"], first["starts"]) == (1, 1, MEMBERS)
    found = complete(maps, SERVO, SERVO.controller, GAP, 1.9 * unit, 3.5 * unit)
    settings = MapSettings(SERVO, RatioAxes((0.0, 2.0), (1.0, 4.0)), members=MEMBERS)
    exact = measured(settings, range(4)).settled.reshape(2, 2)
    assert found["settled"] == exact.tolist()
    assert exact[0, 1] < exact[1, 1] == 1.0
    # A gap twice as wide moves the place, not the map.
    other = maps.position(SERVO, SERVO.controller, 2 * GAP, 1.9 * unit, 3.5 * unit)
    assert (other["tolerance"], other["step"], other["left"]) == (pytest.approx(0.95), pytest.approx(1.75), 0)


def test_a_sampled_law_has_the_map_of_its_continuous_one_and_other_gains_begin_another(few):
    maps, law = CoarseMaps(), SERVO.controller.replace(sample_rate=1000.0)
    sampled = complete(maps, SERVO, law, GAP, 1e-4, 1e-3)
    assert sampled["settled"] == complete(maps, SERVO, SERVO.controller, GAP, 1e-4, 1e-3)["settled"]
    other = SERVO, law.replace(Kp=0.9 * law.Kp), GAP, 1e-4, 1e-3
    assert maps.position(*other)["left"] > 0
    assert complete(maps, *other)["left"] == 0


def test_why_there_is_no_map_is_a_sentence():
    maps, wild = CoarseMaps(), SERVO.controller.replace(Kp=100.0 * SERVO.controller.Kp)
    assert "Without a gap" in maps.position(SERVO, SERVO.controller, 0.0, 1e-4, 1e-3)["why"]
    assert "unstable" in maps.position(SERVO, wild, GAP, 1e-4, 1e-3)["why"]
