"""What the edge makes of requests: longer windows, probing moves, and every reason to refuse."""

from array import array
from dataclasses import replace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sending_agent import SendingAgent

from servotwin.edge.agent import ScheduledMessage
from servotwin.edge.probe import ProbeLimits, ProbingMove
from servotwin.edge.settings import AgentSettings
from servotwin.edge.supervisor import Supervisor
from servotwin.errors import InvalidInput
from servotwin.messages import (
    Answer,
    Cause,
    Fallback,
    LongerWindow,
    Message,
    Probe,
    Request,
    RequestOutcome,
    Setting,
    WindowMessage,
    unpack_channel,
)
from servotwin.runtime.retry import Retry

LIMITS = ProbeLimits(size=1e-3, interval_s=5.0, rest_s=0.5)
MOVE = Probe(1e-3, 0.4)
RATE = 10.0


def settings(**changes: Any) -> AgentSettings:
    values = {"servo": "axis-1", "boot": "b0", "sample_rate": RATE, "retry": Retry(50.0, 1.0), "window_s": 0.8,
              "longest_window_s": 2.0, "longest_pre_trigger_s": 0.5, "probe": LIMITS}  # fmt: skip
    return AgentSettings(**{**values, **changes})


def request(serial: int = 1, ask: Any = MOVE, **changes: Any) -> Request:
    return msgspec.structs.replace(Request("axis-1", "b0", serial, ask, 60.0), **changes)


def feed(agent: SendingAgent, targets: list[float]) -> list[Message]:
    """As whoever ticks the law does: wanted position plus the agent's offset, one sample after the other."""
    sent = list[ScheduledMessage]()
    for value in targets:
        k = float(agent.samples)
        sent += agent.absorb(value + agent.offset, 0.1 * k, 1e-3 * k, -k)
    return [out.message for out in sent]


def answer(agent: SendingAgent, message: Request) -> Answer:
    (reply,) = agent.receive(message)
    assert isinstance(reply.message, Answer)
    return reply.message


def references(window: WindowMessage) -> list[float]:
    channel = window.channel("reference")
    assert channel is not None
    return [round(1e6 * x) / 1e6 for x in unpack_channel(channel)]


def windows(sent: list[Message]) -> list[WindowMessage]:
    return [message for message in sent if isinstance(message, WindowMessage)]


def test_a_longer_window_counts_from_the_next_change_on() -> None:
    agent = SendingAgent(settings())
    feed(agent, [0.0] * 9 + [1e-3])
    assert answer(agent, request(ask=LongerWindow(1.5, 0.3))) == Answer(
        "axis-1", "b0", 1, 10, RequestOutcome.ACCEPTED, 1
    )
    (short,) = windows(feed(agent, [1e-3] * 20))
    (longer,) = windows(feed(agent, [0.0] * 20))
    assert (short.start, short.samples) == (0.9, 8)
    assert (longer.start, longer.samples, longer.reference_changes) == (2.7, 15, ((3.0, 0.0),))


def test_windows_never_get_shorter_than_configured() -> None:
    agent = SendingAgent(settings(pre_trigger_s=0.2))
    assert answer(agent, request(ask=LongerWindow(0.3, 0.1))).accepted
    (window,) = windows(feed(agent, [0.0] * 5 + [1e-3] * 20))
    assert (window.start, window.samples) == (0.3, 8)


def test_a_probing_move_goes_there_and_back_and_has_a_window_of_its_own() -> None:
    agent = SendingAgent(settings(pre_trigger_s=0.2))
    feed(agent, [2e-3] * 30)
    assert answer(agent, request(ask=Probe(1e-3, 0.4, 2))) == Answer("axis-1", "b0", 1, 30, RequestOutcome.ACCEPTED, 1)
    sent = feed(agent, [2e-3] * 40)
    (window,) = windows(sent)
    assert (window.reason, window.start, window.samples) == ("probe", 2.8, 18)
    assert references(window) == [2e-3] * 2 + ([3e-3] * 4 + [2e-3] * 4) * 2
    assert [time for time, _ in window.reference_changes] == [3.0, 3.4, 3.8, 4.2]
    assert agent.probe is None


def test_a_move_to_several_places_goes_to_each_and_its_window_is_for_teaching() -> None:
    agent = SendingAgent(settings(pre_trigger_s=0.2))
    feed(agent, [2e-3] * 30)
    assert answer(agent, request(ask=Probe(-1e-3, 0.2, 1, (0.4, 0.0, 1.0, 0.6, 1.0, 0.0)))).accepted
    (window,) = windows(feed(agent, [2e-3] * 40))
    assert (window.reason, window.start, window.samples) == ("teaching", 2.8, 14)
    places = [1.6e-3, 2e-3, 1e-3, 1.4e-3, 1e-3, 2e-3]
    assert references(window) == [2e-3] * 2 + [place for place in places for _ in range(2)]
    assert [time for time, _ in window.reference_changes] == [3.0, 3.2, 3.4, 3.6, 3.8, 4.0]
    assert (agent.probe, agent.offset) == (None, 0.0)


def test_a_move_to_several_places_is_as_long_as_all_of_them() -> None:
    agent = SendingAgent(settings())
    feed(agent, [2e-3] * 30)
    six = (0.4, 0.0, 1.0, 0.6, 1.0, 0.0)
    assert answer(agent, request(ask=Probe(1e-3, 0.4, 1, six))).outcome is RequestOutcome.TOO_LARGE
    assert answer(agent, request(serial=2, ask=Probe(1e-3, 0.3, 1, six))).outcome is RequestOutcome.ACCEPTED


def test_the_move_ends_when_the_reference_moves_and_its_window_is_another() -> None:
    agent = SendingAgent(settings(pre_trigger_s=0.2))
    feed(agent, [2e-3] * 30)
    assert answer(agent, request()).accepted
    (window,) = windows(feed(agent, [2e-3] * 3 + [0.0] * 30))
    assert agent.offset == 0.0
    assert (window.reason, window.start, window.samples) == ("reference", 3.1, 8)
    assert references(window) == [3e-3, 3e-3, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_the_move_ends_with_a_fallback(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = SendingAgent(settings())
    feed(agent, [0.0] * 30)
    assert answer(agent, request()).accepted
    fallback = Fallback("axis-1", "b0", 34, Cause.ERROR, 1.0, 0.1, 0, 1, Setting(0.0))
    monkeypatch.setattr(Supervisor, "check", lambda self: (fallback,) if self._recorder.samples == 34 else ())
    sent = feed(agent, [0.0] * 40)
    assert fallback in sent
    assert windows(sent) == []
    assert agent.probe is None


def test_a_law_that_ignores_the_offset_ends_the_move() -> None:
    agent = SendingAgent(settings())
    feed(agent, [0.0] * 30)
    assert answer(agent, request()).accepted
    for _ in range(3):
        agent.absorb(0.0, 0.0, 0.0, 0.0)
    assert agent.probe is None


def test_a_probing_move_without_permission_is_refused() -> None:
    agent = SendingAgent(settings(probe=None))
    feed(agent, [0.0] * 30)
    assert answer(agent, request()) == Answer("axis-1", "b0", 1, 30, RequestOutcome.NOT_ALLOWED, 1)
    assert agent.offset == 0.0


@pytest.mark.parametrize(
    ("message", "outcome"),
    [
        (request(servo="axis-2"), RequestOutcome.WRONG_SERVO),
        (request(boot="b1"), RequestOutcome.OTHER_BOOT),
        (request(not_after=3.0), RequestOutcome.EXPIRED),
        (request(ask=Probe(1.001e-3, 0.4)), RequestOutcome.TOO_LARGE),
        (request(ask=Probe(-1.001e-3, 0.4)), RequestOutcome.TOO_LARGE),
        (request(ask=Probe(1e-3, 1.1)), RequestOutcome.TOO_LARGE),
        (request(ask=Probe(1e-3, 0.4, 3)), RequestOutcome.TOO_LARGE),
        (request(ask=LongerWindow(2.1, 0.3)), RequestOutcome.TOO_LARGE),
        (request(ask=LongerWindow(2.0, 0.6)), RequestOutcome.TOO_LARGE),
        (request(ask=Probe(-1e-3, 1.0)), RequestOutcome.ACCEPTED),
        (request(ask=LongerWindow(2.0, 0.5)), RequestOutcome.ACCEPTED),
    ],
)
def test_a_refused_request_has_its_reason(message: Request, outcome: RequestOutcome) -> None:
    agent = SendingAgent(settings())
    feed(agent, [0.0] * 30)
    before = agent._requests
    assert answer(agent, message).outcome is outcome
    assert (replace(agent._requests, answer=None) == before) == (outcome is not RequestOutcome.ACCEPTED)


def test_a_request_counts_once_and_is_answered_again() -> None:
    agent = SendingAgent(settings())
    feed(agent, [0.0] * 30)
    first = answer(agent, request())
    feed(agent, [0.0] * 90)
    assert answer(agent, request()) == first
    assert agent.probe is None
    assert answer(agent, request(serial=4, ask=LongerWindow(1.5, 0.3))).accepted
    late = answer(agent, request(serial=2))
    assert (late.outcome, late.newest) == (RequestOutcome.DUPLICATE, 4)


@pytest.mark.parametrize("fed", [0, 3, 31, 35])
def test_a_probing_move_begins_only_at_rest(fed: int) -> None:
    """Before anything rested, and while a window is recorded."""
    agent = SendingAgent(settings())
    feed(agent, ([0.0] * 30 + [1e-3] * 10)[:fed])
    assert answer(agent, request()) == Answer("axis-1", "b0", 1, fed, RequestOutcome.BUSY, 0)
    feed(agent, [1e-3] * 30)
    assert answer(agent, request()).accepted


def test_moves_keep_their_distance_and_the_same_request_may_come_again() -> None:
    agent = SendingAgent(settings())
    feed(agent, [0.0] * 30)
    assert answer(agent, request()).accepted
    feed(agent, [0.0] * 49)
    assert answer(agent, request(serial=2)).outcome is RequestOutcome.TOO_SOON
    feed(agent, [0.0])
    assert answer(agent, request(serial=2)).accepted


@given(
    targets=st.lists(st.tuples(st.sampled_from([0.0, 0.1, 0.3]), st.integers(1, 12)), min_size=1, max_size=8),
    requests=st.dictionaries(st.integers(0, 60), st.sampled_from([MOVE, Probe(-3e-4, 0.3, 2), LongerWindow(1.1, 0.4)])),
    cuts=st.sets(st.integers(1, 96), max_size=9),
)
def test_blocks_equal_single_samples(
    targets: list[tuple[float, int]], requests: dict[int, Any], cuts: set[int]
) -> None:
    """Blocks end where requests come and, during a move, with the sample at which the wanted position changes."""
    reference = [value for value, count in targets for _ in range(count)]
    single, blocks = SendingAgent(settings()), SendingAgent(settings())
    one, other = list[ScheduledMessage](), list[ScheduledMessage]()
    serial, done = 0, 0
    while done < len(reference):
        if done in requests:
            serial += 1
            message = request(serial, requests[done])
            one += single.receive(message)
            other += blocks.receive(message)
        stops = [*cuts, *requests, len(reference)]
        stop = min(place for place in stops if place > done)
        if blocks.probe is not None:
            stop = min([stop, blocks.probe.next_change(done)])
            stop = next((k + 1 for k in range(done, stop) if reference[k] != reference[max(0, done - 1)]), stop)
        offset = blocks.offset
        block = array("d", (value + offset for value in reference[done:stop]))
        signals = [array("d", (factor * k for k in range(done, stop))) for factor in (0.1, 1e-3, -1.0)]
        other += blocks.absorb_block(block, *signals)
        for k in range(done, stop):
            one += single.absorb(reference[k] + single.offset, 0.1 * k, 1e-3 * k, -1.0 * k)
        done = stop
    assert one == other


def test_a_move_tells_its_changes() -> None:
    move = ProbingMove.of(Probe(1e-3, 0.4, 2), 7, RATE)
    assert list(move.changes()) == [(7, 1e-3), (11, 0.0), (15, 1e-3), (19, 0.0)]
    assert [move.offset(k) for k in (6, 7, 10, 11, 14, 15, 18, 19, 22, 23)] == [
        0.0, 1e-3, 1e-3, 0.0, 0.0, 1e-3, 1e-3, 0.0, 0.0, 0.0,
    ]  # fmt: skip
    assert [move.next_change(k) for k in (7, 10, 11, 18, 19, 22)] == [11, 11, 15, 19, 23, 23]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ProbeLimits(0.0), "probe size = 0.0 m"),
        (lambda: ProbeLimits(1e-3, interval_s=-1.0), "probe interval_s = -1.0 s"),
        (lambda: ProbeLimits(1e-3, rest_s=0.0), "probe rest_s = 0.0 s"),
        (lambda: settings(longest_window_s=0.5), "longest_window_s = 0.5 s: must be at least window_s = 0.8 s"),
        (lambda: settings(longest_window_s=2.05), "longest_window_s = 2.05 s: must be a whole number of samples"),
        (lambda: settings(longest_pre_trigger_s=2.0), "longest_pre_trigger_s = 2.0 s: must be below"),
    ],
)
def test_bad_limits_are_named(make: Any, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        make()
