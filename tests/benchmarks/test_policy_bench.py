"""The policies side by side: machines, one trial, the table, the command."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from benchmarks.policies.command import chosen, dumps, policies, shown
from benchmarks.policies.contenders import constants, contender
from benchmarks.policies.loops import FALLBACK, OWN, TWIN, LoopScores, best_rows, constants_of, scored
from benchmarks.policies.machines import BIAS, BLOCKS, machines
from benchmarks.policies.table import PolicyScores, compare
from benchmarks.policies.trial import REST, Contender, run_machine, scores
from benchmarks.policies.worn import BLOCKS as WORN_BLOCKS
from benchmarks.policies.worn import HALF_PERIOD, RATE, STEPS, worn_machines
from servotwin.errors import InvalidInput
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Step
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate

MODEL = Servo.preset("paper")
KNOWN = Uncertainty(input_bias=(-0.1, 0.1))
CALM = Design(MODEL.controller.replace(Ki=0.0))


FEW = Demands(machines=40, screened=4, conditions=4, beyond=Beyond(machines=8), settled=0.9)


@pytest.fixture
def few_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings are verified on few machines."""
    monkeypatch.setattr("benchmarks.policies.contenders.CertifiedPolicy", partial(CertifiedPolicy, demands=FEW))


@pytest.mark.parametrize("block", BLOCKS)
def test_machines_are_what_is_stated(block: str) -> None:
    those = machines(MODEL, KNOWN, block, 50, 7)
    assert those == machines(MODEL, KNOWN, block, 50, 7)
    assert all(0.0 <= m.gap <= KNOWN.gap[1] and abs(m.theta_d0) <= 0.5 * m.gap for m in those)
    assert all(KNOWN.step[0] <= m.step <= KNOWN.step[1] for m in those)
    assert all(abs(m.servo.k / MODEL.k - 1.0) <= 0.15 and abs(m.servo.c / MODEL.c - 1.0) <= 0.5 for m in those)
    assert any(m.input_bias for m in those) == (block == "bias")
    assert any(m.friction for m in those) == (block == "friction")
    assert all(m.friction <= BIAS * m.servo.k_T / m.servo.R for m in those)


def test_scores_are_those_of_the_closed_form() -> None:
    """Without a gap the calm loop is linear: its error is that of the closed loop's step response."""
    run = simulate(MODEL, REST + 60.0, controller=CALM.controller, reference=Step(1e-3, REST), sample_rate=500.0)
    found = scores(run, 1e-3, CALM, MODEL)
    time = np.arange(0.0, 60.0 + 1e-9, 0.002)
    response = MODEL.closed_loop(CALM.controller).step(time)
    assert found.overshoot == pytest.approx(response.max() - 1.0, abs=1e-6)
    assert found.settling == pytest.approx(time[np.flatnonzero(np.abs(response - 1.0) > 0.02)[-1]], abs=0.002)
    assert found.cost == pytest.approx(np.abs(response - 1.0).mean() * 60.0, rel=1e-3)
    assert found.ripple < 1e-12
    assert (found.scale, found.integral, found.width) == (1.0, 0.0, 0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("few_machines")
def test_the_certified_policy_learns_the_bias_that_a_constant_keeps() -> None:
    machine = max(machines(MODEL, KNOWN, "bias", 10, 1), key=lambda m: abs(m.input_bias))
    learnt = run_machine(machine, "bias", MODEL, contender("certified", MODEL, KNOWN))
    constant = run_machine(machine, "bias", MODEL, Contender(None, CALM))
    assert constant.tail == pytest.approx(abs(machine.input_bias / CALM.controller.Kp), rel=1e-2)
    # The rest before the step and the first one after it are alike, which speaks of a bias.
    assert learnt.tail < 0.05 * constant.tail
    # Without integral action only a bias that is known meets the demands.
    assert learnt.integral == 0.0
    assert learnt.cost < constant.cost


def test_constants_are_all_different_and_hold_the_calm_one() -> None:
    found = constants(MODEL, KNOWN)
    assert len(set(found.values())) == len(found) > 15
    assert CALM in found.values()


def test_no_constant_is_dropped_for_its_name() -> None:
    """Those that differ in the zone about the reference that stops the integral have names of their own."""
    demands = replace(Demands(), Ms=100.0, Ms_worst=100.0, shapes=((1.0, 1.0),))
    every = candidates_of(MODEL, KNOWN, demands, disturbed=True, noisy=False)
    found = set(constants(MODEL, KNOWN).values())
    assert len({each.tolerance for each in every if each.controller.integral_only}) > 1
    assert set(every) <= found


@pytest.mark.slow
@pytest.mark.usefixtures("few_machines")
@pytest.mark.exploration
def test_the_table_and_its_document(monkeypatch: pytest.MonkeyPatch) -> None:
    """The best of every tenth constant: how many are tried does not matter here."""
    few = dict(list(constants(MODEL, KNOWN).items())[::10])
    monkeypatch.setattr("benchmarks.policies.table.constants", lambda *_: few)
    rows = list(compare(MODEL, KNOWN, 2, seed=3, blocks=("clean",)))
    assert [row.name for row in rows[:5]] == ["no dead zone", "paper", "margin", "hysteresis", "certified"]
    assert len(few) > 15
    assert rows[-1].name in {f"constant: {name}" for name in few}
    certified = rows[4]
    assert certified.settled == 1.0
    assert certified.at("tail", 95.0) < 5e-6
    assert rows[0].at("tail", 50.0) > 10.0 * certified.at("tail", 95.0)
    assert len(shown(rows).rows) == len(rows)
    assert sum(int(cell) for cell in chosen(rows).columns[2]._cells) == 2
    document = json.loads(dumps(rows, "2026-11-21"))
    assert document["rows"][4]["tail"] == pytest.approx(list(certified.scores.tail))
    assert document["rows"][0]["gap_deg"] == pytest.approx([math.degrees(m.gap) for m in certified.machines], abs=1e-6)


def test_settled_is_a_share() -> None:
    those = tuple(machines(MODEL, KNOWN, "clean", 2, 1))
    still, hunting = (
        run_machine(those[0], "clean", MODEL, Contender(None, s)) for s in (CALM, Design(MODEL.controller))
    )
    row = PolicyScores("clean", "two", type(still)(*np.array([still, hunting]).T), those)
    assert row.settled == 0.5


def test_a_file_that_cannot_be_written_is_reported_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="json"):
        policies("", tmp_path / "out.csv", 2, console=Console(quiet=True))


def test_blocks_of_worn_machines_differ_by_their_disturbances_only() -> None:
    drawn = {block: worn_machines(block, 3, 5) for block in WORN_BLOCKS}
    assert [m.plant.k for m in drawn["bias"]] == [m.plant.k for m in worn_machines("bias", 3, 5)]
    for block, those in drawn.items():
        assert all((m.input_bias != 0.0) == (block in ("bias", "all")) for m in those)
        assert all((m.friction > 0.0) == (block in ("friction", "all")) for m in those)
        assert all((m.delay > 0) == (block in ("delay", "all")) for m in those)
        assert all((m.plant.position_resolution > 0.0) == (block in ("quantisation", "all")) for m in those)
        assert all((m.model.controller.voltage_limit is not None) == (block in ("saturation", "all")) for m in those)
        assert all(m.plant.k != m.model.k for m in those)


def test_the_cost_of_a_loop_is_the_error_s_integral_per_step() -> None:
    """A run whose error is a tenth of the step for half of each half period, and nothing else."""
    (machine,) = worn_machines("model error", 1, 5)
    samples = round(RATE * HALF_PERIOD)
    sizes = [machine.amplitude] + [2.0 * machine.amplitude] * (STEPS - 1)
    error = np.concatenate([np.r_[np.full(samples // 2, 0.1 * s), np.zeros(samples - samples // 2)] for s in sizes])
    run = SimpleNamespace(reference=np.r_[error, 0.0], position=np.zeros(error.size + 1))
    found = scored(machine, run)
    assert found.cost == pytest.approx(0.05 * HALF_PERIOD)
    assert (found.settled, found.tail) == (1.0, 0.0)


@pytest.mark.slow
def test_constants_of_a_loop_come_with_and_without_velocity_feedforward_and_bounds() -> None:
    (machine,) = worn_machines("model error", 1, 5)
    found, model = constants_of(machine), machine.model
    assert len({each.controller for each in found.values()}) == len(found) > 100
    assert found[OWN].controller == model.controller.replace(Ki=0.0)
    for name, setting in found.items():
        law = setting.pid
        assert name == FALLBACK or name.endswith(f"velocity x {law.velocity_feedforward * model.p / model.k_B:g}") == (
            law.velocity_feedforward > 0.0
        )
        # Away from the bounds, so that the other plants of the ranges do not matter.
        peak = model.margins(law.replace(velocity_feedforward=0.0)).Ms
        assert peak <= 2.0 or not (name == FALLBACK or name.startswith("within the bounds"))
    lively = found["Kp, Kd x 0.85, Ki x 0, velocity x 0.5"].pid
    assert (lively.Kp, lively.Ki) == (pytest.approx(0.85 * model.controller.Kp), 0.0)


def test_the_best_constants_are_those_with_the_lowest_cost_p95() -> None:
    def costs(*values: float) -> list[LoopScores]:
        return [LoopScores(value, value, 1.0, 0.0) for value in values]

    names = [TWIN, FALLBACK, OWN, "within the bounds: slow", "lively", "lively, velocity x 0.5"]
    values = [costs(0.1, 0.1), costs(3.0, 3.0), costs(4.0, 4.0), costs(2.0, 2.0), costs(1.0, 9.0), costs(1.0, 1.5)]
    found = [dict(zip(names, machine, strict=True)) for machine in zip(*values, strict=True)]
    assert [(row.name, row.at("cost", 100.0)) for row in best_rows("bias", found)] == [
        (TWIN, 0.1),
        (FALLBACK, 3.0),
        (OWN, 4.0),
        ("best constant without velocity feedforward: slow", 2.0),
        ("best constant of all: lively, velocity x 0.5", 1.5),
        ("best constant within the bounds: slow", 2.0),
    ]
