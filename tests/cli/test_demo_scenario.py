"""`servotwin demo SCENARIO.toml`: any axis that wears, alone and with its twin, in its own units."""

import dataclasses
import io
import math
import re
from pathlib import Path

import pytest
from rich.console import Console

from servotwin.cli import demo
from servotwin.cli.demo_case import Case, scenario_case
from servotwin.cli.demo_sent import sent_heads, sent_texts
from servotwin.control.gains import gains_of
from servotwin.errors import InvalidInput
from servotwin.messages import Setting, Update
from servotwin.plant.axis import Axis
from servotwin.plant.display_units import DEGREES, MILLIMETRES
from servotwin.reproduction.figures import wear_panels
from servotwin.reproduction.twin_runs import EstimateRecord

SCOPE = """servo = "telescope"
name = "scope"
duration_s = 120.0
reference = {kind = "square", amplitude_deg = 0.14, period_s = 80.0}
gap = {from_deg = 0.5, to_deg = 2.5, over_s = 120.0}
recording = {window_s = 20.0, pre_trigger_s = 2.0}
edge = {period_s = 0.1}
[twin]
policy = "hysteresis"
uncertainty = {gap_deg = [0.0, 5.0], step_deg = [0.1, 0.4]}
"""
PAPER_RULE = SCOPE.replace('"hysteresis"', '"paper"')


def written(folder: Path, text: str) -> Path:
    path = folder / "scope.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The report's path and the text in the terminal."""
    folder, console = tmp_path_factory.mktemp("demo"), Console(file=io.StringIO(), width=80)
    path = demo.demo(folder / "out", console=console, scenario=written(folder, SCOPE))
    assert isinstance(console.file, io.StringIO)
    return path, console.file.getvalue()


@pytest.mark.slow
def test_the_terminal_compares_the_machine_alone_with_both_twins(shown: tuple[Path, str]) -> None:
    text = shown[1]
    rows = [line for line in text.splitlines() if "rests 0" in line or "moves 0" in line]
    assert [int(line.split()[0]) for line in rows] == [1, 2, 3]
    assert all(line.count("rests") + line.count("moves") == 3 for line in rows)
    heads = text[text.index("gap ") : text.index("\n1 ")].split()
    assert " ".join(heads) == "gap estimate alone paper's hysteresis step deg deg mdeg mdeg mdeg"
    truths = [float(line.split()[1]) for line in rows]
    assert truths == sorted(truths)
    assert 0.5 < truths[0] < truths[-1] < 2.5
    assert "with the paper's dead zone 3, with the hysteresis twin 3" in " ".join(text.split())
    assert "settings: 2 sent, 2 applied" in text


@pytest.mark.slow
def test_the_report_has_every_run_and_what_was_sent_in_the_axis_own_units(shown: tuple[Path, str]) -> None:
    path = shown[0]
    assert sorted(p.name for p in path.parent.iterdir()) == ["demo.png", "demo.svg", "report.html"]
    page = path.read_text()
    assert "0.5 deg at the motor (0.25 mdeg at the load) to 2.5 deg at the motor" in page
    assert "dead zone, mdeg" in page
    assert "feedforward, mrad/s" in page
    assert "alone: swing, mdeg" in page
    assert "mm" not in re.sub(r"data:image[^\"]*|<style.*?</style>", "", page, flags=re.S).replace("comm", "")


def case_of(folder: Path, text: str) -> Case:
    return scenario_case(written(folder, text))


def test_the_runs_differ_by_their_twin_only(tmp_path: Path) -> None:
    case = case_of(tmp_path, SCOPE)
    assert [each.head for each in case.columns] == ["alone", "paper's", "hysteresis"]
    alone, ruled, twinned = (each.scenario for each in case.columns)
    assert (alone.twin.enabled, ruled.twin.enabled) == (False, True)
    assert (ruled.twin.policy, ruled.twin.k_dz) == ("paper", 1.0)
    assert alone.law == alone.start_law == twinned.law
    assert alone.start_tolerance == 0.0
    assert alone.replace(twin=twinned.twin, recording=twinned.recording, supervision=twinned.supervision) == twinned
    windows = {(each.commissioning.window, each.commissioning.pre_trigger) for each in (alone, ruled, twinned)}
    assert windows == {(20.0, 2.0)}


def test_a_run_that_tells_nothing_is_left_out_in_one_sentence(tmp_path: Path) -> None:
    case = case_of(tmp_path, PAPER_RULE)
    assert [each.head for each in case.columns] == ["alone", "paper"]
    assert case.left_out == "The paper's dead zone has no run of its own: it is this twin's policy."


def test_a_stepper_has_no_run_with_a_dead_zone_that_moves_it(tmp_path: Path) -> None:
    text = """servo = "stepper-stage"
duration_s = 60.0
reference = {kind = "square", amplitude_mm = 0.1, period_s = 10.0}
gap = {from_deg = 0.1, to_deg = 0.9, over_s = 60.0}
recording = {window_s = 7.5, pre_trigger_s = 4.75}
controller = {integral_only = false}
edge = {period_s = 0.1}
twin = {uncertainty = {gap_deg = [0.0, 2.0], step_mm = [0.05, 0.4]}}
"""
    case = case_of(tmp_path, text)
    assert [each.head for each in case.columns] == ["alone", "certified"]
    assert re.search(
        "paper's dead zone has no run of its own: policy 'paper': .*stepper would go to the angle zero", case.left_out
    )
    assert [each.head for each in case_of(tmp_path, text.replace("false", "true")).columns][1] == "paper's"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("from_deg = 0.5, to_deg = 2.5, over_s = 120.0", "total_deg = 0.5"), r"\[gap\]: does not grow .*from_deg"),
        (("from_deg = 0.5", "from_deg = 3.5"), r"\[gap\]: does not grow"),
        (('"square", amplitude_deg = 0.14, period_s = 80.0', '"constant", value_deg = 0.1'),
         r"\[reference\]: has 1 step in 120 s.*at least 2"),
        (('"square", amplitude_deg = 0.14, period_s = 80.0', '"s-curve", from_deg = 0.0, to_deg = 1.0, over_s = 9.0'),
         r"\[reference\]: has no step"),
        (('policy = "hysteresis"', "enabled = false"), r"twin.enabled = false: .*give true"),
    ],
)  # fmt: skip
def test_a_scenario_in_which_nothing_wears_or_steps_is_refused(
    tmp_path: Path, change: tuple[str, str], sentence: str
) -> None:
    path = written(tmp_path, SCOPE.replace(*change))
    with pytest.raises(InvalidInput, match=f"scope.toml: {sentence}"):
        demo.demo(tmp_path / "out", scenario=path)
    assert not (tmp_path / "out").exists()


def test_an_axis_whose_gap_cannot_be_seen_is_refused_in_its_own_words(tmp_path: Path) -> None:
    text = SCOPE.replace("telescope", "emps").replace("_deg = 0.14", "_mm = 0.14").replace("step_deg", "step_mm")
    text = text.replace('"hysteresis"', '"paper"\nk_dz = 0.0')
    with pytest.raises(InvalidInput, match=r"scope.toml: .*do not show the gap"):
        demo.demo(tmp_path / "out", scenario=written(tmp_path, text))


@pytest.mark.parametrize(
    ("k_dz", "words", "own_run"),
    [(0.0, "leaves the controller", True), (0.5, "0.5 times as wide", True), (1.0, "as wide as the gap", False)],
)
def test_a_picture_says_what_the_paper_s_rule_does_with_its_factor(
    tmp_path: Path, k_dz: float, words: str, own_run: bool
) -> None:
    """The paper's dead zone has a run of its own, unless this is it."""
    case = scenario_case(written(tmp_path, SCOPE.replace('"hysteresis"', f'"paper"\nk_dz = {k_dz}')))
    assert words in case.twinned.explained
    assert (case.published is not None) == own_run
    assert bool(case.left_out) != own_run


def test_a_preset_beside_a_scenario_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"--preset 'table1': is of the paper's servo, and .*scope.toml has its own"):
        demo.demo(tmp_path / "out", "table1", scenario=written(tmp_path, SCOPE))


def test_an_unstable_loop_is_refused(tmp_path: Path) -> None:
    text = SCOPE + "[controller]\nkp_rad_per_s_per_rad = 2e5\n"
    with pytest.raises(InvalidInput, match="unstable on this axis even without a gap"):
        demo.demo(tmp_path / "out", scenario=written(tmp_path, text))


def update(setting: Setting) -> Update:
    return Update("scope", 1, 0, ("boot-1", 0), 12.0, 0.01, None, (None, None), "ok", setting, 99.0)


def test_what_was_sent_is_shown_for_each_kind_of_law() -> None:
    for name, heads in (
        ("telescope", ("after, s", "Kp, Kd", "Ki", "notch, Hz", "feedforward, mrad/s")),
        ("two-mass-drive", ("after, s", "Kv", "Kp", "Ti", "notch, Hz", "feedforward, mN m")),
    ):
        axis = Axis.preset(name)
        sent = update(Setting.of(0.0, gains_of(axis.controller)))
        assert sent_heads([sent], axis.controller, axis.actuator.unit, DEGREES.small) == heads
        assert sent_texts(sent, heads, axis.controller, DEGREES.small)[:3] == ("12", "x 1.00", "x 1.00")
    zone = update(Setting(2e-6))
    law = Axis.preset("ball-screw").controller
    heads = sent_heads([zone], law, "N m", MILLIMETRES.small)
    assert heads == ("after, s", "dead zone, um")
    assert sent_texts(zone, heads, law, MILLIMETRES.small) == ("12", "2")


def test_an_integral_that_the_own_controller_lacks_is_shown_as_it_is() -> None:
    law = Axis.preset("ball-screw").controller.replace(Ki=0.0)
    sent = update(Setting.of(0.0, gains_of(law.replace(Ki=250.0))))
    heads = sent_heads([sent], law, "N m", MILLIMETRES.small)
    assert dict(zip(heads, sent_texts(sent, heads, law, MILLIMETRES.small), strict=True))["Ki"] == "250"


def test_windows_that_were_all_refused_are_drawn_too() -> None:
    refused = EstimateRecord(3.0, math.nan, math.nan, (0.0, math.nan), "unidentifiable", (), 0.02, 0.1)
    known = dataclasses.replace(refused, gap=0.01)
    for given, drawn in (([], 0), ([refused], 0), ([refused, known], 1)):
        _, (axes,) = wear_panels.sheet(1, 120.0)
        wear_panels.estimates(axes, given)
        assert len(axes.lines) == drawn
