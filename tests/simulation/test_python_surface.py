"""The Python surface: typed keywords, ranges that catch degrees, short reprs, figures and tables."""

import math
from dataclasses import fields

import numpy as np
import pytest

import servotwin as st
from servotwin.control.controller import ControllerChanges
from servotwin.errors import InvalidInput
from servotwin.estimation.learning.trend_settings import TrendSettings
from servotwin.plant.changes import ServoChanges
from servotwin.simulation.ensemble import Cases, simulate_members

TEN_DEGREES = math.radians(10.0)


@pytest.fixture(scope="module")
def servo():
    return st.Servo.preset("paper")


@pytest.fixture(scope="module")
def run(servo):
    return st.simulate(
        servo,
        2.0,
        reference=st.Step(1e-3),
        gap=TEN_DEGREES,
        tolerance=servo.tolerance_for(TEN_DEGREES),
        sample_rate=1000.0,
    )


def test_replace_knows_every_field_and_no_other():
    assert set(ControllerChanges.__annotations__) == {f.name for f in fields(st.Controller)}
    own = {f.name for f in fields(st.Servo)}
    assert set(ServoChanges.__annotations__) == own | set(ControllerChanges.__annotations__)


@pytest.mark.parametrize("gap", [10.0, st.SCurve(0.0, 20.0, duration=1.0)])
def test_a_gap_in_degrees_is_refused_with_a_hint(servo, gap):
    with pytest.raises(InvalidInput, match=r"rad .*did you mean math\.radians\((10|20)\)\?"):
        st.simulate(servo, 1.0, gap=gap)
    with pytest.raises(InvalidInput, match="did you mean"):
        st.Scenario(servo, 2.0, gap=gap)


def test_a_gap_in_degrees_is_refused_everywhere(servo):
    for call in (
        lambda: servo.tolerance_for(10.0),
        lambda: st.limit_cycle(servo, 10.0),
        lambda: simulate_members(servo, None, 1.0, Cases(gap=[0.1, 10.0])),
    ):
        with pytest.raises(InvalidInput, match=r"573 deg.*math\.radians\(10\)"):
            call()


def test_a_gap_of_a_whole_turn_is_accepted(servo):
    assert servo.tolerance_for(2.0 * math.pi) == 2.0 * math.pi * servo.p


def test_reprs_fit_on_few_lines(servo, run):
    window = st.Window.from_run(run, 0.5, 1.0)
    estimate = st.estimate_gap(window, servo)
    trend = st.Trend.start(0.0, TrendSettings()).update(estimate)
    scenario = st.Scenario(servo, 10.0)
    for value in (servo, servo.controller, run, window, estimate, trend, scenario):
        assert len(repr(value)) < 400, repr(value)
        assert "array(" not in repr(value)
        assert value._repr_html_().startswith("<table>")
    assert repr(servo).startswith(f"<Servo 'paper', model {servo.version}: 3 masses, rigid screw, Controller(Kp=")
    assert repr(servo.replace(k=9e3, k_d=1e6)).startswith("<Servo other, model")
    assert eval(repr(servo.controller), {"Controller": st.Controller}) == servo.controller
    assert repr(run) == f"<Run 2 s, 2001 samples at 1000 Hz, model {servo.version}>"
    assert repr(window) == "<Window 0.5 .. 1.5 s at 1000 Hz: position, theta_m, voltage, reference>"
    assert repr(estimate).startswith(f"<GapEstimate {estimate.status.value}: ")


def test_a_run_and_a_window_plot_themselves(run):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    figure = run.plot()
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "position, mm",
        "error, mm",
        "gap at the motor, deg",
        "voltage, V",
    ]
    assert np.array_equal(figure.axes[0].lines[1].get_ydata(), 1e3 * run.position)
    assert len(st.Window.from_run(run, 0.5, 1.0).plot().axes) == 4
    pyplot.close("all")


def test_both_edges_of_the_dead_zone_are_one_curve_of_the_legend(servo):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    axes = st.simulate(servo, 0.1, reference=1e-3, tolerance=1e-5, sample_rate=1000.0).plot().axes[1]
    _, upper, lower = axes.lines
    assert np.array_equal(upper.get_ydata(), -lower.get_ydata())
    assert upper.get_color() == lower.get_color()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["error", "dead zone"]
    pyplot.close("all")


@pytest.mark.slow
def test_a_run_becomes_an_arrow_table(run):
    table = run.to_arrow()
    assert table.column_names[:3] == ["time_s", "position_m", "measured_position_m"]
    assert table.num_rows == run.samples
    assert np.array_equal(table["position_m"].to_numpy(), run.position)


def test_tune_at_the_top_meets_its_specification(servo):
    tuned = st.tune(servo, 10.0, math.radians(14.0))
    first = max(tuned.margins.gain_crossovers, key=lambda crossover: -abs(crossover.omega - 10.0))
    assert first.omega == pytest.approx(10.0)
    assert math.degrees(first.phase_margin) == pytest.approx(14.0)
    with pytest.raises(InvalidInput, match=r"did you mean math\.radians\(14\)\?"):
        st.tune(servo, 10.0, 14.0)


def test_a_stability_map_at_the_top_tells_which_dead_zones_settle(servo):
    found = st.stability_map(servo, gap=(0.5 * TEN_DEGREES, TEN_DEGREES), k_dz=(0.0, 1.0), members=1, duration=60.0)
    settled = found.grid("settled")[:, 0, :, 0]
    assert settled.tolist() == [[0.0, 1.0], [0.0, 1.0]]
    with pytest.raises(InvalidInput, match="either"):
        st.stability_map(servo)
