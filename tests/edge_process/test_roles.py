"""The control process without a process: the law's guard, both roles, drives that are lost, refuse or wait."""

import math
from array import array
from collections.abc import Iterator
from dataclasses import replace

import pytest
from edge_process_parts import CONFIG, LAW, RATE, LinkEnd, cut, exchange_all
from hypothesis import given
from hypothesis import strategies as st
from scripted_edge import ScriptedDrive, edge_of, samples

from servotwin.control.cascade import Cascade
from servotwin.control.gains import gains_of
from servotwin.control.law import start, tick
from servotwin.control.running_law import RunningLaw, command_of
from servotwin.edge.drive import Block, DriveLost, DriveSample
from servotwin.edge.guard import Limits
from servotwin.edge_process import frames, outlet
from servotwin.edge_process.control import ControlRole, GuardedLaw
from servotwin.edge_process.edge import EdgeRuntime
from servotwin.edge_process.outlet import BEHIND, PipeOutlet
from servotwin.edge_process.run import StopSignal, until
from servotwin.edge_process.supervise import SupervisingRole
from servotwin.errors import InvalidInput
from servotwin.messages import (
    Answer,
    Cause,
    Fallback,
    Probe,
    Reason,
    Receipt,
    Request,
    Setting,
    Update,
    decode,
    encode,
)


@pytest.fixture
def far() -> Iterator[LinkEnd]:
    made = LinkEnd()
    yield made
    made.close()


POSITIONS = st.sampled_from([0.0, 1e-3, -1e-3, math.nan, math.inf, -math.inf, 1e308, -1e308])


@given(st.lists(st.tuples(POSITIONS, POSITIONS), max_size=30), st.booleans())
def test_the_law_never_gives_a_voltage_that_is_not_finite(samples: list[tuple[float, float]], limited: bool) -> None:
    controller = LAW if limited else LAW.replace(voltage_limit=None, Ki=1e3, Kd=10.0)
    guarded = GuardedLaw(RunningLaw(controller, 1e-5), 2, 0.0)
    for reference, position in samples:
        assert math.isfinite(guarded.tick(reference, 0.0, position))
    for _ in range(4):
        guarded.tick(0.0, 0.0, math.nan)
    assert guarded.tick(1e-3, math.nan, 0.0) == tick(controller.law(1e-5), start(0.0), 1e-3, 0.0).voltage


def test_a_few_bad_samples_hold_the_voltage_and_the_law_goes_on() -> None:
    law = LAW.replace(Ki=500.0).law()
    guarded, plain = GuardedLaw(RunningLaw(LAW.replace(Ki=500.0)), 2, 0.5), start(0.0)
    for k in range(5):
        plain = tick(law, plain, 1e-3, 1e-4 * k)
        assert guarded.tick(1e-3, 0.0, 1e-4 * k) == plain.voltage
    assert [guarded.tick(1e-3, 0.0, math.nan) for _ in range(2)] == [plain.voltage] * 2
    assert guarded.tick(1e-3, 0.0, 6e-4) == tick(law, plain, 1e-3, 6e-4).voltage
    assert [guarded.tick(1e-3, 0.0, math.nan) for _ in range(3)][-1] == 0.5


CASCADE = Cascade(20.0, 0.1, velocity_gain=3.0, integral_time=0.1, voltage_limit=10.0, sample_rate=RATE)


def test_a_cascade_runs_at_the_edge_and_takes_new_numbers_without_a_bump(far: "LinkEnd") -> None:
    """Both encoders reach the tick; a sample without the motor's angle is bad."""
    box = PipeOutlet(True)
    box.connect(far.near)
    agent = replace(CONFIG.agent, controller=CASCADE, limits=Limits(maximum=1e-3))
    edge = edge_of(box, replace(CONFIG, agent=agent, controller=CASCADE))
    given = [DriveSample(k, 1e-3, 1e-3 * k, 1e-5 * k) for k in range(20)]
    drive = ScriptedDrive([*given[:10], given[10]._replace(theta_m=math.nan), *given[11:]])
    role = ControlRole(edge, drive)
    running = RunningLaw(CASCADE, 0.0)
    state = running.start(given[0].theta_m, given[0].position)
    for k in range(10):
        role.step()
        state = running.tick(state, *given[k][1:])
        assert role.law.voltage == command_of(state)
    far.send(frames.MessageFrame(1, encode(law_update(1, CASCADE.replace(velocity_gain=2.0, integral_time=None)))))
    role.step()
    assert role.law.voltage == command_of(state)
    assert edge.counts["bad samples"] == 1
    role.step()
    assert edge.agent.parameters.version == 1
    assert role.law.voltage == pytest.approx(command_of(running.tick(state, *given[11][1:])), abs=1e-12)


def law_update(version: int, law: Cascade) -> Update:
    known = (None, None, (None, None))
    return Update("axis-1", version, 0, ("b0", 0), 0.0, *known, "OK", Setting.of(0.0, gains_of(law)), 60.0)


def letters(far: LinkEnd, kind: type | tuple[type, ...]) -> list[object]:
    found = [decode(frame.body) for frame in far.received() if isinstance(frame, frames.LetterFrame)]
    return [message for message in found if isinstance(message, kind)]


def update(version: int, tolerance: float, sequence: int = 0, boot: str = "b0") -> Update:
    known = (None, None, (None, None))
    return Update("axis-1", version, version - 1, (boot, sequence), 0.0, *known, "OK", Setting(tolerance), 1e6)


def test_without_an_encoder_the_motors_angle_is_neither_read_nor_recorded(far: "LinkEnd") -> None:
    """A cascade over a drive in velocity mode; the drive has NaN for the angle that nothing measures."""
    box = PipeOutlet(True)
    box.connect(far.near)
    law = replace(CASCADE, velocity_gain=None, integral_time=None)
    agent = replace(CONFIG.agent, motor_encoder=False)
    edge = edge_of(box, replace(CONFIG, agent=agent, controller=law))
    given = [DriveSample(k, 1e-3, math.nan, 1e-5 * k) for k in range(10)]
    role, running = ControlRole(edge, ScriptedDrive([*given])), RunningLaw(law, 0.0)
    state = running.start(0.0, 0.0)
    for sample in given:
        role.step()
        state = running.tick(state, sample.reference, 7.0, sample.position)  # whatever the angle
        assert role.law.voltage == command_of(state) != 0.0
    assert not edge.counts
    exchange_all(box)
    (window,) = (frame for frame in far.received() if isinstance(frame, frames.WindowFrame))
    assert set(window.signals) == {"reference", "position", "voltage"}


def test_an_update_changes_the_law_without_a_jump_of_the_voltage(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    edge = edge_of(box)
    drive = ScriptedDrive([*samples(0, 30)])
    role = ControlRole(edge, drive)
    for _ in range(15):
        role.step()
    far.send(frames.MessageFrame(1, encode(update(1, 5e-3 / 10))))
    for _ in range(10):
        role.step()
    assert edge.agent.parameters.version == 1
    assert drive.voltages[16] == pytest.approx(drive.voltages[15], rel=1e-6)
    exchange_all(box)
    (receipt,) = letters(far, Receipt)
    assert isinstance(receipt, Receipt)
    assert receipt.applied


def test_parameters_in_force_are_carried_into_a_new_boot(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    edge = edge_of(box)
    drive = ScriptedDrive([*samples(0, 15), *samples(1000, 15), *samples(0, 3)])
    role = ControlRole(edge, drive)
    for _ in range(14):
        role.step()
    far.send(frames.MessageFrame(1, encode(update(1, 1e-4))))
    for _ in range(10):
        role.step()
    assert (edge.agent.settings.boot, edge.agent.parameters.version) == ("b0.1", 1)
    while role.step() and drive.given:
        pass
    assert edge.agent.settings.boot == "b0.2"
    assert edge.counts == {"boot: samples missing": 1, "boot: machine counts anew": 1}


def test_a_drive_that_misnumbers_every_sample_fills_neither_log_nor_outbox(
    far: LinkEnd, capfd: pytest.CaptureFixture[str]
) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    edge = edge_of(box)
    drive = ScriptedDrive([*[DriveSample(7, 1e-3, 0.0, 0.0)] * 1000, *samples(8, 15)])
    role = ControlRole(edge, drive)
    while drive.given:
        role.step()
    exchange_all(box)
    received = far.received()
    hellos = [frame for frame in received if isinstance(frame, frames.LetterFrame)]
    (window,) = (frame for frame in received if isinstance(frame, frames.WindowFrame))
    assert edge.counts == {"boot: machine counts anew": 999}
    assert len(hellos) == capfd.readouterr().err.count('"event":"boot"') <= 15
    assert window.boot == decode(hellos[-1].body).boot  # type: ignore[union-attr]


def test_an_edge_that_was_superseded_takes_no_update_in_a_later_boot_either(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    edge = edge_of(box)
    role = ControlRole(edge, ScriptedDrive([*samples(0, 5), *samples(1000, 5)]))
    far.send(frames.SupersededFrame())
    for _ in range(7):
        role.step()
    far.send(frames.MessageFrame(1, encode(update(1, 1e-4, boot="b0.1"))))
    for _ in range(3):
        role.step()
    assert (edge.agent.settings.boot, edge.agent.parameters.version) == ("b0.1", 0)
    exchange_all(box)
    (receipt,) = letters(far, Receipt)
    assert isinstance(receipt, Receipt)
    assert receipt.reason is Reason.TAKEN_OVER


@pytest.mark.parametrize("then", [samples(1000, 3), [DriveSample(15, 1e-3, 0.0, math.nan), *samples(16, 3)]])
def test_an_update_that_arrives_with_the_last_sample_before_a_gap_is_in_force_after_it(
    far: LinkEnd, then: list[DriveSample]
) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    edge = edge_of(box)
    role = ControlRole(edge, ScriptedDrive([*samples(0, 15), *then]))
    for _ in range(14):
        role.step()
    far.send(frames.MessageFrame(1, encode(update(1, 1e-4))))
    role.step()
    assert (edge.agent.parameters.version, role.law.law) == (1, CONFIG.law(None, 0.0))
    voltage = role.law.voltage
    for _ in then:
        role.step()
    assert (edge.agent.parameters.version, role.law.law) == (1, CONFIG.law(None, 1e-4))
    assert role.law.voltage == pytest.approx(voltage)


def test_a_lost_drive_is_connected_again_and_the_law_begins_anew(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    edge, stop = edge_of(box), StopSignal()
    drive = ScriptedDrive([*samples(0, 5), DriveLost("gone"), *samples(5, 5), None])
    roles = []

    def role_of() -> ControlRole:
        roles.append(ControlRole(edge, drive))
        return roles[-1]

    until(stop, edge, drive, role_of)
    assert (drive.connects, len(roles), edge.counts["drive lost"]) == (2, 1, 1)
    assert edge.agent.samples == 10
    assert len(drive.voltages) == 10


def test_a_drive_that_was_right_before_may_come_right_again() -> None:
    """As a server that is up before its variables are there."""
    edge = edge_of(PipeOutlet(False))
    drive = ScriptedDrive([*samples(0, 5), DriveLost("gone"), *samples(5, 5), None])
    reach, refusals = drive.connect, [None, InvalidInput("no such variable"), None]

    def connect() -> None:
        reach()
        refused = refusals.pop(0)
        if refused is not None:
            raise refused

    drive.connect = connect
    until(StopSignal(), edge, drive, lambda: ControlRole(edge, drive))
    assert (refusals, edge.counts["drive lost"], edge.agent.samples) == ([], 2, 10)


@pytest.mark.parametrize("role", [ControlRole, SupervisingRole])
def test_another_machine_under_the_due_number_begins_a_new_boot(role: type) -> None:
    supervised = role is SupervisingRole
    edge = edge_of(PipeOutlet(False), SUPERVISED if supervised else CONFIG)
    given = [block(0, 5), block(5, 5), block(10, 5)] if supervised else samples(0, 3)
    drive = ScriptedDrive(given)
    running = role(edge, drive)
    running.step()
    running.lost()
    running.step()
    assert edge.agent.settings.boot == "b0"
    running.lost()
    drive.machine = "another"
    running.step()
    assert edge.agent.settings.boot == "b0.1"


def test_a_drive_of_another_rate_is_refused() -> None:
    drive = ScriptedDrive([])
    drive.rate = 99.0
    with pytest.raises(InvalidInput, match=r"sample_rate_hz = 100.0 Hz: the drive's rate is 99.0 Hz"):
        until(StopSignal(), edge_of(PipeOutlet(False)), drive, lambda: ControlRole(edge_of(PipeOutlet(False)), drive))


def block(first: int, count: int, reference: float = 1e-3) -> Block:
    return Block(first, 0, *(array("d", [value]) * count for value in (reference, 0.0, 0.0, 0.1)))


SUPERVISED = replace(CONFIG, role="supervise")


def supervising(far: LinkEnd, blocks: int) -> tuple[PipeOutlet, EdgeRuntime, ScriptedDrive, SupervisingRole]:
    """A connected edge that has supervised a first block."""
    box = PipeOutlet(True)
    box.connect(far.near)
    edge = edge_of(box, SUPERVISED)
    drive = ScriptedDrive([block(5 * k, 5) for k in range(blocks)])
    role = SupervisingRole(edge, drive)
    role.step()
    return box, edge, drive, role


def test_supervising_records_writes_parameters_and_moves_the_reference(far: LinkEnd) -> None:
    box, _, drive, role = supervising(far, 12)
    assert [p.version for p in drive.voltages] == [0]
    far.send(frames.MessageFrame(1, encode(update(1, 1e-4))))
    for _ in range(5):
        role.step()
    assert [p.version for p in drive.voltages] == [0, 1]
    far.send(frames.MessageFrame(2, encode(Request("axis-1", "b0", 1, Probe(5e-4, 0.05), 1e6))))
    for _ in range(2):
        role.step()
    assert "move 0.0005" in drive.log
    exchange_all(box)
    (answer,) = letters(far, Answer)
    assert isinstance(answer, Answer)
    assert answer.accepted
    role.stop()
    assert drive.log[-1] == "move 0.0"


def test_parameters_that_a_supervised_drive_refuses_are_restored_and_reported(far: LinkEnd) -> None:
    """The agent runs on what the drive runs on, under a version of its own; the twin hears of it after the receipt."""
    box, edge, drive, role = supervising(far, 40)
    drive.refuse = True
    far.send(frames.MessageFrame(1, encode(update(1, 1e-4))))
    for _ in range(5):
        role.step()
    drive.refuse = False
    for _ in range(3):
        role.step()
    in_force = edge.agent.parameters
    assert (in_force.version, in_force.setting.tolerance) == (2, drive.voltages[0].setting.tolerance)
    assert [p.version for p in drive.voltages] == [0]
    exchange_all(box)
    receipt, fallback = letters(far, (Receipt, Fallback))
    assert isinstance(receipt, Receipt)
    assert receipt.applied
    assert isinstance(fallback, Fallback)
    assert (fallback.cause, fallback.replaced, fallback.parameter_version) == (Cause.DRIVE, 1, 2)
    role.lost()
    role.step()
    assert drive.voltages[-1] == in_force


def test_a_log_waits_for_the_link_process_and_a_machine_does_not(far: LinkEnd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlet, "MOST", 2000)
    dropped = {}
    for patient in (False, True):
        box = PipeOutlet(True)
        box.connect(far.near)
        edge = edge_of(box, SUPERVISED)
        drive = ScriptedDrive([block(10 * k, 10, 1e-3 * k) for k in range(12)])
        drive.patient = patient
        monkeypatch.setattr(
            edge, "pause", lambda _, box=box: [box._acknowledge(serial) for serial in list(box._unacknowledged)[:1]]
        )
        role = SupervisingRole(edge, drive)
        for _ in range(12):
            role.step()
        dropped[patient] = box.dropped[BEHIND]
    assert dropped[False] > 0
    assert dropped[True] == 0


def test_the_edge_ends_after_the_link_process_has_taken_all_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    box = PipeOutlet(True)
    edge = edge_of(box)
    for k in range(50):
        box.offer(cut(k))
    clock = edge.clock

    def pause(seconds: float) -> None:
        clock.pause(200.0 * seconds)
        if len(box._windows) > 3:
            box._acknowledge(min(box._windows))

    monkeypatch.setattr(edge, "pause", pause)
    edge.finish(3.0)
    assert box.untaken == 3
    assert 47.0 < clock.now < 55.0


def test_a_supervised_drive_that_refuses_or_misses_is_counted(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    edge = edge_of(box, SUPERVISED)
    drive = ScriptedDrive([block(0, 5), block(8, 5), block(13, 0), block(500, 5), None])
    drive.refuse = True
    role = SupervisingRole(edge, drive)
    while role.step():
        pass
    assert edge.counts["parameters refused by the drive"] >= 1
    assert (edge.counts["samples missed"], edge.counts["boot: samples missing"]) == (3, 1)
