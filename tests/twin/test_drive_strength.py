"""A torque constant or an inertia that is stated wrong by a factor of two: said, and no setting follows."""

import re
from functools import lru_cache

import pytest
from twin_messages import eq_21, message_of

from servotwin.estimation.drive_strength import strength
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.window import Window
from servotwin.messages import Setting
from servotwin.plant.axis import Axis
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.twin.evidence import AlarmRecord, RedesignRecord
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.step import WindowArrival, step

# Half period, first sample and length of a window, s; amplitude and gap at the load.
DUTIES = {
    "ball-screw": (0.4, 0.38, 0.2, 3e-4, 2e-5),
    "gantry": (5.0, 4.75, 2.5, 2e-3, 1e-4),
    "two-mass-drive": (30.0, 29.5, 5.0, 0.1, 5e-3),
}


@lru_cache(maxsize=8)
def windows(name: str, torque: float = 1.0, count: int = 3, **factors: float) -> list[Window]:
    """Of a machine with other numbers than stated, and more friction than that."""
    axis, (half, first, length, amplitude, gap) = Axis.preset(name), DUTIES[name]
    machine = axis.scaled({"k_T": torque, "k": 1.1, "c": 0.7, "motor_friction": 1.4, "load_friction": 1.4, **factors})
    rate = axis.controller.sample_rate
    assert rate is not None
    reference = SquareWave(amplitude, 2.0 * half)
    run = simulate(machine, half * (count + 2), reference=reference, gap=gap / axis.p, sample_rate=rate)
    return [Window.from_run(run, round((first + place * half) * rate) / rate, length) for place in range(count)]


def known(window: Window, _expected: object) -> GapEstimate:
    """A fake estimator: one gap at all times."""
    return GapEstimate(0.02, 1e-4, 1e-4, (0.0198, 0.0202), GapStatus.OK, window.mid_time)


@pytest.mark.parametrize(
    ("name", "torque"),
    [
        ("ball-screw", 0.5),
        ("ball-screw", 0.9),
        ("ball-screw", 2.0),
        ("gantry", 0.9),
        ("gantry", 2.0),
        ("two-mass-drive", 2.0),
    ],
)
def test_a_window_shows_the_torque_that_a_command_makes(name: str, torque: float) -> None:
    [window] = windows(name, torque, count=1)
    shown = strength(window, Axis.preset(name))
    assert shown is not None
    assert shown[0] == pytest.approx(torque, rel=0.06)


def test_more_inertia_is_less_strength() -> None:
    [window] = windows("two-mass-drive", count=1, m=1.4)
    shown = strength(window, Axis.preset("two-mass-drive"))
    assert shown is not None
    assert shown[0] == pytest.approx((0.4 + 5.6) / (0.4 + 1.4 * 5.6), rel=0.03)


def test_a_window_without_a_command_shows_nothing() -> None:
    [window] = windows("ball-screw", count=1)
    assert strength(window.replace(voltage=None), Axis.preset("ball-screw")) is None


@pytest.mark.parametrize(
    ("name", "torque", "said"), [("ball-screw", 0.5, True), ("gantry", 2.0, True), ("gantry", 1.1, False)]
)
def test_a_torque_constant_wrong_by_a_factor_of_two_is_said_and_gets_no_setting(
    name: str, torque: float, said: bool
) -> None:
    settings = TwinSettings(policy="paper", k_dz=0.0)
    model = TwinModel.of(Axis.preset(name), settings, Setting(0.0), estimator=known, policy=eq_21())
    state, alarms, sent = model.initial_state("axis"), [], []
    for number, window in enumerate(windows(name, torque)):
        time = window.start + window.duration
        result = step(model, state, WindowArrival(message_of(window, number + 1), time), time)
        state = result.state
        alarms.append([each.sentence for each in result.evidence if isinstance(each, AlarmRecord)])
        sent += [each.redesign for each in result.evidence if isinstance(each, RedesignRecord)]
    if said:
        [alarm] = alarms[1]
        shown = re.search(r"moves the axis ([\d.]+) times as strongly as stated", alarm)
        assert shown is not None
        assert float(shown[1]) == pytest.approx(torque, rel=0.1)
        assert [each.setting is not None for each in sent] == [True, False, False]
        assert "does not move the axis as strongly as stated" in sent[1].reason
    else:
        assert alarms == [[], [], []]
        assert all(each.setting is not None for each in sent)
