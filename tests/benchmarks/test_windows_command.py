"""`servotwin bench windows`: what is counted, shown and written."""

import json
import math

import numpy as np
import pytest

from benchmarks import alone, windows
from benchmarks.corrupted import KINDS, corrupted_windows
from benchmarks.estimator_windows import WindowCase
from benchmarks.wrong_models import Tally
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus, no_estimate
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo

DEG = math.pi / 180.0
GAP = 10.0 * DEG
WINDOW = Window(np.linspace(0.0, 1e-3, 500), np.linspace(0.0, 10.0, 500), sample_rate=5e3)
CASE = WindowCase(WINDOW, Servo.preset("paper"), GAP, 0.0, 1.0, 1.0, "a case")


def estimated(error, half, status=GapStatus.OK):
    gap = GAP + error * DEG
    return GapEstimate(gap, 0.02 * DEG, 0.03 * DEG, (gap - half * DEG, gap + half * DEG), status, 0.0)


def test_only_a_large_error_outside_of_its_interval_is_false():
    tally = Tally()
    for error, half in ((0.05, 0.01), (0.3, 0.4), (0.3, 0.1), (0.01, 0.1)):
        tally.add(CASE, estimated(error, half), late=True)
    tally.add(CASE, estimated(0.2, 1.0, status=GapStatus.LOWER_BOUND), late=False)
    tally.add(CASE, no_estimate(0.0), late=False)
    assert (tally.windows, tally.accepted, tally.false, tally.inside, tally.within, tally.above) == (6, 4, 1, 2, 1, 1)
    assert tally.worst == pytest.approx(0.3 * DEG)
    both = windows.total([tally, tally])
    assert (both.windows, both.false, len(both.examples)) == (12, 2, 2)


def test_a_seed_draws_the_same_windows_and_another_one_others():
    first, again, other = (next(iter(corrupted_windows("soft screw", 1, seed))) for seed in (4, 4, 5))
    assert first.gap == again.gap != other.gap
    assert len(KINDS) == 28


def test_document(tmp_path, monkeypatch: pytest.MonkeyPatch):
    tally = Tally()
    tally.add(CASE, estimated(0.3, 0.1), late=True)
    monkeypatch.setattr(windows, "shared", lambda _function, tasks: ((task, tally) for task in tasks))
    output = tmp_path / "windows.json"
    windows.windows("2026-11-22", output, 2, 3, ("clean", "soft screw"))
    document = json.loads(output.read_text())
    assert document["schema"] == windows.SCHEMA
    assert [row["kind"] for row in document["tallies"]][:4] == ["clean", "soft screw"] * 2
    assert document["tallies"][0]["false"] == 1


def test_only_some_take_a_seed():
    with pytest.raises(InvalidInput, match="--seed: only bench windows, loops, certificates or endurance"):
        alone.run_alone(("estimator",), "", None, True, False, seed=3)


def test_a_fleet_of_another_size_has_the_same_cadence(monkeypatch):
    chosen = []
    bench = alone.ALONE["fleet"]._replace(run=lambda _date, _output, scale: chosen.append(scale))
    monkeypatch.setattr(alone, "ALONE", {**alone.ALONE, "fleet": bench})
    assert alone.run_alone(("fleet",), "", None, False, False, full=True, servos=3000)
    assert (chosen[0].servos, chosen[0].rate, chosen[0].outage) == (3000, 150.0, 600.0)
    with pytest.raises(InvalidInput, match="--servos: only bench endurance or fleet takes it"):
        alone.run_alone(("windows",), "", None, True, False, servos=30)
