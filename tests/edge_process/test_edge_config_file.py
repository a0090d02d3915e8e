"""edge.toml: what is written is read back bit for bit; what is wrong is refused by name."""

import tomllib
from dataclasses import replace
from math import inf
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.config.table import parse_toml
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge.watch import WatchSettings
from servotwin.edge_process.config import UNBOOTED, EdgeConfig, SensorGuard, StoredFiles, TwinLink, token_of
from servotwin.edge_process.config_file import edge_toml, load, read_config
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Setting
from servotwin.runtime.retry import Retry

LAW = Controller(1377.7, 18907.6, -135.1, 0.1, voltage_limit=10.0, sample_rate=1000.0)
PLAIN = """
servo = "axis-1"
role = "control"
sample_rate_hz = 1000.0
[drive]
kind = "simulated"
[controller]
kp_v_per_m = 1377.7
ki_v_per_m_s = 18907.6
kd_v_s_per_m = -135.1
filter_time_s = 0.1
"""


def again(config: EdgeConfig) -> EdgeConfig:
    return read_config(parse_toml(edge_toml(config), "edge.toml"))


@pytest.mark.parametrize("preset", ["fig15-sampled", "fig16", "calm", "certified"])
def test_what_a_scenario_tells_its_edge_comes_back_bit_for_bit(preset: str) -> None:
    scenario = Scenario.preset(preset)
    agent = replace(scenario.agent_settings(), boot=UNBOOTED)
    law = scenario.law if scenario.law.sample_rate else scenario.law.replace(sample_rate=agent.sample_rate)
    agent = replace(agent, controller=None if agent.controller is None else law)
    config = EdgeConfig(agent, "control", law, {"kind": "simulated", "port": 4000}, TwinLink("https://h:1", "token"))
    assert again(config) == config


METRES = st.floats(1e-7, 1e-2)


@pytest.mark.slow
@given(METRES, METRES, METRES, st.text(max_size=20).filter(lambda text: text.isprintable()), st.booleans())
def test_every_number_comes_back_bit_for_bit(a: float, b: float, c: float, text: str, stay: bool) -> None:
    gains = gains_of(LAW.replace(Kp=1.0 + a, leave=1.0 + b))
    band = Band(a, b, 0.1 + c, 2.0)
    supervision = Supervision(
        FallbackSet(Setting(c, None if stay else gains, band), 7.0 + a), WatchSettings(error_floor=b), 0.1
    )
    agent = AgentSettings(
        "axis-1", UNBOOTED, 1000.0, 0.5, 0.1, Retry(1.0, 1.5, 9.0), Limits(0.0, a, b, inf, max_rate=c),
        Parameters(0, Setting(b, gains, band), fallback=True), True, -a, text, LAW, gains, supervision, 2.0, 0.2,
        ProbeLimits(c, 20.0, 0.5),
    )  # fmt: skip
    twin = TwinLink("https://twin.example:8443/base", None, "TOKEN", "ca.pem", 3.0, 5.0)
    files, sensor = StoredFiles("o.db", "p.json", "s.json", "b", "m.prom", 9, 2_500_000), SensorGuard(0.003, -0.5)
    drive = {"kind": "opcua", "list": [1, 2.5], "flag": True, "map": {"text": text}}
    config = EdgeConfig(agent, "supervise", LAW, drive, twin, files, sensor)
    assert again(config) == config


CASCADE = Cascade(20.0, 0.1, velocity_gain=3.0, integral_time=0.1, notch_hz=40.0, sample_rate=1000.0)


def test_a_cascade_and_its_sets_come_back_bit_for_bit() -> None:
    """A fallback set without the integral action and the notch that the configured cascade has, too."""
    bare = gains_of(CASCADE.replace(integral_time=None, notch_hz=None, velocity_gain=1.0 / 3.0, integral_only=False))
    fallback = FallbackSet(Setting.of(1e-4, bare, Band(1e-4, 1e-5, 0.1, 1.0)))
    agent = AgentSettings(
        "axis-1", UNBOOTED, 1000.0, controller=CASCADE, own=gains_of(CASCADE.replace(position_gain=7.0)),
        parameters=Parameters(setting=fallback.setting, fallback=True), supervision=Supervision(fallback),
    )  # fmt: skip
    config = EdgeConfig(agent, "control", CASCADE, {"kind": "simulated"})
    assert again(config) == config


def test_ranges_of_gains_come_back_and_are_written_where_they_are_given() -> None:
    limits = Limits(Kp=(0.1 + 0.2, 1400.0), Kd=(-1.0 / 3.0, -0.1), Tf=(0.05, inf), leave=2.0)
    config = EdgeConfig(
        AgentSettings("axis-1", UNBOOTED, 1000.0, controller=LAW, limits=limits), "control", LAW, {"kind": "simulated"}
    )
    assert again(config) == config
    written = tomllib.loads(edge_toml(config))["limits"]
    assert written["kd_v_s_per_m"] == [-1.0 / 3.0, -0.1]
    # Released edges do not know the keys.
    plain = tomllib.loads(edge_toml(replace(config, agent=replace(config.agent, limits=Limits()))))["limits"]
    assert set(written) - set(plain) == {"kp_v_per_m", "kd_v_s_per_m", "filter_time_s", "leave_tolerances"}


def test_a_short_file_is_enough(tmp_path: Path) -> None:
    file = tmp_path / "edge.toml"
    file.write_text(PLAIN)
    config = load(file)
    assert config.agent == AgentSettings("axis-1", UNBOOTED, 1000.0)
    assert config.controller == Controller(1377.7, 18907.6, -135.1, 0.1, sample_rate=1000.0)
    assert (config.twin, config.path("x")) == (None, tmp_path / "x")
    assert config.settings("b7").boot == "b7"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('role = "control"', 'role = "contrl"', "role = 'contrl'.*did you mean 'control'"),
        ("sample_rate_hz = 1000.0", "sample_rate_hz = 0", "sample_rate_hz = 0 is not allowed"),
        ('servo = "axis-1"', 'servo = "axis 1"', "agent servo = 'axis 1'"),
        ('servo = "axis-1"', 'servo = "axis-1"\nhurry = 1', "unknown key 'hurry'"),
        ('kind = "simulated"', "", "key 'drive.kind' is missing"),
        ("filter_time_s = 0.1", "filter_time_s = 0.1\nsample_rate_hz = 5", r"controller sample_rate_hz = 5.0 Hz"),
        ("filter_time_s = 0.1", "filter_time_s = 0.1\n[twin]\nurl = 'ftp://x'", "url = 'ftp://x' is not allowed"),
        ("filter_time_s = 0.1", "filter_time_s = 0.1\n[twin]\nurl = 'http://x'", "token in clear to another machine"),
        ("filter_time_s = 0.1", "filter_time_s = 0.1\n[twin]\nurl = 'https://x'", "token_file or token_env is needed"),
        (
            "filter_time_s = 0.1",
            "filter_time_s = 0.1\n[keep]\nwindows = 0",
            "keep.windows = 0 is not allowed; give an integer, at least 1",
        ),
        (
            "filter_time_s = 0.1",
            "filter_time_s = 0.1\n[sensor]\nhold_s = -1",
            "sensor.hold_s = -1 is not allowed; give a number, at least 0",
        ),
        ("filter_time_s = 0.1", "filter_time_s = 0.1\n[limits]\nmaximum_m = -1", "limits.maximum_m = -1"),
    ],
)
def test_what_is_wrong_is_refused_by_name(old: str, new: str, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        read_config(parse_toml(PLAIN.replace(old, new), "edge.toml"))


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "[::1]", "localhost"])
def test_a_loopback_url_may_be_in_clear(host: str) -> None:
    assert TwinLink(f"http://{host}:8765", "token").url == f"http://{host}:8765"
    for other in ("10.0.0.1", "[2001:db8::1]", "localhost.example", "127.0.0.1.example", "127.1"):
        for scheme in ("http", "HTTP"):
            with pytest.raises(InvalidInput, match="in clear"):
                TwinLink(f"{scheme}://{other}:8765", "token")


def test_the_role_control_needs_a_controller() -> None:
    text = PLAIN[: PLAIN.index("[controller]")]
    with pytest.raises(InvalidInput, match=r"table \[controller\] is missing"):
        read_config(parse_toml(text, "edge.toml"))
    assert read_config(parse_toml(text.replace("control", "supervise"), "edge.toml")).controller is None


def test_a_token_is_read_from_a_private_file_or_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("s3cret\n")
    file.chmod(0o644)
    config = replace(read_config(parse_toml(PLAIN, "edge.toml")), folder=tmp_path)
    from_file = replace(config, twin=TwinLink("https://h", token_file="token"))
    with pytest.raises(InvalidInput, match=r"edge.toml: twin.token_file = 'token': .* make it 0600") as refused:
        token_of(from_file)
    assert "s3cret" not in str(refused.value)
    file.chmod(0o600)
    assert token_of(from_file) == "s3cret"
    from_environment = replace(config, twin=TwinLink("https://h", token_env="T"))
    assert token_of(from_environment, {"T": "other"}) == "other"
    with pytest.raises(InvalidInput, match=r"twin.token_env = 'T': environment variable T: is empty"):
        token_of(from_environment, {})


def test_a_file_of_the_version_before_is_read_and_written_as_it_was() -> None:
    folder = Path(__file__).parents[2] / "tests/data/version-0/edge"
    before = tomllib.loads((folder / "edge.toml").read_text(encoding="utf-8"))
    # Of keys that came since, the value that they have where they are absent is written.
    for gains in (
        before["controller"],
        before["own"],
        before["start"],
        before["supervision"]["fallback"],
    ):
        gains.update(integral_only=False, velocity_feedforward_v_s_per_m=0.0, velocity_time_s=0.1)
        gains.update(friction_feedforward_v=0.0, notch_hz=0.0, notch_damping=0.5, notch_depth=0.1)
    before["limits"].update(notch_min_hz=0.0, notch_max_hz=0.0, notch_max_damping=0.5)
    assert tomllib.loads(edge_toml(load(folder / "edge.toml"))) == before


def test_a_written_file_that_was_cut_short_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    """Without its last tables the edge would run, and watch nothing."""
    path, text = tmp_path / "edge.toml", edge_toml(read_config(parse_toml(PLAIN, "edge.toml")))
    first = len(text.splitlines(keepends=True)[0])
    # At the end of a line, and in the middle of one: a key without a value is no TOML, and it is not what is wrong.
    for length in range(first, len(text.rstrip()), 7):
        path.write_text(text[:length])
        with pytest.raises(InvalidInput) as refused:
            load(path)
        assert str(refused.value) == f"{path}: is cut short: its line '# end' is missing; copy the edge's folder again"
    for whole in (text, f"{text}# mine\n", "\n".join(line for line in text.splitlines() if line[:1] != "#")):
        path.write_text(whole)
        load(path)


def test_a_key_that_released_edges_refuse_is_written_only_where_it_says_something() -> None:
    config = read_config(parse_toml(PLAIN, "edge.toml"))
    assert "acknowledged" not in edge_toml(config)
    config = replace(config, files=StoredFiles(acknowledged_s=60.0))
    assert "acknowledged_s = 60.0" in edge_toml(config)
    assert "acknowledged_megabytes" not in edge_toml(config)
    assert again(config) == config
