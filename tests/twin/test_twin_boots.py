"""What a twin knows of an edge's boots and of what they run, before and after it is stored."""

import msgspec
import pytest
from twin_messages import known_gap, make, window_message

from servotwin.control.gains import gains_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.agent import Agent
from servotwin.messages import (
    Acknowledge,
    Hello,
    InvalidMessage,
    Setting,
    Update,
    decode,
    encode,
)
from servotwin.plant.servo import Servo
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.state import MAX_SETTINGS, decode_state, encode_state
from servotwin.twin.step import WindowArrival, step
from servotwin.twin.twin import Twin

SERVO = Servo.preset("paper")


def hello(boot, time, protocol):
    return Hello("axis", boot, time, 100.0, 0, Setting(0.0), "m", protocol)


def test_after_a_restore_windows_of_a_boot_that_has_ended_meanwhile_do_not_end_the_live_one():
    twin, _ = make()
    twin.receive(hello("backup", 0.0, 2), 0.0)
    twin.receive(window_message(0, 1.0, "backup"), 1.0)
    twin.receive(window_message(3, 60.0, "live"), 101.0)
    twin.receive(hello("live", 62.0, 2), 102.0)
    twin.receive(window_message(7, 500.0, "between"), 103.0)
    versions = decode_state("axis", twin.state()).versions
    assert (versions.boot, versions.ended_boots) == ("live", ("backup",))
    assert [type(each) for each in twin.receive(window_message(4, 70.0, "live"), 104.0)] == [Acknowledge, Update]
    twin.receive(hello("next", 1.0, 2), 105.0)  # a hello begins a boot as before
    assert decode_state("axis", twin.state()).versions.boot == "next"


def test_a_boot_of_an_edge_that_does_not_introduce_itself_again_begins_with_its_first_window():
    """Edges before protocol 2 send no window of an ended boot once more, and no hello after a restore."""
    twin, _ = make()
    twin.receive(hello("backup", 0.0, 1), 0.0)
    twin.receive(window_message(0, 1.0, "backup"), 1.0)
    assert [type(each) for each in twin.receive(window_message(3, 60.0, "live"), 101.0)] == [Acknowledge, Update]


def test_a_state_from_before_boots_were_introduced_is_read():
    twin, _ = make()
    twin.receive(window_message(0, 1.0), 2.0)
    document = msgspec.msgpack.decode(twin.state())
    assert document.pop("introduced") is False
    assert encode_state(decode_state("axis", msgspec.msgpack.encode(document))) == twin.state()


def test_what_runs_is_remembered_however_many_updates_follow():
    twin, _ = make()
    twin.receive(Hello("axis", "boot-1", 0.0, 100.0, 3, Setting(1e-5), "m"), 0.0)
    for k in range(3 * MAX_SETTINGS):
        twin.receive(window_message(k, 1.0 + k, version=3), 2.0 + k)
    assert decode_state("axis", twin.state()).known[3] == Setting(1e-5)


@pytest.mark.parametrize("with_gains", [True, False])
def test_a_hello_tells_what_a_new_boot_runs(with_gains):
    """After a restart from the last verified setting, under a version that this twin does not know."""
    twin = Twin("axis", TwinModel.of(SERVO, TwinSettings(policy="paper"), estimator=known_gap))
    law = SERVO.controller.replace(Kp=1234.0)
    hello = Hello("axis", "boot-2", 0.0, 100.0, 17, Setting(3e-5, gains_of(law) if with_gains else None), "m")
    assert twin.receive(hello, 5.0) == []
    assert twin.log.hellos == [hello]
    assert decode_state("axis", twin.state()).known[17] == Setting(3e-5, gains_of(law) if with_gains else None)


def test_a_hello_of_an_earlier_boot_tells_nothing():
    twin, _ = make()
    twin.receive(window_message(0, 1.0, boot="boot-1"), 0.0)
    twin.receive(window_message(0, 1.0, boot="boot-2"), 1.0)
    before = twin.state()
    twin.receive(Hello("axis", "boot-1", 0.0, 100.0, 0, Setting(7e-5), "m"), 2.0)
    assert twin.state() == before


@pytest.mark.slow
def test_an_edge_says_which_gains_are_in_force():
    scenario = Scenario.preset("certified")
    hello = Agent(scenario.agent_settings()).hello()
    assert hello.setting.gains == gains_of(scenario.start_law)
    assert decode(encode(hello)) == hello
    silent = Hello("axis", "b", 0.0, 1.0, 0, Setting(0.0), "m")
    assert b"gains" not in encode(silent)
    assert decode(encode(silent)).setting.gains is None


def test_a_window_that_is_safe_is_learnt_from_without_an_acknowledgement():
    one, _ = make()
    fresh = one.model.initial_state("axis")
    acknowledge, *rest = one.receive(window_message(3, 20.0), 22.0)
    assert isinstance(acknowledge, Acknowledge)
    assert list(step(one.model, fresh, WindowArrival(window_message(3, 20.0), 22.0), 22.0).messages) == rest
    with pytest.raises(InvalidMessage, match="came to the twin of"):
        step(one.model, fresh, WindowArrival(window_message(3, 20.0, servo="mill"), 22.0), 22.0)
