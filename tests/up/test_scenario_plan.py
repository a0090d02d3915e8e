"""`servotwin up SCENARIO`: an own axis deployed, with the axis, wear, controller and twin of its scenario file."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.cosim.scenario import Scenario
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.edge_process.config import UNBOOTED
from servotwin.edge_process.config_file import load
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.twin_service.twin_file import read_twin
from servotwin.up import folder
from servotwin.up.plan import RETRY
from servotwin.up.scenario_plan import ScenarioPlan

SCENARIO = """
servo = "joint.toml"
name = "joint"
duration_s = 600.0
seed = 5
[reference]
kind = "square"
amplitude_deg = 4.0
period_s = 16.0
[gap]
from_deg = 5.0
to_deg = 20.0
over_s = 600.0
[controller]
kp_n_m_per_rad = 29.0
[noise]
std_deg = 0.001
[disturbances]
input_bias_n_m = 0.1
[recording]
window_s = 2.5
[recording.limits]
maximum_deg = 0.2
[link]
delay_s = 0.1
[[link.outages]]
from_s = 3.0
to_s = 4.0
[twin]
policy = "paper"
k_dz = 0.5
initial_gap_deg = 6.0
gap_limit_deg = 25.0
[twin.trend]
wear_deg = 3.0
over_s = 100.0
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """A scenario of an own axis, beside its file."""
    (tmp_path / "joint.toml").write_text(Axis.preset("robot-joint").dumps())
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    return tmp_path / "scenario.toml"


def made(path: Path, *scenarios: Path, machines: int = 1) -> Path:
    """The folder of a first start, of which nothing was started."""
    with folder.opened(path, ScenarioPlan.read(scenarios, machines)) as first:
        assert first.new
        assert first.speed == 1.0
    return path


def test_machine_edge_and_twin_are_those_of_the_scenario(scenario: Path, tmp_path: Path) -> None:
    expected = Scenario.load(scenario)
    up = made(tmp_path / "up", scenario)
    scenario.unlink()  # the folder holds all that the next starts need
    (tmp_path / "joint.toml").unlink()
    machine = MachineSettings.load(up / "joint" / "machine.toml").scenario
    of_machine = ("servo", "reference", "gap", "controller", "noise", "input_bias", "seed", "duration", "name")
    assert [getattr(machine, each) for each in of_machine] == [getattr(expected, each) for each in of_machine]
    edge = load(up / "joint" / "edge.toml")
    assert edge.agent == replace(expected.commissioning.agent_settings("joint", UNBOOTED), retry=RETRY)
    assert edge.agent.window_s == 2.5
    assert edge.controller == expected.law
    assert (edge.command_unit, edge.position_unit, edge.role) == ("N m", "rad", "supervise")
    model = read_twin(up / "twin.toml").fleet.model_of("joint")
    assert model.servo == expected.model
    assert model.settings == replace(expected.twin, validity=1800.0)
    assert model.first_setting is not None
    assert model.first_setting.tolerance == expected.start_tolerance > 0.0


def test_a_validity_that_is_stated_stays(scenario: Path, tmp_path: Path) -> None:
    scenario.write_text(SCENARIO.replace("k_dz = 0.5", "k_dz = 0.5\nvalidity_s = 7.0"))
    up = made(tmp_path / "up", scenario)
    assert read_twin(up / "twin.toml").fleet.model_of("joint").settings.validity == 7.0


def test_machines_of_one_scenario_have_one_model_and_noise_of_their_own(scenario: Path, tmp_path: Path) -> None:
    screw = tmp_path / "screw.toml"
    screw.write_text(
        'servo = "ball-screw"\nname = "screw"\nduration_s = 60.0\ngap = {total_deg = 1.0}\n'
        'reference = {kind = "square", amplitude_mm = 1.0, period_s = 2.0}\ntwin = {policy = "paper", k_dz = 0.0}\n'
    )
    up = made(tmp_path / "up", scenario, screw, machines=2)
    with folder.opened(up) as again:
        names = [servo.name for servo in again.servos]
    assert names == ["joint-1", "joint-2", "screw-1", "screw-2"]
    fleet = read_twin(up / "twin.toml").fleet
    assert [model.name for model in fleet.models] == ["joint-1", "screw-1"]
    assert [fleet.model_of(name).servo.p for name in names] == [Axis.preset("robot-joint").p] * 2 + [
        Axis.preset("ball-screw").p
    ] * 2
    first, second = (MachineSettings.load(up / name / "machine.toml").scenario for name in names[:2])
    assert first.seed_of("noise") != second.seed_of("noise")


def test_a_folder_continues_with_its_scenario_and_refuses_another(scenario: Path, tmp_path: Path) -> None:
    up = made(tmp_path / "up", scenario)
    scenario.write_text("# a comment changes nothing\n" + SCENARIO)
    for plan in (None, ScenarioPlan.read([scenario])):
        with folder.opened(up, plan) as again:
            assert not again.new
    for file, text, changed in (
        (scenario, SCENARIO, SCENARIO.replace("to_deg = 20.0", "to_deg = 21.0")),
        (
            tmp_path / "joint.toml",
            Axis.preset("robot-joint").dumps(),
            Axis.preset("robot-joint").replace(Ki=14.0).dumps(),
        ),
    ):
        file.write_text(changed)
        words = r"was made from other scenarios or axes \(its servos are joint\); remove the folder"
        with pytest.raises(InvalidInput, match=words), folder.opened(up, ScenarioPlan.read([scenario])):
            pass
        file.write_text(text)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda text: text.replace('"square"\namplitude_deg', '"step"\nsize_deg').replace("period_s = 16.0\n", ""),
            "scenario.toml: reference.kind = 'step' is not allowed; give 'square': a machine that runs on",
        ),
        (
            lambda text: text.replace("[twin]\n", "[twin]\nenabled = false\n"),
            "scenario.toml: twin.enabled = False is not allowed; give true: servotwin up runs a twin",
        ),
        (lambda text: text.replace('name = "joint"', 'name = "lock"'), "name = 'lock' is not allowed"),
        (lambda text: text.replace('name = "joint"', 'name = "a.b"'), "name = 'a.b' is not allowed"),
        (
            lambda text: text.replace("window_s = 2.5", "window_s = 300.0"),
            "recording.window_s: 300 s are 300000 samples",
        ),
        (lambda text: text.replace("joint.toml", "none.toml"), "servo = 'none.toml' is not allowed"),
    ],
)
def test_a_scenario_that_makes_no_sense_deployed_is_refused(
    scenario: Path, change: Callable[[str], str], words: str
) -> None:
    text = change(SCENARIO)
    assert text != SCENARIO
    scenario.write_text(text)
    with pytest.raises(InvalidInput) as refused:
        ScenarioPlan.read([scenario])
    assert words in str(refused.value)


def test_a_continuous_controller_is_refused_with_the_key_that_it_lacks() -> None:
    with pytest.raises(InvalidInput, match=r"fig15\.toml: controller\.sample_rate_hz: is missing"):
        ScenarioPlan.read([Path("fig15")])


def test_two_scenarios_of_one_name_and_too_many_machines_are_refused(scenario: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text(SCENARIO)
    with pytest.raises(InvalidInput, match=r"other\.toml: name = 'joint': .*scenario\.toml has it already"):
        ScenarioPlan.read([scenario, other])
    with pytest.raises(InvalidInput, match=r"scenario\.toml has it already"):
        ScenarioPlan.read([scenario, scenario])
    for machines in (0, 101):
        with pytest.raises(InvalidInput, match=f"--machines {machines}: must be 1 to 100"):
            ScenarioPlan.read([scenario], machines)


def test_a_name_that_a_number_makes_too_long_is_refused_with_its_file(scenario: Path) -> None:
    scenario.write_text(SCENARIO.replace('name = "joint"', f'name = "{"x" * 62}"'))
    assert len(ScenarioPlan.read([scenario], 9).servos) == 9
    with pytest.raises(
        InvalidInput, match=r"scenario\.toml: name = 'x+': is longer than 64 characters with a machine's"
    ):
        ScenarioPlan.read([scenario], 10)


def test_the_command_refuses_machines_without_a_scenario_and_makes_nothing(scenario: Path, tmp_path: Path) -> None:
    up = tmp_path / "up"
    done = CliRunner().invoke(app, ["up", "--folder", str(up), "--machines", "3"])
    assert done.exit_code == 2
    assert "--machines 3" in done.stderr
    scenario.write_text(SCENARIO.replace("square", "constant"))
    done = CliRunner().invoke(app, ["up", str(scenario), "--folder", str(up)])
    assert done.exit_code == 2
    assert "Traceback" not in done.stderr
    assert not up.exists()


def test_a_slow_machine_s_blocks_hold_a_sample(scenario: Path, tmp_path: Path) -> None:
    """At 10 Hz a block of the usual 0.05 s would hold none."""
    scenario.write_text(
        'servo = "paper"\nname = "slow"\nduration_s = 600.0\ngap = {total_deg = 1.0}\n'
        'reference = {kind = "square", amplitude_mm = 1.0, period_s = 200.0}\n'
        "controller = {kp_v_per_m = 14.0, ki_v_per_m_s = 0.0, kd_v_s_per_m = 0.0, sample_rate_hz = 10.0}\n"
        "recording = {window_s = 50.0}\n"
        'twin = {policy = "paper", method = "paper", k_dz = 0.0}\n'
    )
    up = made(tmp_path / "up", scenario)
    assert MachineSettings.load(up / "slow" / "machine.toml").block_samples == 1
