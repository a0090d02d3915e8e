"""Parts of `servotwin up`: speed, share of the processor, outages and display."""

import socket
from dataclasses import replace
from math import isnan, pi, radians
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some
from rich.console import Console

from servotwin.config.own_units import OwnUnits
from servotwin.drives.simulated.machine_state import MachineState, read_state, write_speed, write_state
from servotwin.drives.simulated.pace import Pace
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.simulated.state_recorder import StateRecorder
from servotwin.errors import InvalidInput
from servotwin.plant.signals import PiecewiseCubic, SCurve
from servotwin.up import display
from servotwin.up.demonstration import SERVOS, machine_toml
from servotwin.up.outages import Forwarder, Outages
from servotwin.up.plan import ServoPlan
from servotwin.up.speed import (
    FASTEST,
    LIMIT,
    SLOWEST,
    TARGET,
    CoreUsage,
    MachineTime,
    SpeedMeter,
    SpeedSample,
    next_speed,
    processor_times,
    share_of,
)
from servotwin.up.status import (
    EstimateError,
    ServoEstimate,
    ServoStatus,
    TwinPoller,
    TwinStatus,
    newest_estimate,
    read_metrics,
)

SPEEDS = some.floats(SLOWEST, FASTEST)


@given(SPEEDS, some.floats(LIMIT, 2.0, exclude_min=True), some.floats(0.0, 100.0), some.integers(0, 1000))
def test_more_than_the_limit_is_slowed_down_but_not_below_the_slowest(
    speed: float, share: float, reached: float, waiting: int
) -> None:
    chosen = next_speed(speed, SpeedSample(share, reached, waiting))
    assert SLOWEST <= chosen <= max(SLOWEST, 0.9 * speed)


@given(some.floats(SLOWEST, 90.0), some.floats(1e-3, 1.0))
def test_a_processor_share_in_proportion_to_speed_stays_below_the_limit(speed: float, share_of_one: float) -> None:
    for _ in range(60):
        speed = next_speed(speed, SpeedSample(share_of_one * speed, speed, 0))
    assert share_of_one * speed <= LIMIT or speed == SLOWEST
    assert share_of_one * speed >= 0.85 * TARGET or speed == FASTEST


def test_a_machine_that_is_late_or_a_twin_that_is_behind_is_not_driven_faster() -> None:
    assert next_speed(20.0, SpeedSample(0.2, 10.0, 0)) == 10.0
    assert next_speed(20.0, SpeedSample(0.2, 20.0, 50)) == 16.0
    assert next_speed(20.0, SpeedSample(None, 20.0, 0)) == 20.0
    assert next_speed(20.0, SpeedSample(0.5, 20.0, 0)) == 20.0


def test_a_machine_with_one_core_is_measured_by_that_one() -> None:
    assert share_of(0.5, 1) == 0.5
    assert share_of(0.5, 64) == 0.25
    assert share_of(None, 2) is None


def process(root: Path, pid: int, group: int, ticks: int, name: str = "python") -> None:
    (root / str(pid)).mkdir(exist_ok=True)
    (root / str(pid) / "stat").write_text(f"{pid} ({name}) S 1 {group} 1 0 -1 0 0 0 0 0 {ticks} {ticks} 0 0 20 0\n")


def test_processor_time_of_groups_whatever_the_programs_are_called(tmp_path: Path) -> None:
    process(tmp_path, 10, 10, 300, "a) S 1 99 (b")
    process(tmp_path, 11, 10, 200)
    process(tmp_path, 12, 99, 500)
    process(tmp_path, 13, 98, 500)
    (tmp_path / "14").mkdir()
    result = processor_times({10}, {13}, tmp_path)
    assert result is not None
    assert set(result) == {10, 11, 13}
    assert result[10] / result[11] == pytest.approx(1.5)
    assert processor_times({10}, set(), tmp_path / "nowhere") is None


def test_cores_in_use_are_those_since_the_last_measurement() -> None:
    use = CoreUsage()
    assert use.measure({1: 5.0}, 100.0) is None
    assert use.measure({1: 6.0, 2: 0.5}, 102.0) == pytest.approx(0.75)
    assert use.measure({2: 1.5}, 104.0) == pytest.approx(0.5)
    assert use.measure(None, 106.0) is None


def test_speed_is_that_of_the_slowest_machine() -> None:
    meter = SpeedMeter()
    meter.measure({1: 0.0}, {"a": MachineTime(0.0, 0.0), "b": MachineTime(7.0, 0.5)}, 0.0)
    assert not meter.started
    meter.measure({1: 1.0}, {"a": MachineTime(20.0, 2.0), "b": MachineTime(37.0, 2.5)}, 2.0)
    meter.measure({1: 2.0}, {"a": MachineTime(50.0, 4.0), "b": MachineTime(77.0, 4.5)}, 4.0)
    assert meter.started
    assert meter.reached == 15.0
    assert meter.mean_speed == 12.5
    assert meter.cores == pytest.approx(0.5)


@given(some.floats(0.0, 1e4))
def test_outages_repeat_and_end(time: float) -> None:
    plan = Outages(6.0, 8.0, 40.0)
    left = plan.left(time)
    assert 0.0 <= left <= plan.lasting
    assert plan.left(time + left + 1e-6) == pytest.approx(0.0, abs=1e-5)
    assert (left == 0.0) == (time < 6.0 or (time - 6.0) % 40.0 >= 8.0)


@pytest.mark.parametrize(("outages", "answer"), [(Outages(1e9, 1.0, 1e9), b"pong"), (Outages(0.0, 1e9, 2e9), b"")])
def test_the_forwarder_forwards_except_in_outages(outages: Outages, answer: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as target:
        forwarder = Forwarder(target.getsockname()[1], outages)
        forwarder.start()
        try:
            with socket.create_connection(("127.0.0.1", forwarder.port), 10.0) as line:
                line.settimeout(10.0)
                if answer:
                    onward, _ = target.accept()
                    with onward:
                        line.sendall(b"ping")
                        assert onward.recv(16) == b"ping"
                        onward.sendall(answer)
                        assert line.recv(16) == answer
                else:
                    with pytest.raises(ConnectionError):
                        _receive_nothing(line)
        finally:
            forwarder.stop()


def _receive_nothing(line: socket.socket) -> None:
    if line.recv(16) == b"":
        raise ConnectionResetError


def machine(tmp_path: Path) -> MachineSettings:
    path = tmp_path / "machine.toml"
    path.write_text(machine_toml(SERVOS[0]))
    return MachineSettings.load(path)


def test_a_machine_resumes_at_its_stored_wear(tmp_path: Path) -> None:
    new = machine(tmp_path)
    later = 2345.678
    write_state(tmp_path / "state.json", MachineState(time_s=later, gap_deg=1.0, speed=5.0, begun_s=0.0, written=0.0))
    write_speed(tmp_path / "speed", 12.5)
    on = machine(tmp_path)
    assert (on.begin, on.speed) == (later, 12.5)
    for seconds in (0.0, 100.0, 5000.0, 20_000.0):
        sample = round(seconds * on.rate)
        assert on.gap_at(sample) == new.gap_when(later + seconds)
        present = on.present.gap
        assert isinstance(present, PiecewiseCubic)
        assert float(present.value(seconds)) == pytest.approx(on.gap_at(sample), rel=1e-12)
    assert on.present.seed != new.present.seed


@given(some.floats(0.0, 50.0), some.floats(0.0, 50.0))
def test_a_signal_from_a_time_on_is_the_same_later(begin: float, time: float) -> None:
    pieces = SCurve(0.1, 0.7, 30.0, begin=5.0).pieces(100.0)
    assert float(pieces.later(begin).value(time)) == pytest.approx(float(pieces.value(begin + time)), rel=1e-12)


@pytest.mark.parametrize("text", ["", "{}", '{"schema": "other"}', "\xff", '{"time_s": -1}'])
def test_an_invalid_state_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "state.json").write_text(text, encoding="latin-1")
    with pytest.raises(InvalidInput, match=r"state\.json: holds no machine state"):
        read_state(tmp_path / "state.json")


RUBBISH = ["", "fast", "0", "-3", "nan", "inf", "1e9", "5 6", "\xff"]


@pytest.mark.parametrize("text", RUBBISH)
def test_a_machine_is_not_started_with_rubbish_in_its_speed_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "speed").write_text(text, encoding="latin-1")
    with pytest.raises(InvalidInput, match=r"machine\.toml: speed_file = .*speed: holds .*; give one number above 0"):
        machine(tmp_path)


@pytest.mark.parametrize("text", RUBBISH)
def test_rubbish_in_the_speed_file_of_a_running_machine_is_said_once_and_changes_nothing(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = machine(tmp_path)
    pace = Pace(1000.0, settings.speed, 0.25, 0.0)
    recorder = StateRecorder(settings, pace, 0.0)
    (tmp_path / "speed").write_text(text, encoding="latin-1")
    for second in range(5):
        recorder.update(second, float(second))
    assert pace.reached(5.0) == Pace(1000.0, settings.speed, 0.25, 0.0).reached(5.0)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"; the speed stays {settings.speed:g}")
    write_speed(tmp_path / "speed", 2.0 * settings.speed)
    recorder.update(6, 6.0)
    assert pace.reached(8.0) - pace.reached(7.0) == pytest.approx(2000.0 * settings.speed, abs=2.0)
    assert not capsys.readouterr().err


def test_a_speed_file_that_is_empty_for_a_moment_is_not_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = machine(tmp_path)
    recorder = StateRecorder(settings, Pace(1000.0, settings.speed, 0.25, 0.0), 0.0)
    for second, text in enumerate(["", "5", "", "6"]):
        (tmp_path / "speed").write_text(text)
        recorder.update(second, float(second))
    assert not capsys.readouterr().err


@given(some.floats(0.1, 100.0), some.floats(0.1, 100.0), some.floats(0.0, 50.0))
def test_another_speed_neither_repeats_nor_skips_samples(first: float, second: float, change: float) -> None:
    pace = Pace(1000.0, first, 0.25, 0.0)
    before = pace.reached(change)
    pace.change(second, change)
    assert abs(pace.reached(change) - before) <= 1
    assert pace.reached(change + 1.0) - before == pytest.approx(1000.0 * second, abs=2.0)


def link(boot: str, status: str, gap: float) -> dict[str, Any]:
    """One of the evidence chain, as the twin tells it."""
    estimate = {"gap": gap, "interval": [gap - 0.01, gap + 0.01], "time": 42.0}
    trend = {"mean": [gap, 1e-5, 0.0], "covariance": [0.0, 0.0, 0.0, 0.0, 1e-12, 0.0, 0.0, 0.0, 0.0]}
    result = [
        {"kind": "estimate", "status": status, "body": {"estimate": estimate}},
        {"kind": "trend", "status": "", "body": trend},
    ]
    return {"window": {"boot": boot}, "evidence": result}


def test_the_newest_good_estimate_and_the_newest_status() -> None:
    glanced = {"window": {"boot": "b2"}, "evidence": [{"kind": "glance", "status": "", "body": {}}]}
    none = {"kind": "estimate", "status": "failed: no", "body": {"failed": "no"}}
    failed = {"window": {"boot": "b2"}, "evidence": [none]}
    links = [glanced, failed, link("b2", "lower bound", 9.0), link("b1", "ok", 0.2), link("b1", "ok", 0.1)]
    result = newest_estimate(links)
    assert result == ServoEstimate(
        "b1", 42.0, 0.2, (0.19, 0.21000000000000002), "failed: no", 1e-5, pytest.approx(1.96e-6, rel=1e-3)
    )
    assert newest_estimate([glanced, failed]) is None


def test_metrics_are_read_by_name() -> None:
    text = (
        "# HELP servotwin_refused_total x\n"
        'servotwin_messages_total{kind="window",put="new"} 12\nservotwin_messages_total{kind="window",put="known"} 3\n'
        'servotwin_refused_total{code="future"} 2\nservotwin_refused_total{code="rate"} 3\n'
    )
    assert read_metrics(text) == {"windows": 12, "estimates": 0, "updates": 0, "workers lost": 0, "refused": 5}


def picture(view: ServoStatus, twin: TwinStatus | None) -> display.Snapshot:
    return display.Snapshot((view,) * 3, twin, 75.0, 12.0, 11.9, 1.1, 0.55, "http://127.0.0.1:1", "up", "news [x]")


def text_of(shown: display.Snapshot, width: int = 80) -> str:
    console = Console(width=width, record=True, file=open("/dev/null", "w"))  # noqa: PTH123, SIM115
    console.print(display.table(shown))
    console.file.close()
    return console.export_text()


def test_the_table_of_nothing_known_yet_shows_dashes() -> None:
    shown = picture(ServoStatus(SERVOS[0].plan, None, {}, None, 0, 0.0, 0), None)
    text = text_of(shown)
    assert "true gap, deg" in text
    assert "no answer" in text
    assert "news [x]" in text
    assert "no machine yet, no estimate yet, version -" in display.line(shown)
    assert display.line(shown).endswith("twin: no answer")
    assert "no estimate yet, version -" in next(iter(display.summary(shown)))


def test_the_table_has_field_units_the_error_and_what_waits_and_fits_a_small_terminal() -> None:
    state = MachineState(time_s=3723.0, gap_deg=9.131, speed=12.0, begun_s=0.0, written=0.0)
    newest = ServoEstimate("b1", 10.0, radians(9.0), (radians(8.96), radians(9.04)), "ok", 1e-5 * pi, 1e-6)
    edge = {
        "version": 7, "fallback": True, "tolerance_m": 3.16e-5, "kp_v_per_m": 1377.7, "ki_v_per_m_s": 18907.6,
        "kd_v_s_per_m": -135.1, "feedforward_v": -0.05, "up": {"windows": 41, "trouble": ""}, "down": {"trouble": ""},
        "windows": {"waiting": 3, "dropped": {"withheld": 2, "outbox full": 1}},
    }  # fmt: skip
    view = ServoStatus(SERVOS[2].plan, state, edge, EstimateError(newest, 9.0003, 58.0), 47, 4.2, 2)
    shown = picture(view, TwinStatus(5, 0.1, {"windows": 121, "refused": 0}, ("ax-1",)))
    text = text_of(shown)
    for expected in (
        "1:02:03", "9.131", "9.000 ± 0.040", "-0.0003 58 s ago", "7 fallback set", "0.0316", "Kp Ki Kd, V/mm",
        "1.38 18.9 -0.135", "-50.0", "121 windows",
        "outage, 4 s left", "11.9 x real time", "1.10 of 2 cores = 55 %", "5 in its queue, ax-1 set aside",
    ):  # fmt: skip
        assert expected in text, expected
    assert "…" not in text
    assert len(text.splitlines()) <= 24
    assert "version 7 fallback set, link cut, 3 wait" in display.line(shown)
    assert display.line(shown).endswith("twin: 5 in its queue, ax-1 set aside")
    assert "47 cut, 41 acknowledged, 3 waiting, 3 dropped" in next(iter(display.summary(shown)))


AXES = {
    OwnUnits("N m", "rad"): (
        {"tolerance_rad": pi / 1800.0, "kp_n_m_per_rad": 15.0, "ki_n_m_per_rad_s": 7.0, "kd_n_m_s_per_rad": 3.0},
        {"dead zone, deg": "0.1000", "Kp Ki Kd, N m/rad": "15 7 3"},
    ),
    OwnUnits("N m", "m"): (
        {"tolerance_m": 2e-6, "position_gain_per_s": 40.0, "velocity_gain_n_m_s_per_rad": 0.25,
         "integral_time_s": 0.02, "feedforward_n_m": 0.01},
        {"dead zone, mm": "0.0020", "Kv, 1/s": "40", "Kp, N m s/rad": "0.25", "Ti, s": "0.02",
         "feedforward, mN m": "10.0"},
    ),
    OwnUnits("rad/s", "m"): ({"position_gain_per_s": 20.0, "integral_time_s": 0.0}, {"Kv, 1/s": "20"}),
}  # fmt: skip


def test_the_table_has_the_units_of_each_machine() -> None:
    views = [ServoStatus(SERVOS[0].plan, None, edge, None, 0, 0.0, 0, units) for units, (edge, _) in AXES.items()]
    lines = text_of(picture(views[0], None)._replace(servos=tuple(views)), 120).splitlines()
    for name in {name for _, expected in AXES.values() for name in expected}:
        [row] = [line.removeprefix(name) for line in lines if line.startswith(f"{name}  ")]
        cells = [expected.get(name, "-") for _, expected in AXES.values()]
        assert row.split() == " ".join(cells).split()


def test_many_machines_are_rows_that_fit_a_small_terminal() -> None:
    state = MachineState(time_s=10.0, gap_deg=9.131, speed=1.0, begun_s=0.0, written=0.0)
    newest = ServoEstimate("b1", 10.0, radians(9.0), (radians(8.96), radians(9.04)), "ok", 1e-5 * pi, 1e-6)
    edge = {"version": 7, "fallback": True, "windows": {"waiting": 3}}
    plans = [one_of_many(number) for number in range(30)]
    views = [ServoStatus(plan, state, edge, EstimateError(newest, 9.0003, 58.0), 47, 0.0, 0) for plan in plans]
    lines = text_of(picture(views[0], None)._replace(servos=tuple(views))).splitlines()
    for plan in plans:
        [row] = [line.split() for line in lines if line.startswith(f"{plan.name}  ")]
        assert row == f"{plan.name} 9.000 ± 0.040 -0.0003 58 s ago 7 fallback set 3 up".split()


def one_of_many(number: int) -> ServoPlan:
    """A servo of many."""
    return ServoPlan(f"machine-{number:02d}", "rack", "supervise", "certified")


@pytest.mark.parametrize(
    ("speed", "reached", "said"), [(1.0, 0.99, ""), (1.0, 0.5, "reach 1)"), (20.0, 4.0, "reach 5)")]
)
def test_a_machine_that_does_not_keep_its_speed_is_said(speed: float, reached: float, said: str) -> None:
    view = ServoStatus(SERVOS[0].plan, None, {}, None, 0, 0.0, 0)
    line = display.line(picture(view, None)._replace(speed=speed, reached=reached))
    assert said in line
    assert ("does not reach" in line) == bool(said)


@pytest.mark.parametrize(
    ("waiting", "limit", "answer"),
    [(0, 20, b"[]"), (50, 70, b"[]"), (5000, 1000, b"[]"), (50, 70, b'{"error": "set aside"}')],
)
def test_the_newest_estimate_is_looked_for_behind_the_windows_that_wait(
    monkeypatch: pytest.MonkeyPatch, waiting: int, limit: int, answer: bytes
) -> None:
    health = b'{"set_aside": {"b": ""}, "waiting": {"messages": %d, "age": 0.0}}' % waiting
    asked = []

    def get(_self: TwinPoller, _connection: object, path: str) -> bytes:
        asked.append(path)
        return {"/healthz": health, "/metrics": b""}.get(path, answer)

    monkeypatch.setattr(TwinPoller, "_get", get)
    poller = TwinPoller("http://127.0.0.1:1", "token", ["a"])
    assert poller._poll(None).aside == ("b",)
    wide = [] if limit == 20 else [f"/v1/servos/a/audit?limit={limit}"]
    assert asked[2:] == ["/v1/servos/a/audit?limit=20", *wide]


def test_a_truth_outside_of_the_interval_is_marked() -> None:
    newest = ServoEstimate("b1", 10.0, radians(9.0), (radians(8.96), radians(9.04)), "ok")
    assert isnan(newest.rate)
    assert EstimateError(newest, 9.03, 1.0).inside
    assert EstimateError(newest, 9.05, 1.0).inside is False
    assert EstimateError(newest, None, None).inside is None


def test_files_of_a_machine_belong_to_one_that_runs_on(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="allowed only with speed > 0"):
        replace(machine(tmp_path), speed=0.0)
