"""The agent: which windows it cuts, that blocks equal single samples, what it does with messages."""

import math
from array import array
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sending_agent import SendingAgent

from servotwin.edge.agent import Agent, ScheduledMessage
from servotwin.edge.guard import Limits
from servotwin.edge.outlet import MAX_CHANGES
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.errors import InvalidInput
from servotwin.link.outbox import MemoryOutbox
from servotwin.messages import (
    PROTOCOL,
    Acknowledge,
    Hello,
    Reason,
    Receipt,
    Resend,
    Setting,
    Update,
    WindowMessage,
    checksum,
    unpack_channel,
)
from servotwin.runtime.retry import Retry


def settings(**changes: Any) -> AgentSettings:
    values = {"servo": "axis-1", "boot": "b0", "sample_rate": 10.0, "model_version": "paper", "retry": Retry(2.0)}
    return AgentSettings(**{**values, **changes})


def feed(agent: Agent, reference: list[float]) -> list[ScheduledMessage]:
    """Samples whose signals tell their index."""
    n = agent.samples
    ramp = array("d", range(n, n + len(reference)))
    return agent.absorb_block(reference, [0.1 * x for x in ramp], [1e-3 * x for x in ramp], [-x for x in ramp])


def windows(sent: list[ScheduledMessage]) -> list[WindowMessage]:
    return [out.message for out in sent if isinstance(out.message, WindowMessage)]


def update(**changes: Any) -> Update:
    values = {"servo": "axis-1", "version": 1, "base_version": 0, "window": ("b0", 0), "data_time": 0.0, "gap": 0.1,
              "std": 0.01, "interval": (0.08, 0.12), "status": "OK", "setting": Setting(1e-4),
              "not_after": 60.0}  # fmt: skip
    return Update(**{**values, **changes})


def test_a_change_of_the_reference_gives_one_window() -> None:
    agent = SendingAgent(settings())
    sent = feed(agent, [0.0] * 7 + [1e-3] * 12)
    assert [out.sample for out in sent] == [17]
    (window,) = windows(sent)
    assert window.identity == ("axis-1", "b0", 0)
    assert (window.start, window.rate, window.samples) == (0.7, 10.0, 10)
    assert window.reference_changes == ((0.7, 1e-3),)
    assert (window.parameter_version, window.model_version, window.reason) == (0, "paper", "reference")
    assert window.crc == checksum(window.channels)
    assert [(c.name, c.unit) for c in window.channels] == [
        ("reference", "m"), ("theta_m", "rad"), ("position", "m"), ("voltage", "V"),
    ]  # fmt: skip
    position, voltage = (unpack_channel(channel) for channel in window.channels[2:])
    assert position == pytest.approx([1e-3 * k for k in range(7, 17)], abs=1e-7)
    assert voltage == pytest.approx([-float(k) for k in range(7, 17)], abs=1e-4)


def test_the_pre_trigger_lies_before_the_change() -> None:
    agent = SendingAgent(settings(pre_trigger_s=0.3))
    sent = feed(agent, [0.0] * 7 + [1e-3] * 12)
    assert [out.sample for out in sent] == [14]
    assert windows(sent)[0].start == 0.4
    assert windows(sent)[0].reference_changes == ((0.7, 1e-3),)


def test_the_pre_trigger_cannot_reach_before_the_first_sample() -> None:
    sent = feed(SendingAgent(settings(pre_trigger_s=0.9)), [0.0] + [1e-3] * 12)
    assert (sent[0].sample, windows(sent)[0].start, windows(sent)[0].samples) == (10, 0.0, 10)


def test_a_first_sample_that_differs_from_rest_is_a_change() -> None:
    assert windows(feed(SendingAgent(settings()), [1e-3] * 10))[0].reference_changes == ((0.0, 1e-3),)
    assert feed(SendingAgent(settings(reference=1e-3)), [1e-3] * 10) == []


def test_changes_inside_a_window_are_listed_and_open_none() -> None:
    agent = SendingAgent(settings(retry=Retry(50.0)))
    sent = feed(agent, [0.0] * 2 + [1.0] * 5 + [2.0] * 4 + [3.0] + [3.0] * 20)
    assert [out.sample for out in sent] == [12]
    assert windows(sent)[0].reference_changes == ((0.2, 1.0), (0.7, 2.0), (1.1, 3.0))
    assert windows(feed(agent, [4.0] * 10))[0].sequence == 1


def test_a_moving_reference_gives_windows_one_after_the_other() -> None:
    agent = SendingAgent(settings(retry=Retry(50.0)))
    sent = windows(feed(agent, [1e-3 * k for k in range(1, 41)]))
    assert [window.start for window in sent] == [0.0, 1.0, 2.0, 3.0]
    assert all(len(window.reference_changes) == 10 for window in sent)


def test_the_list_of_changes_is_bounded() -> None:
    agent = SendingAgent(settings(window_s=100.0))
    (window,) = windows(feed(agent, [float(k) for k in range(1, 1001)]))
    assert len(window.reference_changes) == MAX_CHANGES
    assert window.samples == 1000


def test_the_deadline_says_when_it_will_act() -> None:
    agent = SendingAgent(settings())
    assert agent.deadline is None
    feed(agent, [0.0] * 7 + [1e-3])
    assert agent.deadline == 17
    feed(agent, [1e-3] * 9)
    assert agent.deadline is None


def test_a_window_stays_in_the_outbox_until_the_twin_acknowledges_it() -> None:
    outbox = MemoryOutbox()
    agent = Agent(settings(), outbox)
    feed(agent, [1e-3] * 100)
    assert outbox.pending() == [("b0", 0)]
    assert agent.outlet.unacknowledged
    assert agent.receive(Acknowledge("axis-2", "b0", 0)) == agent.receive(Acknowledge("axis-1", "b0", 0)) == []
    assert outbox.pending() == [("b0", 0)]  # the session removes it, and not the agent
    assert agent.dropped == {}


def test_updates_are_applied_through_the_guard_and_answered() -> None:
    agent = SendingAgent(settings(limits=Limits(maximum=2e-4)))
    feed(agent, [1e-3] * 30)
    (good,) = agent.receive(update())
    assert good == ScheduledMessage(30, Receipt("axis-1", 1, True, 30, Reason.APPLIED, 1, "b0"))
    assert (agent.parameters.version, agent.parameters.setting.tolerance, agent.parameters.sample) == (1, 1e-4, 30)
    (bad,) = agent.receive(update(version=2, base_version=1, data_time=1.0, setting=Setting(3e-4)))
    assert bad.message == Receipt("axis-1", 2, False, 30, Reason.OUT_OF_BOUNDS, 1, "b0")
    feed(agent, [2e-3] * 10)
    assert agent.receive(update())[0].message == good.message
    assert windows(feed(agent, [3e-3] * 10))[0].parameter_version == 1


def test_a_hello_names_the_parameters_in_force() -> None:
    agent = SendingAgent(settings(parameters=Parameters(7, Setting(2e-4))))
    feed(agent, [0.0] * 5)
    assert agent.hello() == Hello("axis-1", "b0", 0.5, 10.0, 7, Setting(2e-4), "paper", PROTOCOL)


def test_an_edge_introduces_itself_again_where_it_is_asked_for_windows_of_every_boot() -> None:
    agent = SendingAgent(settings(boot="b1"))
    feed(agent, [0.0] * 5)
    assert agent.receive(Resend("axis-1")) == [ScheduledMessage(5, agent.hello())]
    assert agent.receive(Resend("axis-1", "b0", 3, 4)) == agent.receive(Resend("axis-2")) == []


def test_messages_for_others_are_ignored() -> None:
    agent = SendingAgent(settings())
    assert agent.receive(agent.hello()) == []
    assert agent.receive(update(servo="axis-2"))[0].message.applied is False  # type: ignore[union-attr]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_window_with_a_sample_that_is_not_finite_is_dropped_and_counted(bad: float) -> None:
    agent = SendingAgent(settings())
    for k in range(20):
        assert agent.absorb(1e-3, 0.0, bad if k == 4 else 0.0, 0.0) == []
    assert agent.dropped == {"sample not finite": 1}
    assert agent.windows_cut == 1
    assert windows(feed(agent, [2e-3] * 10))[0].sequence == 1


def test_a_restart_sends_the_windows_in_the_outbox() -> None:
    outbox = MemoryOutbox()
    feed(SendingAgent(settings(), outbox), [1e-3] * 10)
    agent = SendingAgent(settings(boot="b1"), outbox)
    assert windows(agent.absorb(0.0, 0.0, 0.0, 0.0))[0].identity == ("axis-1", "b0", 0)


def test_drops_of_a_full_outbox_are_counted() -> None:
    agent = SendingAgent(settings(), MemoryOutbox(2))
    feed(agent, [1e-3 * (k // 10 + 1) for k in range(50)])
    assert agent.windows_cut == 5
    assert agent.dropped == {"outbox full": 3}


def test_blocks_must_be_equally_long() -> None:
    with pytest.raises(InvalidInput, match="equally long"):
        SendingAgent(settings()).absorb_block([0.0], [0.0], [0.0, 1.0], [0.0])
    assert SendingAgent(settings()).absorb_block([], [], [], []) == []


CHUNKS = st.lists(st.integers(0, 30), max_size=12)
LEVELS = st.lists(st.tuples(st.sampled_from([0.0, 1e-3, -1e-3, math.nan]), st.integers(1, 25)), min_size=1, max_size=10)
REPLIES = st.dictionaries(st.integers(0, 11), st.integers(0, 5), max_size=4)


@given(CHUNKS, LEVELS, REPLIES, st.sampled_from([0.0, 0.3, 0.9]), st.integers(0, 99))
def test_blocks_have_the_effect_of_single_samples(
    chunks: list[int], levels: list[tuple[float, int]], replies: dict[int, int], pre_trigger_s: float, seed: int
) -> None:
    total = sum(chunks)
    reference = np.resize(np.repeat([v for v, _ in levels], [n for _, n in levels]), total)
    signals = [reference, *np.random.default_rng(seed).normal(size=(3, total))]
    both = [SendingAgent(settings(pre_trigger_s=pre_trigger_s, retry=Retry(0.75)), MemoryOutbox(3)) for _ in range(2)]
    singly, blockwise = both
    sent: tuple[list[ScheduledMessage], list[ScheduledMessage]] = ([], [])
    done = 0
    for number, count in enumerate(chunks):
        part = [signal[done : done + count] for signal in signals]
        done += count
        for sample in zip(*(values.tolist() for values in part), strict=True):
            sent[0].extend(singly.absorb(*sample))
        sent[1].extend(blockwise.absorb_block(*part))
        for agent, out in zip(both, sent, strict=True):
            if number in replies:
                out.extend(agent.receive(Acknowledge("axis-1", "b0", replies[number])))
                out.extend(agent.receive(update(version=number + 1)))
    assert sent[0] == sent[1]
    assert (singly.samples, singly.deadline, singly.dropped) == (total, blockwise.deadline, blockwise.dropped)
    assert singly.parameters == blockwise.parameters


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"servo": ""}, "servo"),
        ({"servo": "a/b"}, "servo"),
        ({"boot": "x" * 65}, "boot"),
        ({"sample_rate": 0.0}, "sample_rate"),
        ({"sample_rate": math.nan}, "sample_rate"),
        ({"window_s": 0.25}, "window_s"),
        ({"window_s": math.inf}, "window_s"),
        ({"window_s": 0.0}, "window_s = 0.0 s: must be a positive number"),
        ({"pre_trigger_s": 0.05}, "pre_trigger_s"),
        ({"pre_trigger_s": 1.0}, "pre_trigger_s"),
        ({"pre_trigger_s": -0.1}, "pre_trigger_s"),
    ],
)
def test_bad_settings_are_named(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        settings(**values)
