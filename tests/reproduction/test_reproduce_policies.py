"""Beyond the paper: the policies side by side, on the first two steps of the wear."""

import io
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

import servotwin as st
from servotwin.report import style
from servotwin.reproduction import documents, figures, policy_runs, report, reproduce
from servotwin.reproduction.figures import DrawnFigure, policies
from servotwin.reproduction.policy_runs import ALONE, BIASED, CLEAN, NOISE, PolicyJob
from servotwin.reproduction.runs import Runs, Trace
from servotwin.reproduction.twin_runs import SettingOrigin

SHORT = 40.0  # s: two steps


@pytest.fixture(scope="module")
def runs():
    return Runs("paper")


@pytest.fixture(scope="module")
def biased(runs):
    return policies.data_of(BIASED, SHORT)(runs)


@pytest.fixture(scope="module")
def outcomes(biased):
    return {one.policy: one for one in biased.outcomes}


@pytest.mark.slow
def test_only_the_policy_differs():
    """Machine, wear, link, noise and seed are the same; and windows among those that keep the servo's own gains."""
    shared = ("servo", "gap", "reference", "noise", "seed", "name", "uplink", "downlink", "input_bias", "duration")
    for condition in (CLEAN, NOISE, BIASED):
        scenarios = [PolicyJob("paper", policy, condition).scenario_to_run() for policy in policy_runs.CONTESTANTS]
        for name in shared:
            assert len({repr(getattr(one, name)) for one in scenarios}) == 1
        assert len({repr(one.controller) for one in scenarios}) == 1
        assert {one.twin.method for one in scenarios} == {"whitened"}
        assert [one.twin.policy for one in scenarios] == [*policy_runs.POLICIES, "certified"]
        assert [one.twin.enabled for one in scenarios] == [True, True, True, True, False]
        assert [one.commissioning.window for one in scenarios] == [1.0, 1.0, 1.0, 2.0, 2.0]


@pytest.mark.slow
def test_the_certified_twin_takes_the_bias_away_and_its_fallback_set_alone_takes_most_of_it(outcomes):
    certified, alone = outcomes["certified"], outcomes[ALONE]
    assert certified.steps[1].error < 1e-6
    # Its integral stops in a zone about the reference; without integral action the error is Kp's share of the bias.
    start = certified.run.changes[0]
    assert start.gains.integral_only
    zone = start.gains.leave * start.tolerance
    assert certified.steps[1].error < alone.steps[1].error < zone < 0.05 / start.gains.Kp
    assert alone.steps[1].error < 0.25 * 0.05 / start.gains.Kp
    assert certified.run.changes[-1].gains.feedforward == pytest.approx(-0.05, abs=2e-4)
    assert not outcomes["paper"].steps[1].settled


@pytest.mark.slow
def test_updates_and_fallbacks_in_force_are_counted(outcomes):
    for one in outcomes.values():
        origins = [change.origin for change in one.run.changes]
        assert origins[0] is SettingOrigin.START
        assert one.total.updates == origins.count(SettingOrigin.UPDATE)
        assert one.total.fallbacks == origins.count(SettingOrigin.FALLBACK)
        times = [change.time for change in one.run.changes]
        assert times == sorted(times)
    assert outcomes["paper"].total.updates == 2
    assert outcomes[ALONE].total.updates == outcomes[ALONE].total.windows == 0


@pytest.mark.slow
def test_the_tolerance_in_force_is_the_trajectory_s(outcomes):
    """Two ways to the same staircase: what messages say, and what the simulation ran on."""
    for one in outcomes.values():
        trace, changes = one.run.trace, one.run.changes
        now = np.searchsorted([change.time for change in changes], trace.time + 1e-9, side="right") - 1
        said = np.array([change.tolerance for change in changes])[now]
        np.testing.assert_allclose(said[5:-1], trace.tolerance[5:-1], atol=1e-12)


def made_of(position, **other):
    """A trace of two steps of 10 s, to 1 mm and to -1 mm."""
    time = np.arange(0.0, 20.002, 0.002)
    zero = np.zeros_like(time)
    reference = np.where(time < 10.0 - 1e-9, 1e-3, -1e-3)
    signals = dict.fromkeys(("theta_m", "theta_d", "voltage", "gap", "tolerance"), zero)
    return Trace(time=time, position=position(time), reference=reference, **{**signals, **other})


def test_overshoot_is_relative_to_the_step_from_where_it_began():
    trace = made_of(lambda t: np.where(t < 5.0, 1.2e-3 * (t > 0.0), 1e-3) - np.where(t > 10.0, 2.3e-3, 0.0))
    assert policy_runs.overshoot(trace, 0.0, 10.0) == pytest.approx(0.2)
    assert policy_runs.overshoot(trace, 10.0, 20.0) == pytest.approx(0.15)
    still = made_of(lambda t: 1e-3 * (1.0 - np.exp(-t)))
    assert policy_runs.overshoot(still, 0.0, 10.0) == 0.0


@pytest.mark.slow
def test_totals_of_known_signals(outcomes):
    turning = np.concatenate([np.linspace(0.0, 4.0 * math.pi, 5001), np.linspace(4.0 * math.pi, 0.0, 5001)[1:]])
    voltage = np.full(10001, 0.3)
    trace = made_of(lambda t: np.where(t < 10.0 - 1e-9, 1e-3, -1e-3), theta_m=turning, voltage=voltage)
    run = replace(outcomes["paper"].run, trace=trace)
    total = policy_runs.measured_total(run)
    assert total.travel == pytest.approx(4.0)
    assert total.voltage == pytest.approx(0.3)
    assert total.voltage_at_rest == pytest.approx(0.3)
    shifted = replace(run, trace=replace(trace, position=trace.position + 2e-6))
    assert [step.error for step in policy_runs.measured_steps(shifted)] == pytest.approx([2e-6, 2e-6])


@pytest.mark.slow
def test_a_policy_that_cannot_design_states_the_reason(monkeypatch):
    scenario = PolicyJob("paper", "margin", NOISE, SHORT).scenario_to_run()
    limited = scenario.replace(controller=scenario.law.replace(voltage_limit=24.0))
    monkeypatch.setattr(PolicyJob, "scenario_to_run", lambda _: limited)
    found = PolicyJob("paper", "margin", NOISE, SHORT).run()
    assert "voltage limit" in found.refused
    assert (found.run, found.steps, found.total) == (None, (), None)
    told = report.policy_tables([found])
    assert told.totals == [("margin", *("–" for _ in report.HEADS[1:]))]
    assert "voltage limit" in told.refused[0][1]


@pytest.mark.slow
@pytest.mark.exploration
def test_every_policy_designs_in_noise():
    """The map behind `margin` is that of the loop that runs, its loop filter included."""
    found = PolicyJob("paper", "margin", NOISE, SHORT).run()
    assert (found.refused, len(found.steps)) == ("", 2)


@pytest.mark.slow
def test_gains_that_a_message_leaves_out_stay():
    scenario = PolicyJob("paper", "paper", CLEAN, SHORT).scenario_to_run()
    changes = policy_runs.run_twin(scenario).changes
    own = scenario.servo.controller
    assert {change.gains.Kp for change in changes} == {own.Kp}
    assert changes[-1].tolerance > changes[0].tolerance


@pytest.mark.slow
def test_drawn(biased):
    with style.look():
        figure = policies.plot(biased)
    labels = [axes.get_ylabel() for axes in figure.axes] + [figure.axes[-1].get_xlabel()]
    assert all(re.search(r"\((mm|deg|mV|s)\)|over", label) for label in labels)
    titles = [axes.get_title(loc="right") for axes in figure.axes]
    assert [title.split(":")[0] for title in titles if title] == list(policy_runs.CONTESTANTS)
    letters = [axes.get_title(loc="left") for axes in figure.axes]
    assert letters == [f"({letter})" for letter in "abcdefghij"]


@pytest.mark.slow
def test_beyond_json_follows_its_schema(biased):
    named = {"policies-bias": [replace(one, run=None) for one in biased.outcomes]}
    found = json.loads(documents.beyond_json(named, "paper"))
    assert set(found) == {"schema", "version", "preset", "definitions", "figures"}
    (rows,) = found["figures"].values()
    assert [row["policy"] for row in rows] == list(policy_runs.CONTESTANTS)
    for row, one in zip(rows, biased.outcomes, strict=True):
        assert set(row["total"]) == {
            *("voltage_v", "voltage_at_rest_v", "travel_turns", "estimates", "windows", "updates", "fallbacks")
        }
        assert [set(step) for step in row["steps"]] == 2 * [
            {"begin_s", "gap_rad", "settled", "error_m", "overshoot", "settling_s"}
        ]
        assert [step["error_m"] for step in row["steps"]] == [step.error for step in one.steps]
    never = replace(biased.outcomes[0].steps[0], settling=math.inf)
    fake = {"x": [replace(biased.outcomes[0], run=None, steps=(never,))]}
    assert json.loads(documents.beyond_json(fake, "paper"))["figures"]["x"][0]["steps"][0]["settling_s"] is None


@pytest.mark.slow
def test_the_chapter_stands_after_the_papers_figures(biased):
    told = tuple(replace(one, run=None) for one in biased.outcomes)
    drawn = [
        DrawnFigure("fig4", "Title", "Caption.", b"<svg/>"),
        DrawnFigure("policies-bias", "Title", "Caption.", b"<svg/>", told),
    ]
    text = report.report([], drawn, "paper")
    assert text.index("Figures</h2>") < text.index("Beyond the paper</h2>") < text.index("Errata and decisions")
    assert f"{told[0].steps[1].error * 1e3:.4f} ✗" in text
    assert "Beyond the paper" not in report.report([], drawn[:1], "paper")


@pytest.mark.slow
def test_one_figure_is_reproduced_with_its_numbers(tmp_path, monkeypatch, biased):
    figure = replace(policies.FIGURES[0], data=lambda _: biased)
    monkeypatch.setattr(figures, "FIGURES", (figure,))
    reproduce.reproduce(tmp_path, only=("policies",), console=Console(file=io.StringIO()))
    names = ["beyond.json", "claims.json", "policies.png", "policies.svg", "report.html"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert list(json.loads((tmp_path / "beyond.json").read_text())["figures"]) == ["policies"]
    assert st.__version__ in (tmp_path / "report.html").read_text()
