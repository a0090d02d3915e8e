"""The live view at the edge: samples in shared memory, extremes of each 100 ms, sent only while somebody watches."""

from array import array
from math import nan
from threading import Event

import pytest
from edge_process_parts import RATE, SETTINGS
from hypothesis import given
from hypothesis import strategies as st

from servotwin.edge.agent import Agent
from servotwin.edge.outlet import CHANNELS, recorded_channels
from servotwin.edge.recorder import Recorder
from servotwin.edge_process.config import TwinLink
from servotwin.edge_process.live_view import LiveView, live_column
from servotwin.edge_process.shared_samples import SampleMemory, SampleReader
from servotwin.errors import InvalidInput
from servotwin.link.claim import HeldClaim
from servotwin.link.transport import Refused, Unreachable
from servotwin.messages import Refusal
from servotwin.messages.live import MAX_LIVE_COLUMNS, LiveColumns

WIDTH = round(0.1 * RATE)


class Memory:
    """Shared memory with its reader."""

    def __init__(self, least: int = 100) -> None:
        self.writer = SampleMemory(least)
        self.reader = SampleReader(self.writer.descriptor)

    def __enter__(self) -> "Memory":
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()


class Link:
    """A twin that answers as it is told, and notes what it is sent."""

    def __init__(self, *answers: bool | Exception) -> None:
        self.answers, self.sent = list(answers), list[LiveColumns]()

    def send(self, columns: LiveColumns, claim: HeldClaim) -> bool:
        assert claim.number
        self.sent.append(columns)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        pass


def view(link: Link, memory: Memory, claim: HeldClaim = HeldClaim("b1", 1)) -> LiveView:  # noqa: B008
    return LiveView(link, memory.reader, "axis-1", RATE, lambda: claim, Event())


def record(recorder: Recorder, samples: int) -> None:
    for _ in range(samples):
        k = float(recorder.samples)
        recorder.append(k + 1.0, 0.0, k, -k)


@given(st.integers(1, 9), st.lists(st.integers(0, 25), max_size=8), st.data())
def test_shared_and_own_ring_buffers_hold_the_same_samples(
    capacity: int, blocks: list[int], data: st.DataObject
) -> None:
    with Memory(1) as memory:
        own, shared = Recorder(("a", "b"), capacity), memory.writer.recorder(("a", "b"), capacity)
        total = 0
        for count in blocks:
            values = array("d", range(total, total + count))
            for recorder in (own, shared):
                if count == 1:
                    recorder.append(values[0], -values[0])
                else:
                    recorder.extend(values, array("d", [-value for value in values]))
            total += count
        assert (own.samples, own.oldest) == (shared.samples, shared.oldest)
        assert memory.reader.position == (1, total)
        if total == 0:
            return
        first = data.draw(st.integers(own.oldest, total - 1))
        last = data.draw(st.integers(first + 1, total))
        assert own.cut(first, last) == shared.cut(first, last)
        read = memory.reader.read(first, last)
        if first > total - capacity:
            assert read is not None
            assert read.channels == list(own.cut(first, last).values())
        for outside in (own.oldest - 1, total):
            with pytest.raises(InvalidInput, match="are in the recorder"):
                shared.cut(outside, total + 1)
            assert memory.reader.read(outside, total + 1) is None


def test_an_agent_does_the_same_with_shared_memory() -> None:
    with Memory() as memory:
        letters = []
        for recorder in (Recorder, memory.writer.recorder):
            agent = Agent(SETTINGS, recorder=recorder)
            made = [agent.absorb(1.0 if k > 30 else 0.0, 0.1 * k, 0.01 * k, 2.0) for k in range(80)]
            made.append(agent.absorb_block([1.0] * 20, [0.0] * 20, [0.0] * 20, [1.0] * 20))
            windows = [agent.outlet.outbox.parcel(key).body for key in agent.outlet.outbox.pending()]  # type: ignore[attr-defined]
            letters.append((made, windows, agent.windows_cut))
        assert letters[0] == letters[1]
        assert letters[0][2] > 0
        assert memory.reader.position == (1, 100)


def test_columns_flow_only_while_somebody_watches() -> None:
    with Memory() as memory:
        recorder = memory.writer.recorder(tuple(CHANNELS), 100)
        link = Link(False, True, True, False, False)
        live = view(link, memory)
        record(recorder, 25)
        assert live.step() == 0.0  # it asked, and nobody watches: it asks again
        assert live.step() == 0.5
        record(recorder, 20)
        assert live.step() == 0.5
        record(recorder, 10)
        assert live.step() == 0.0
        record(recorder, 30)
        live.step()
        first, second, third, fourth, fifth = link.sent
        assert [each.columns for each in (first, second, fifth)] == [(), (), ()]
        assert (third.boot, third.first, third.width) == (1, 2, 0.1)
        assert third.columns == ((20.0, 29.0, 1.0, 1.0, -29.0, -20.0), (30.0, 39.0, 1.0, 1.0, -39.0, -30.0))
        assert (fourth.first, len(fourth.columns)) == (4, 1)


def test_columns_are_those_of_the_load_where_the_motor_has_no_encoder() -> None:
    with Memory() as memory:
        recorder, link = memory.writer.recorder(recorded_channels(motor_encoder=False), 100), Link(True, True)
        live = view(link, memory)
        live.step()
        for k in range(10):
            recorder.append(k + 1.0, float(k), -float(k))
        live.step()
        assert link.sent[1].columns == ((0.0, 9.0, 1.0, 1.0, -9.0, 0.0),)


def test_what_was_overwritten_is_skipped_and_the_newest_is_sent() -> None:
    with Memory(WIDTH * 5) as memory:
        recorder = memory.writer.recorder(tuple(CHANNELS), 1)
        link = Link(True, True, True)
        live = view(link, memory)
        live.step()
        record(recorder, 200 * WIDTH)
        live.step()
        sent = link.sent[-1]
        assert sent.first + len(sent.columns) == 200
        assert 0 < len(sent.columns) <= 5
        assert live.counts["columns skipped"] == sent.first
        record(memory.writer.recorder(tuple(CHANNELS), 1), 3 * WIDTH)  # a new boot
        live.step()
        assert link.sent[-1].boot in (1, 2)
        assert len(link.sent[-1].columns) <= MAX_LIVE_COLUMNS


@pytest.mark.parametrize(
    ("failure", "least"),
    [
        (Unreachable("gone"), 2.5),
        (Refused(Refusal.UNAVAILABLE, "later", 7.0), 7.0),
        (Refused(Refusal.UNKNOWN_SCHEMA, "the twin is of a version without the live view"), 600.0),
    ],
)
def test_a_twin_that_fails_ends_the_stream_and_is_asked_later(failure: Exception, least: float) -> None:
    with Memory() as memory:
        recorder = memory.writer.recorder(tuple(CHANNELS), 100)
        link = Link(True, failure, False)
        live = view(link, memory)
        live.step()
        record(recorder, 20)
        assert live.step() >= least
        live.step()
        assert link.sent[-1].columns == ()


def test_without_a_claim_nothing_is_sent() -> None:
    with Memory() as memory:
        link = Link()
        assert view(link, memory, HeldClaim("b1")).step() > 0.0
        assert link.sent == []


def test_samples_that_are_no_numbers_leave_the_others() -> None:
    ramp = array("d", [1.0, nan, 3.0])
    column = live_column({"reference": ramp, "theta_m": ramp, "position": array("d", [nan] * 3), "voltage": ramp})
    assert column == (None, None, None, None, 1.0, 3.0)


def test_the_live_view_is_off_unless_allowed_over_http_and_mqtt() -> None:
    for url in ("https://h", "mqtts://h"):
        assert not TwinLink(url, "token").live
        assert TwinLink(url, "token", live=True).live
