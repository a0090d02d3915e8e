"""`servotwin identify` on logs in which the machine becomes another one, or has a fault that looks like that."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servotwin as st
from servotwin.cli.identify import Identification, IdentifyOptions, identify
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import write_log

pytestmark = pytest.mark.slow

GAP, RATE, STEP = math.radians(0.36), 2000.0, 0.25
BEFORE, AFTER = 3, 4  # windows


def axis(mass: float = 1.0, force: float = 0.0) -> st.Axis:
    """A ball screw that carries a load so many times as heavy, on which a constant force (N) acts."""
    screw = st.Axis.preset("ball-screw")
    return screw.replace(load=replace(screw.load, m=(mass * screw.load.m[0],), friction=0.0, force=force))


def identified(folder: Path, machine: st.Axis, gap: float = GAP, step: float = 2e-3) -> Identification:
    """Windows of the stated axis, and then of a machine, as one log."""
    columns = []
    for plant, total, windows, size in ((axis(), GAP, BEFORE, step), (machine, gap, AFTER, -step)):
        reference = st.SquareWave(size, 2.0 * STEP)
        run = st.simulate(plant, windows * STEP, reference=reference, gap=total, sample_rate=RATE)
        columns.append({name: values[:-1] for name, values in run.columns.items()})
    table = {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}
    table["time_s"] = np.arange(table["time_s"].size) / RATE
    write_log(SignalTable(table, {"servo": axis().dumps()}), folder / "log.npz")
    wear = {"wear_deg": 0.01, "wear_over_s": (BEFORE + AFTER) * STEP}
    return identify(IdentifyOptions(folder / "log.npz", window=0.95 * STEP, **wear))


def changes(found: Identification) -> dict[int, str]:
    """Windows from which on the machine is said to be another one, with the sentences."""
    said = ((i, each) for i, remarks in enumerate(found.remarks) for each in remarks)
    return {i: each for i, each in said if "another one from here on" in each}


@pytest.mark.parametrize(("mass", "gap"), [(2.0, GAP), (1.6, 1.5 * GAP)])
def test_the_gap_is_found_again_after_another_payload(tmp_path: Path, mass: float, gap: float) -> None:
    found = identified(tmp_path, axis(mass), gap)
    for i, each in enumerate(found.estimates):
        assert each.ok, (i, each.reasons)
        assert each.interval[0] <= (GAP if i < BEFORE else gap) <= each.interval[1]
    said = changes(found)
    assert list(said) == [BEFORE]
    heavier, known = map(float, re.findall(r"a load (\S+) ± (\S+) times as heavy", said[BEFORE])[0])
    assert abs(heavier - mass) <= known < 0.1 * mass
    assert found.trend is not None
    assert found.trend.updates == AFTER


def test_a_payload_that_also_pulls_at_the_axis_gives_no_gap(tmp_path: Path) -> None:
    """Its weight, which nobody stated, holds it on one flank: afresh each window is accepted, with a gap of none."""
    found = identified(tmp_path, axis(2.0, force=300.0), step=1e-3)
    assert all(each.ok for each in found.estimates[:BEFORE])
    assert not any(each.ok for each in found.estimates[BEFORE:])
    assert changes(found) == {}
