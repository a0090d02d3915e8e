"""The surface of the package in an interpreter: results are one short line each."""

import math

import pytest

import servotwin as st
from servotwin.errors import InvalidInput


def one_line(result: object, *parts: str) -> bool:
    """True where a result shows as one line with these parts, in order."""
    text = repr(result)
    places = [text.find(part) for part in parts]
    return "\n" not in text and len(text) < 300 and -1 not in places and places == sorted(places)


@pytest.mark.slow
def test_results_are_shown_in_one_line():
    servo = st.Servo.preset("paper").replace(Ki=0.0)
    tuning = st.tune(servo, 4.0, math.radians(60.0))
    assert one_line(tuning, "<Tuning ", "crossover 4 rad/s", "Ms")
    assert one_line(st.limit_cycle(servo, 0.0), "<CycleResult settles: ")
    assert one_line(st.limit_cycle(st.Servo.preset("paper"), 0.1), "<CycleResult limit cycle: 1.48 Hz", "stable>")
    run = st.simulate(servo, 2.0, reference=st.Step(1e-3), gap=0.1)
    window = st.Window.from_run(run, start=0.0, duration=1.9)
    joint = st.estimate_jointly([window, window], servo)
    assert one_line(joint, "<JointEstimate of 2 windows, 2 ok; the last: <GapEstimate ok: 5.73 deg")
    certificate = st.certify(servo, st.Uncertainty(gap=(0.0, 0.1)))
    assert one_line(certificate, "<Certificate of ", "simulated machines settled", "gaps 0 .. 5.73 deg", "Ms")


def test_a_range_of_gaps_in_degrees_is_refused():
    with pytest.raises(InvalidInput, match=r"uncertainty gap = 60 rad \(3438 deg\).*did you mean math.radians\(60\)"):
        st.certify(st.Servo.preset("paper"), st.Uncertainty(gap=(0.0, 60.0)))
