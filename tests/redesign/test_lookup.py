"""Settings verified beforehand: a certificate holds for every region inside its cell; foreign tables are refused."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from scaling import scaled

from servotwin.control.gains import gains_of
from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.plant.axis import Axis
from servotwin.plant.servo import PRESETS, Servo
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.lookup import (
    CellIndex,
    CertifiedTable,
    Grid,
    TablePolicy,
    cell_range,
    cells_of,
    certify_cell,
    table_of,
)
from servotwin.redesign.certified.lookup_file import build, load
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Region, Uncertainty
from servotwin.redesign.design import Design
from servotwin.redesign.policy import Evidence
from servotwin.redesign.registry import policy_of
from servotwin.twin.settings import TwinSettings

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
GRID = Grid(finest=15.0 * DEG, biases=(1e-2, 5e-2), noises=(0.0, 1e-5))
POLICY = CertifiedPolicy(
    SERVO,
    Uncertainty(gap=(0.0, 30.0 * DEG), input_bias=(-0.1, 0.1)),
    Demands(machines=16, conditions=4, screened=2, settled=0.8, integral=(0.0,), beyond=Beyond(machines=4)),
    Trial(),
    clock=lambda: 0.0,
)


@cache
def table() -> CertifiedTable:
    return table_of(
        POLICY, GRID, {key: certify_cell(POLICY, GRID, key) for key in cells_of(GRID, POLICY.uncertainty.gap)}
    )


def region(low=9.0, high=10.0, feedforward=0.0, left=1e-3, noise=0.0, friction=(0.0, 0.0)) -> Region:
    """With a bias of up to `left` V beside the feedforward."""
    return Region((low * DEG, high * DEG), feedforward, (-feedforward - left, -feedforward + left), friction, noise)


def evidence(degrees=10.0, bias=0.05, noise=0.0, std=0.02, **changes) -> Evidence:
    gap, spread = degrees * DEG, std * DEG
    estimate = GapEstimate(gap, spread, spread, (gap - 2.0 * spread, gap + 2.0 * spread), GapStatus.OK, 1.0)
    return Evidence(estimate, Disturbance(bias, 1e-5, noise, 0.3, 0.0), rests=(bias, bias), **changes)


# --- the grid


@pytest.mark.slow
@examples(15)
@given(st.floats(0.0, 60.0), st.floats(0.0, 60.0), st.floats(0.5, 100.0))
def test_every_interval_lies_in_a_cell_at_most_four_times_as_wide(one: float, other: float, finest: float) -> None:
    stated, grid = (2.0 * DEG, 62.0 * DEG), Grid(finest * DEG)
    low, high = sorted((stated[0] + one * DEG, stated[0] + other * DEG))
    found = replace(table(), grid=grid, stated=stated)
    region = Region((low, high), 0.0, (0.0, 0.0), (0.0, 0.0), 0.0)
    (key, *_) = found._containing(region)
    cell = cell_range(grid, stated, key)
    assert cell[0] <= low <= high <= cell[1] + 1e-12
    assert key.level == 0 or cell[1] - cell[0] <= 4.0 * (high - low) * (1.0 + 1e-9)
    assert cell[1] - cell[0] <= max(grid.levels(stated)[0], 4.0 * (high - low)) * (1.0 + 1e-9)
    assert key in set(cells_of(grid, stated))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"finest": 0.0}, "finest"),
        ({"biases": ()}, "biases"),
        ({"biases": (0.1, 0.05)}, "biases"),
        ({"noises": (-1.0,)}, "noises"),
        ({"noises": (0.0, math.inf)}, "noises"),
    ],
)
def test_a_grid_that_is_none_is_refused(changes: dict, named: str) -> None:
    with pytest.raises(InvalidInput, match=named):
        Grid(**changes)


@pytest.mark.parametrize("name", PRESETS)
def test_the_default_grid_of_a_preset(name: str) -> None:
    policy = CertifiedPolicy(Servo.preset(name), Uncertainty(input_bias=(-0.1, 0.1)))
    finest = 60.0 * DEG / 16.0
    assert Grid.of(policy) == Grid(finest)
    assert Grid.of(policy, noises=(0.0,)) == Grid(finest, noises=(0.0,))


def test_a_machine_in_other_units_has_the_grid_in_them() -> None:
    servo, steps = scaled(Servo.preset("paper"), 8.0, 2.0**-20, 2.0**7), (2.0**-20 * 1e-4, 2.0**-20 * 1e-3)
    found = Grid.of(CertifiedPolicy(servo, Uncertainty(step=steps)))
    assert found.finest == 60.0 * DEG / 16.0
    assert found.biases == pytest.approx([2.0**7 * bias for bias in Grid().biases])
    assert found.noises == pytest.approx([2.0**-20 * noise for noise in Grid().noises])


def test_the_narrowest_cells_are_a_sixteenth_of_the_stated_gaps_however_small_these_are() -> None:
    policy = CertifiedPolicy(Axis.preset("ball-screw"), Uncertainty(gap=(0.0, 1.5 * DEG), step=(1e-4, 1e-3)))
    grid = Grid.of(policy)
    assert len(grid.levels((0.0, 1.5 * DEG))) == 5
    exact = CertifiedPolicy(Axis.preset("ball-screw"), Uncertainty(gap=(DEG, DEG), step=(1e-4, 1e-3)))
    assert len(Grid.of(exact).levels((DEG, DEG))) == 1


# --- what is looked up


@pytest.mark.slow
@examples(25, deadline=None)
@given(
    st.floats(0.0, 30.0),
    st.floats(0.0, 30.0),
    st.floats(-0.1, 0.1),
    st.floats(2e-4, 5e-2),
    st.sampled_from((0.0, 1e-7, 1e-4)),
)
def test_a_looked_up_setting_is_verified_for_the_region(one, other, fed, left, noise) -> None:
    """The invariant that everything stands on: another draw of machines, from the region alone, says the same."""
    low, high = sorted((one, other))
    requested = region(low, high, fed, left, noise)
    found = table().find(requested)
    if isinstance(found, NotVerified):
        assert requested.largest_bias > GRID.biases[-1] * (1.0 - 1e-9)
        return
    assert found.gap[0] <= requested.gap[0]
    assert requested.gap[1] <= found.gap[1]
    assert found.input_bias[0] <= requested.input_bias[0] + 1e-12
    assert requested.input_bias[1] <= found.input_bias[1] + 1e-12
    assert found.setting.controller.feedforward == fed
    exact = POLICY.confirm(requested, found.setting)
    assert isinstance(exact, Certificate), exact
    assert exact.gap == requested.gap


@pytest.mark.slow
def test_a_feedforward_counts_by_what_it_leaves_of_the_bias() -> None:
    """A cell that is verified without a feedforward holds for all."""
    setting = table().fallback.setting
    fed = replace(setting, controller=setting.controller.replace(feedforward=0.07))
    known, biased = (region(feedforward=volts, left=5e-3).within(POLICY.uncertainty) for volts in (0.0, 0.07))
    members = draw_independently(SERVO, known, 16, 5)
    other = replace(draw_independently(SERVO, biased, 16, 5), direction=members.direction)
    (plain,), (shifted,) = assess([setting], members, POLICY.trial), assess([fed], other, POLICY.trial)
    np.testing.assert_allclose(shifted.tail, plain.tail, rtol=1e-6)
    np.testing.assert_allclose(shifted.overshoot, plain.overshoot, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(shifted.cost, plain.cost, rtol=1e-6)


def test_a_looked_up_setting_may_hold_what_it_feeds_forward() -> None:
    requested = region(feedforward=0.07, left=5e-3)
    found = table().find(requested)
    assert isinstance(found, Certificate)
    exact = POLICY.confirm(requested, found.setting)
    assert isinstance(exact, Certificate)
    assert exact.effort > 0.06
    assert exact.effort <= found.effort


@pytest.mark.slow
@pytest.mark.parametrize(
    ("requested", "why"),
    [
        (region(left=0.06), "60 mV of bias"),
        (region(high=31.0), "gaps of 9 to 31 deg"),
        (region(friction=(0.0, 1e-3)), "friction of up to 0.001 N m"),
        (region(feedforward=0.3), "a feedforward of 0.3 V"),
    ],
)
def test_a_region_that_no_cell_contains_is_not_covered(requested: Region, why: str) -> None:
    found = table().find(requested)
    assert isinstance(found, NotVerified)
    assert why in found.reason


def test_a_wider_cell_replaces_one_without_a_certificate() -> None:
    requested = region(1.0, 2.0)
    cells = dict(table().cells)
    narrow = [key for key in cells if key.level == 0]
    wide = replace(table(), cells={**cells, **dict.fromkeys(narrow)}).find(requested)
    assert isinstance(wide, Certificate)
    assert wide.gap == POLICY.uncertainty.gap
    none = replace(table(), cells=dict.fromkeys(cells)).find(requested)
    assert isinstance(none, NotVerified)


def test_the_running_setting_stays_where_a_somewhat_wider_cell_verifies_it() -> None:
    requested = region(1.0, 2.0, feedforward=0.03)
    narrow = table().find(requested)
    other = Design(narrow.setting.controller.replace(Kp=1e3, feedforward=0.0), narrow.setting.tolerance)
    cells = {key: found if key.level == 0 else replace(found, setting=other) for key, found in table().cells.items()}
    changed = replace(table(), cells=cells)
    kept = changed.find(requested, replace(other, controller=other.controller.replace(feedforward=-0.01)).setting())
    assert kept.setting.controller == other.controller.replace(feedforward=0.03)
    assert kept.gap == POLICY.uncertainty.gap
    assert changed.find(requested).setting == narrow.setting
    integral = replace(other, controller=other.controller.replace(Ki=1.0))
    assert changed.find(requested, integral.setting()).setting == narrow.setting


def test_the_running_setting_does_not_stay_for_a_much_wider_cell() -> None:
    fine = Grid(2.0 * DEG, (1e-2,), (0.0,))
    narrow, wide = (table().cells[CellIndex(level, 0, 0, 0)] for level in (0, 1))
    other = Design(wide.setting.controller.replace(Kp=1e3), wide.setting.tolerance)
    widest = len(fine.levels(POLICY.uncertainty.gap)) - 1
    assert widest > 3
    cells = {CellIndex(0, 0, 0, 0): narrow, CellIndex(widest, 0, 0, 0): replace(wide, setting=other)}
    found = replace(table(), grid=fine, cells=cells).find(region(0.1, 0.2), other.setting())
    assert found.setting == narrow.setting


def test_a_small_bias_is_not_looked_up_where_overshoot_was_not_judged() -> None:
    """Cells with more bias than is called known are verified without a bound on the overshoot."""
    cells = {key: found for key, found in table().cells.items() if key.bias == 1}
    assert isinstance(replace(table(), cells=cells).find(region(left=5e-3)), NotVerified)
    assert isinstance(replace(table(), cells=cells).find(region(left=2e-2)), Certificate)


@pytest.mark.slow
def test_a_cell_whose_voltage_meets_its_limit_is_verified_with_the_largest_feedforwards_too() -> None:
    tight = replace(POLICY, servo=SERVO.replace(voltage_limit=1.0))
    found = certify_cell(tight, GRID, CellIndex(0, 0, 0, 0))
    assert found is not None
    assert found.saturated
    assert found.settled == 1.0
    assert found.setting.controller.voltage_limit == 1.0
    assert found.setting.controller.feedforward == 0.0


@pytest.mark.slow
def test_a_cell_is_not_verified_where_the_largest_feedforward_leaves_too_little() -> None:
    servo, key = SERVO.replace(voltage_limit=0.3), CellIndex(0, 0, 0, 0)
    assert certify_cell(replace(POLICY, servo=servo, feedforward_limit=0.25), GRID, key) is not None
    assert certify_cell(replace(POLICY, servo=servo, feedforward_limit=0.28), GRID, key) is None


@pytest.mark.slow
def test_a_cell_whose_voltage_stays_below_its_limit_carries_the_limit() -> None:
    found = certify_cell(replace(POLICY, servo=SERVO.replace(voltage_limit=40.0)), GRID, CellIndex(0, 0, 0, 0))
    assert found is not None
    assert not found.saturated
    assert found.setting.controller.voltage_limit == 40.0


# --- the policy


def test_the_table_decides_like_the_policy_and_leaves_the_exact_verification() -> None:
    exact, looked_up = POLICY.redesign(evidence()), TablePolicy(POLICY, table()).redesign(evidence())
    assert looked_up.setting is not None
    assert looked_up.setting.gains.feedforward == exact.setting.gains.feedforward == -0.05
    assert exact.to_verify is None
    assert looked_up.to_verify is not None
    assert looked_up.to_verify.gap == exact.certificate.gap
    assert isinstance(POLICY.confirm(looked_up.to_verify, looked_up.certificate.setting), Certificate)


def test_a_region_without_a_cell_gets_the_fallback_set_and_no_verification() -> None:
    made = TablePolicy(POLICY, table()).redesign(replace(evidence(), disturbance=Disturbance(0, math.inf, 0.0, 0, 0)))
    assert "the fallback set is sent" in made.reason
    assert made.setting.gains == gains_of(table().fallback.setting.controller)
    assert made.to_verify is None


def test_a_setting_in_force_is_not_sent_again() -> None:
    policy = TablePolicy(POLICY, table())
    made = policy.redesign(evidence())
    again = policy.redesign(evidence(10.1, setting=made.setting))
    assert again.setting is None
    assert again.to_verify is None
    assert "in force already" in again.reason


# --- files


def built(path: Path, policy: CertifiedPolicy = POLICY, grid: Grid = GRID, cells: int | None = None) -> Path:
    """A table, or its first few cells."""
    steps = build(path, policy, grid)
    for done, _ in steps:
        if done == cells:
            steps.close()
    return path


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole table of cells that are verified already."""
    with pytest.MonkeyPatch.context() as patched:
        module = "servotwin.redesign.certified.lookup_file"
        patched.setattr(f"{module}.certify_cell", lambda _policy, _grid, key: table().cells[key])
        return built(tmp_path_factory.mktemp("tables") / "paper.table")


@pytest.mark.slow
def test_a_table_survives_its_file_unchanged(file: Path) -> None:
    assert load(file, POLICY) == table()


@pytest.mark.slow
def test_an_interrupted_table_is_continued(file: Path, tmp_path: Path, monkeypatch) -> None:
    path = built(tmp_path / "part.table", cells=3)
    with pytest.raises(InvalidInput, match=r"part\.table: \d+ cells of this table are not verified yet"):
        load(path, POLICY)
    looked_at = []

    def counted(policy, grid, key):
        looked_at.append(key)
        return table().cells[key]

    monkeypatch.setattr("servotwin.redesign.certified.lookup_file.certify_cell", counted)
    assert load(built(path), POLICY) == table()
    assert len(looked_at) == len(table().cells) - 3


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"servo": SERVO.replace(k=9e3)}, r"servo\.\w+"),
        ({"servo": SERVO.replace(Kd=-130.0)}, r"servo\.controller\.Kd = -135\.1"),
        ({"demands": replace(POLICY.demands, Ms=1.9)}, r"demands\.Ms = 2\.0, and this is 1\.9"),
        ({"uncertainty": POLICY.uncertainty.replace(m=0.2)}, r"uncertainty\.m = 0\.1, and this is 0\.2"),
        ({"trial": Trial(duration=40.0, last=10.0)}, r"trial\.duration"),
        ({"feedforward_limit": 0.1}, "feedforward_limit"),
    ],
)
def test_a_foreign_table_is_refused_by_name(file: Path, changes: dict, named: str) -> None:
    with pytest.raises(InvalidInput, match=named):
        load(file, replace(POLICY, **changes))


def test_a_table_of_another_version_is_refused(file: Path, monkeypatch) -> None:
    monkeypatch.setattr("servotwin.__version__", "99.0")
    with pytest.raises(InvalidInput, match=r"servotwin = .*, and this is 99\.0"):
        load(file, POLICY)


def test_a_table_on_another_grid_is_not_continued(file: Path) -> None:
    with pytest.raises(
        InvalidInput, match=r"another grid \(cells from 15 deg on, biases of 0.01, 0.05 V, noises of 0, 1e-05 m\)"
    ):
        next(build(file, POLICY, Grid(30.0 * DEG)))


@pytest.mark.parametrize("content", [b"", b"\x80", b"no table", b"\x81\xa4type\xa1x"])
def test_a_file_that_is_no_table_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.table"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match=r"x\.table: is no table"):
        load(path, POLICY)


def test_a_missing_table_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"none\.table: cannot be read"):
        load(tmp_path / "none.table", POLICY)


def test_settings_name_the_table(tmp_path: Path) -> None:
    known = TwinSettings(table=str(tmp_path / "none.table"))
    with pytest.raises(InvalidInput, match=r"none\.table: cannot be read"):
        policy_of(SERVO, known)
    with pytest.raises(InvalidInput, match="belongs to policy 'certified'"):
        TwinSettings(policy="paper", table="x.table")
