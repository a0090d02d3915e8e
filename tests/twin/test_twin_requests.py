"""The twin's half of requests: one at a time, repeated, renumbered after a lost state, abandoned."""

import math

import msgspec
import pytest

from servotwin import messages
from servotwin.control.gains import gains_of
from servotwin.estimation.estimate import GapEstimate, GapStatus, interval_95, no_estimate
from servotwin.messages import Answer, LongerWindow, Probe, Request, RequestOutcome, Setting, pack_channel
from servotwin.messages.acts import Act, ActKind
from servotwin.plant.servo import Servo
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.evidence_log import EvidenceLog
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.twin import Twin

SERVO = Servo.preset("paper")
LAW = SERVO.controller


def window(sequence: int, boot: str = "b0", length: int = 100, change: float = 0.0, reason: str = "reference"):
    """At 100 Hz, 10 s apart, the reference changing `change` s after the first sample."""
    start = 5.0 + 10.0 * sequence
    channels = tuple(pack_channel(name, unit, [0.0] * length) for name, unit in (("position", "m"), ("theta_m", "rad")))
    changes = ((start + change, 1e-3),)
    crc = messages.checksum(channels)
    return messages.WindowMessage("axis", boot, sequence, start, 100.0, channels, changes, 0, "model", reason, crc)


def long(sequence: int, **changes):
    return window(sequence, length=200, change=0.3, **changes)


class Says:
    """An estimator that gives what it is told to."""

    def __init__(self, *statuses: GapStatus, gap: float = 0.1) -> None:
        self.statuses, self.gap = list(statuses), gap

    def __call__(self, window, _expected) -> GapEstimate:
        status = self.statuses.pop(0) if self.statuses else GapStatus.UNIDENTIFIABLE
        if status is GapStatus.UNIDENTIFIABLE:
            return no_estimate(window.mid_time, ("nothing",), method="test")
        return GapEstimate(self.gap, 1e-4, 1e-3, interval_95(self.gap, 1e-3), status, window.mid_time, method="test")


START = Setting(0.0, gains_of(LAW))
LATE = gains_of(LAW.replace(leave=1.5))


def make(says: Says | None = None, runs: Setting | None = START, **settings) -> tuple[Twin, EvidenceLog]:
    excitation = ExcitationSettings(probe=1e-2, interval=15.0)
    twin_settings = TwinSettings(policy="paper", excitation=excitation, retry=2.0, attempts=3, **settings)
    twin = Twin("axis", TwinModel.of(SERVO, twin_settings, runs, says or Says()))
    return twin, twin.log


def requests(sent) -> list[messages.Request]:
    return [message for message in sent if isinstance(message, messages.Request)]


def requests_after(twin: Twin, *windows) -> list[messages.Request]:
    return requests([message for each in windows for message in twin.receive(each, each.start + 3.0)])


def answer(request, outcome=RequestOutcome.ACCEPTED, newest=None) -> Answer:
    return Answer("axis", request.boot, request.serial, 1000, outcome, request.serial if newest is None else newest)


def test_a_request_says_what_and_why_and_is_stored_before_it_is_sent() -> None:
    twin, store = make()
    (request,) = requests_after(twin, window(0), window(1))
    assert (request.servo, request.boot, request.serial, request.ask) == ("axis", "b0", 1, LongerWindow(2.0, 0.3))
    assert request.not_after == 15.0 + 60.0
    assert request.reason == store.excitations["axis", "b0", 1].reason
    assert store.requests == [request]


def test_it_is_repeated_until_answered() -> None:
    twin, store = make()
    (request,) = requests_after(twin, window(0), window(1))
    assert twin.next_wake() == 20.0
    assert twin.wake(19.9) == []
    assert twin.wake(20.0) == [request]
    assert twin.receive(answer(request), 21.0) == []
    assert store.answers == [answer(request)]
    assert twin.next_wake() is None


def test_it_is_given_up_and_made_again_after_more_windows() -> None:
    twin, store = make()
    (request,) = requests_after(twin, window(0), window(1))
    assert twin.wake(20.0) + twin.wake(22.0) + twin.wake(24.0) == [request] * 2
    assert twin.next_wake() is None
    (again,) = requests_after(twin, window(2), window(3))
    assert (again.serial, again.ask) == (2, request.ask)
    assert len(store.requests) == 2


@pytest.mark.parametrize("outcome", [RequestOutcome.BUSY, RequestOutcome.TOO_SOON])
def test_a_bad_moment_is_no_answer(outcome: RequestOutcome) -> None:
    twin, _ = make()
    (request,) = requests_after(twin, long(0), long(1))
    assert isinstance(request.ask, Probe)
    assert twin.receive(answer(request, outcome, 0), 19.0) == []
    assert twin.wake(20.0) == [request]


def test_a_twin_that_forgot_its_numbers_goes_on_from_the_edges() -> None:
    twin, store = make()
    (request,) = requests_after(twin, window(0), window(1))
    (renumbered,) = requests(twin.receive(answer(request, RequestOutcome.DUPLICATE, newest=7), 19.0))
    assert (renumbered.serial, renumbered.ask) == (8, request.ask)
    assert store.requests == [request, renumbered]
    assert twin.receive(answer(request, RequestOutcome.DUPLICATE, newest=7), 19.5) == []


def test_a_probe_that_is_not_needed_any_more_is_not_repeated() -> None:
    twin, _ = make(Says(GapStatus.UNIDENTIFIABLE, GapStatus.UNIDENTIFIABLE, GapStatus.OK))
    assert len(requests_after(twin, long(0), long(1))) == 1
    twin.receive(long(2), 19.0)
    assert requests(twin.wake(100.0)) == []


def test_a_new_boot_begins_anew() -> None:
    twin, _ = make()
    (request,) = requests_after(twin, window(0), window(1))
    assert requests_after(twin, window(0, boot="b1")) == []
    assert requests(twin.wake(100.0)) == []
    (again,) = requests_after(twin, window(1, boot="b1"))
    assert (again.boot, again.serial, again.ask) == ("b1", 1, request.ask)


@pytest.mark.parametrize(
    ("status", "runs", "size"),
    [
        (GapStatus.UNIDENTIFIABLE, START, SERVO.p * math.radians(65.0)),
        (GapStatus.UNIDENTIFIABLE, Setting(1e-4, gains_of(LAW)), 2e-4 + SERVO.p * math.radians(65.0)),
        (
            GapStatus.UNIDENTIFIABLE,
            Setting(1e-4, LATE),
            2.5e-4 + SERVO.p * math.radians(65.0),
        ),
        (GapStatus.UNIDENTIFIABLE, None, None),
    ],
)
def test_the_size_comes_from_the_stated_range_and_the_dead_zone(
    status: GapStatus, runs: Setting | None, size: float | None
) -> None:
    twin, store = make(Says(status), runs)
    found = requests_after(twin, long(0), long(1))
    assert [request.ask.size for request in found] == pytest.approx([] if size is None else [size])
    assert size is not None or "bounded" in store.excitations["axis", "b0", 1].reason


def test_the_size_comes_from_the_trend_once_there_is_one() -> None:
    twin, _ = make(Says(GapStatus.OK), Setting(0.0, gains_of(LAW)))
    (request,) = requests_after(twin, long(0), long(1), long(2))
    assert request.ask.size < 2.0 * SERVO.p * (0.1 + math.radians(5.0))
    assert request.ask.size > SERVO.p * (0.1 + math.radians(5.0))


def test_the_window_of_a_probe_counts_as_long() -> None:
    twin, _ = make()
    (first,) = requests_after(twin, long(0), long(1))
    twin.receive(answer(first), 19.0)
    (second,) = requests_after(twin, window(2, length=170, reason="probe"), long(3))
    assert isinstance(second.ask, Probe)


def test_what_no_estimator_takes_is_no_reason_to_move_the_machine() -> None:
    twin, store = make(Says())
    channels = (pack_channel("position", "deg", [0.0] * 100),)
    broken = [msgspec.structs.replace(window(k), channels=channels, crc=messages.checksum(channels)) for k in range(4)]
    assert requests_after(twin, *broken) == []
    assert store.excitations == {}


def test_without_settings_answers_are_stored_and_nothing_is_requested() -> None:
    twin = Twin("axis", TwinModel.of(SERVO, TwinSettings(policy="paper"), START, Says()))
    store = twin.log
    assert requests_after(twin, window(0), window(1), window(2)) == []
    late = Answer("axis", "b0", 1, 0, RequestOutcome.ACCEPTED, 1)
    assert twin.receive(late, 50.0) == []
    assert store.answers == [late]


def test_a_held_machine_is_asked_for_no_probing_move():
    twin, _ = make()
    [request] = requests_after(twin, long(0), long(1))
    twin._step(Act("axis", ActKind.HOLD, "eva", "a hand is in the machine", 18.0), 18.0)
    assert twin.wake(20.0) == []
    assert not any(
        isinstance(each, Request) for each in twin.receive(answer(request, RequestOutcome.DUPLICATE, 7), 20.5)
    )
