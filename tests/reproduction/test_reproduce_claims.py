"""The claims: the list is whole, verdicts follow from measurements, and those agree with other sources."""

import dataclasses
import json
import math

import control
import numpy as np
import pytest

import servotwin as st
from servotwin.plant.servo import PRESETS
from servotwin.reproduction import claims, documents
from servotwin.reproduction.claims import ClaimResult, Finding, Value, Verdict
from servotwin.reproduction.claims.linear import best_pd, pd_family
from servotwin.reproduction.claims.registry import decided
from servotwin.reproduction.measures import MeasuredStep
from servotwin.reproduction.runs import Runs
from servotwin.reproduction.twin_runs import TwinJob

LISTED = {claim.id: claim for claim in claims.claims()}


@pytest.fixture(scope="module")
def runs():
    return {preset: Runs(preset) for preset in PRESETS}


def finding(runs, claim_id, preset="paper"):
    return claims.measure(LISTED[claim_id], runs[preset]).finding


def number(found, name):
    return next(value.number for value in found.values if value.name == name)


def test_the_list_is_long_enough_and_every_row_is_whole():
    assert len(claims.claims()) == len(LISTED) >= 25
    for claim in LISTED.values():
        assert claim.sentence
        assert claim.where
        assert len(claim.criterion) > 20


def test_every_claim_has_one_measuring_function_and_none_is_left_over():
    assert claims.measured_ids() == set(LISTED)


@pytest.mark.parametrize(
    "words",
    [
        *(
            "bandwidth frequency",
            "phase margin",
            "required bandwidth",
            "steady-state error",
            "limit cycle",
            "0, 5, 10 or 15",
        ),
        *(
            "over-estimate",
            "under-estimate",
            "17 degrees",
            "substantially decayed",
            "at all times",
            "under 5%",
            "unbiased",
        ),
        *(
            "communication and estimation delay",
            "0.25sec",
            "1.6 ms",
            "10,000",
            "20 dB",
            "time < 20 s",
            "fourth and fifth",
        ),
        *("larger dead zone", "slightly biased", "faster than real-time", "amplitude increases"),
    ],
)
def test_the_list_contains_the_required_claims(words):
    assert any(words in claim.sentence for claim in LISTED.values())


def test_a_verdict_is_the_criterion_and_nothing_else():
    assert decided(True, "why").verdict is Verdict.REPRODUCED
    assert decided(False, "why").verdict is Verdict.NOT_AS_STATED


@pytest.mark.parametrize("preset", PRESETS)
def test_margins_agree_with_python_control(runs, preset):
    loop = st.Servo.preset(preset).to_control().loop
    _, margins, _, _, crossovers, _ = control.stability_margins(loop, returnall=True)
    found = finding(runs, "crossover", preset)
    assert number(found, "gain crossover 1") == pytest.approx(min(crossovers), rel=1e-6)
    smallest = min(abs((margin + 180.0) % 360.0 - 180.0) for margin in margins)
    assert number(finding(runs, "phase-margin", preset), "smallest phase margin") == pytest.approx(smallest, rel=1e-5)


def test_the_verdict_on_the_crossover_follows_the_preset(runs):
    verdicts = [finding(runs, "crossover", preset).verdict for preset in PRESETS]
    assert verdicts == [Verdict.REPRODUCED, Verdict.NOT_AS_STATED, Verdict.REPRODUCED]


@pytest.mark.slow
def test_a_filtered_pd_with_the_required_bandwidth_exists():
    """That the printed sentence is not a law: an independent computation of the best one found."""
    servo = st.Servo.preset("paper")
    margin, law = best_pd(servo, [law for law in pd_family(servo) if servo.closed_loop(law).is_stable()])
    s = control.tf("s")
    loop = (law.Kp + law.Kd * s / (law.Tf * s + 1)) * control.tf(servo.to_control().G1 * servo.to_control().G2)
    assert control.margin(loop)[1] == pytest.approx(margin, rel=1e-5)
    assert control.margin(loop)[3] == pytest.approx(10.0, rel=1e-6)
    assert max(control.feedback(loop, 1).poles().real) < 0.0


def test_the_limit_cycle_is_the_known_one(runs):
    found = finding(runs, "limit-cycle")
    assert number(found, "frequency, gap 10 deg") == pytest.approx(1.480016436988, rel=1e-6)
    assert number(found, "amplitude, gap 10 deg") == pytest.approx(0.179574563547, rel=1e-5)


@pytest.mark.slow
def test_fig_12_is_lost_where_it_is_known_to_be(runs):
    found = finding(runs, "lost-near-17")
    assert found.verdict is Verdict.REPRODUCED
    assert number(found, "gap where the first begins") == pytest.approx(17.92, abs=0.01)
    assert number(found, "to 30 deg: gap where the first begins") == pytest.approx(19.44, abs=0.01)


@pytest.mark.slow
def test_the_bias_with_a_known_gap_is_the_known_one(runs):
    found = runs["paper"].get(TwinJob("paper", exact=True)).trace.steps
    assert max(abs(step.bias) for step in found) == pytest.approx(0.072e-3, abs=0.001e-3)
    assert [round(step.amplitude * 1e3, 3) for step in found] == [0.009, 0.041] + [0.0] * 8


def test_observer_claims_find_errata_e5_and_e6(runs):
    assert number(finding(runs, "observer-gains"), "fastest pole") == pytest.approx(-2.56e5, rel=1e-3)
    assert number(finding(runs, "observer-gains"), "slowest pole") == pytest.approx(-0.0125, rel=1e-3)
    assert finding(runs, "observer-matrix").verdict is Verdict.NOT_AS_STATED
    assert number(finding(runs, "observer-quarter-second"), "time for α = 40 1/s") == pytest.approx(0.247, abs=1e-3)


def test_claims_that_need_the_reference_are_measured_for_both_readings(runs):
    result = claims.measure(LISTED["quarter-of-step"], runs["paper"])
    assert (result.finding.verdict, result.unipolar.verdict) == (Verdict.NOT_AS_STATED, Verdict.REPRODUCED)
    assert claims.measure(LISTED["crossover"], runs["paper"]).unipolar is None


def test_a_changed_run_changes_the_verdict(runs):
    """No verdict is a constant: the same function on a run that never rests says so."""
    fake = Runs("paper")
    moving = MeasuredStep(0.0, 60.0, 1e-3, 1e-3, 1e-3, 0.0, False, math.inf, 0.0, 0.0)
    fake.settle = lambda *_, **__: moving
    assert claims.measure(LISTED["settle-0-5-10-15"], fake).finding.verdict is Verdict.NOT_AS_STATED
    assert claims.measure(LISTED["dead-zone-too-small"], fake).finding.verdict is Verdict.REPRODUCED
    assert finding(runs, "settle-0-5-10-15").verdict is Verdict.REPRODUCED


def test_noise_is_as_described(runs):
    assert number(finding(runs, "snr-20-db"), "signal to noise") == pytest.approx(20 * math.log10(1 / 0.22), abs=0.2)
    assert finding(runs, "noise-spectrum").verdict is Verdict.REPRODUCED


def fake_results():
    claim = LISTED["crossover"]
    values = (Value("there", 1.5, "rad/s"), Value("missing", math.nan, "mm"), Value("never", math.inf, "s"))
    one = ClaimResult(claim, "paper", Finding(Verdict.REPRODUCED, "a < b & c", values))
    other = dataclasses.replace(one, preset="table1", unipolar=Finding(Verdict.NOT_AS_STATED, "because", ()))
    return [one, other]


def test_claims_json_follows_its_schema():
    found = json.loads(documents.claims_json(fake_results()))
    assert found["schema"] == documents.CLAIMS_SCHEMA
    assert set(found) == {"schema", "paper", "version", "definitions", "presets", "claims"}
    assert found["presets"]["table1"]["model"] == st.Servo.preset("table1").version
    (claim,) = found["claims"]
    assert {key: claim[key] for key in ("id", "sentence", "where", "criterion", "amended")} == dataclasses.asdict(
        LISTED["crossover"]
    )
    paper, table1 = claim["results"]["paper"], claim["results"]["table1"]
    assert set(paper) == {"verdict", "why", "values", "unipolar"}
    assert [value["number"] for value in paper["values"]] == [1.5, None, None]
    assert paper["unipolar"] is None
    assert table1["unipolar"]["verdict"] == "not as stated"


def test_finding_numbers_are_plain_floats():
    found = decided(True, "why", ("count", np.int64(3)), ("flag", np.bool_(True)), ("ratio", np.float64(0.5), "%"))
    assert [type(value.number) for value in found.values] == [float, float, float]
