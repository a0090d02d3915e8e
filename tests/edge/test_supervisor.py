"""The agent under supervision: evidence, silence, restarts; the same decisions in blocks as one by one."""

import math
from array import array
from pathlib import Path

import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from sending_agent import SendingAgent

from servotwin.control import Controller
from servotwin.control.gains import gains_of
from servotwin.edge.agent import ScheduledMessage
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge.store import FileParameterStore
from servotwin.edge.watch import WatchSettings
from servotwin.errors import InvalidInput
from servotwin.link.outbox import MemoryOutbox
from servotwin.messages import Acknowledge, Band, Cause, Fallback, Reason, Receipt, Setting, Update, WindowMessage

RATE = 200.0
PAPER = Controller(Kp=1377.7, Ki=18907.6, Kd=-135.1, Tf=0.1, sample_rate=RATE)
CALM = replace(gains_of(PAPER), Ki=0.0)
BAND = Band(1e-4, 6e-5, 0.2, 1.0)


def agent_settings(silence_s: float = math.inf, patience_s: float = 0.0, **supervision: object) -> AgentSettings:
    fallback = FallbackSet(Setting(0.0, CALM, Band(5e-4, 2e-4, 1.0, 1.0)), silence_s, refuse_s=4.0)
    return AgentSettings(
        "axis-1", "b0", RATE, 1.0, controller=PAPER, limits=Limits(patience_s=patience_s),
        supervision=Supervision(**{"fallback": fallback, **supervision}),
    )  # fmt: skip


def update(version: int, base: int, data_time: float, tolerance: float = 1e-4) -> Update:
    known = (None, None, (None, None))
    return Update(
        "axis-1", version, base, ("b0", version), data_time, *known, "OK", Setting(tolerance, CALM, BAND), 1e6
    )


def feed(agent: SendingAgent, seconds: float, amplitude: float = 0.0, frequency: float = 1.5) -> list[ScheduledMessage]:
    """Samples of a loop whose error swings, its reference 1 mm."""
    count = round(seconds * RATE)
    times = [(agent.samples + k) / RATE for k in range(count)]
    position = [1e-3 - amplitude * math.sin(2.0 * math.pi * frequency * t) for t in times]
    rest = array("d", bytes(8 * count))
    return agent.absorb_block([1e-3] * count, rest, position, rest)


def fallbacks(sent: list[ScheduledMessage]) -> list[Fallback]:
    return [out.message for out in sent if isinstance(out.message, Fallback)]


def test_a_limit_cycle_under_an_update_ends_in_the_fallback_set() -> None:
    agent = SendingAgent(agent_settings())
    feed(agent, 3.0)
    agent.receive(update(1, 0, 1.0))
    sent = feed(agent, 10.0, amplitude=9e-5)
    (fallback,) = fallbacks(sent)
    assert fallback.cause is Cause.LIMIT_CYCLE
    assert (fallback.replaced, fallback.parameter_version, fallback.setting.gains) == (1, 2, CALM)
    assert 4.0 < fallback.sample / RATE < 8.0
    assert agent.parameters.fallback
    assert agent.parameters.sample == fallback.sample
    assert agent.controller == PAPER.replace(Ki=0.0)


@pytest.mark.parametrize("fallback", [None, FallbackSet(Setting(0.0))])
def test_an_edge_that_was_superseded_drops_the_update_that_waits(fallback: FallbackSet | None) -> None:
    agent = SendingAgent(agent_settings(patience_s=2.0, fallback=fallback))
    feed(agent, 2.0)
    agent.absorb_block(*([value] * 200 for value in (1e-3, 0.0, 0.95e-3, 0.0)))  # between the two dead zones
    assert agent.receive(update(1, 0, 1.0)) == []
    receipt, *rest = (out.message for out in agent.superseded())
    assert isinstance(receipt, Receipt)
    assert (receipt.version, receipt.reason) == (1, Reason.TAKEN_OVER if fallback is None else Reason.FELL_BACK)
    assert len(rest) == (fallback is not None)
    # One that was on its way already, and would be applied otherwise.
    [late] = (out.message for out in agent.receive(update(7, agent.parameters.version, agent.time)))
    assert isinstance(late, Receipt)
    assert (late.version, late.reason) == (7, Reason.TAKEN_OVER)
    feed(agent, 5.0)
    assert agent.parameters.version == (0 if fallback is None else 2)


def test_a_calm_loop_is_left_alone() -> None:
    agent = SendingAgent(agent_settings())
    feed(agent, 3.0)
    agent.receive(update(1, 0, 1.0))
    assert not fallbacks(feed(agent, 30.0, amplitude=4e-5))
    assert agent.parameters.version == 1


def test_without_a_fallback_set_nothing_is_watched() -> None:
    agent = SendingAgent(agent_settings(fallback=None))
    assert not fallbacks(feed(agent, 20.0, amplitude=9e-4))
    assert agent.deadline is None


def test_after_a_fallback_a_good_update_counts_again() -> None:
    agent = SendingAgent(agent_settings())
    fallback = fallbacks(feed(agent, 20.0, amplitude=4e-4))[0]
    late = update(5, fallback.parameter_version, agent.time - 0.5)
    (answer,) = agent.receive(late)
    assert isinstance(answer.message, Receipt)
    assert answer.message.reason is Reason.APPLIED
    assert not agent.parameters.fallback
    assert fallbacks(feed(agent, 10.0, amplitude=3e-4))


@pytest.mark.parametrize("answers", [True, False])
def test_a_silent_twin_is_tolerated_for_a_while(answers: bool) -> None:
    agent = SendingAgent(agent_settings(silence_s=6.0, watch=None))
    sent = feed(agent, 2.0)
    (window,) = [out.message for out in sent if isinstance(out.message, WindowMessage)]
    if answers:
        agent.receive(Acknowledge("axis-1", "b0", window.sequence))
    found = fallbacks(feed(agent, 20.0))
    assert bool(found) is not answers
    if found:
        assert (found[0].cause, found[0].sample / RATE) == (Cause.SILENCE, 7.0)  # the window was complete at 1 s
        assert found[0].measured == pytest.approx(6.0)


def test_a_twin_without_a_window_to_answer_is_not_silent() -> None:
    agent = SendingAgent(agent_settings(silence_s=2.0))
    agent.absorb_block(*[array("d", bytes(8 * 4000))] * 4)
    assert agent.parameters.version == 0


def test_only_parameters_under_which_the_loop_kept_its_band_are_stored(tmp_path: Path) -> None:
    store = FileParameterStore(tmp_path / "kept.json")
    agent = SendingAgent(agent_settings(), store=store)
    agent.receive(update(1, 0, 0.0))
    feed(agent, 2.9)
    assert store.load() is None
    feed(agent, 0.2)  # 1 s of settling and a window of 2 s
    kept = store.load()
    assert kept is not None
    assert (kept.version, kept.setting.gains, kept.data_time, kept.window) == (1, CALM, -math.inf, None)
    agent.receive(update(2, 1, 1.0, 2e-4))
    assert SendingAgent(agent_settings(), store=store).parameters.setting.tolerance == 1e-4
    feed(agent, 10.0, amplitude=9e-4)
    again = SendingAgent(agent_settings(), store=store)
    assert again.parameters.fallback
    assert again.parameters.version == agent.parameters.version == 3


def test_windows_of_an_earlier_boot_wait_for_an_answer_too() -> None:
    outbox = MemoryOutbox()
    feed(SendingAgent(agent_settings(), outbox), 2.0)
    assert outbox.pending() == [("b0", 0)]
    agent = SendingAgent(agent_settings(silence_s=3.0, watch=None), outbox)
    agent.absorb_block(*[array("d", bytes(8 * 1000))] * 4)
    assert agent.parameters.sample == 600


STEPS = st.lists(st.tuples(st.integers(1, 400), st.sampled_from([0.0, 2e-5, 1.5e-4, 9e-4]), st.booleans()), max_size=12)


@pytest.mark.slow
@examples(40)
@given(steps=STEPS)
def test_blocks_and_single_samples_decide_the_same(steps: list[tuple[int, float, bool]]) -> None:
    agents = [SendingAgent(agent_settings(3.0, 0.5)) for _ in range(2)]
    sent: list[list[ScheduledMessage]] = [[], []]
    version = 0
    for samples, amplitude, offered in steps:
        times = [(agents[0].samples + k) / RATE for k in range(samples)]
        position = [1e-3 - amplitude * math.sin(9.0 * t) for t in times]
        rest = [0.1] * samples
        sent[0] += agents[0].absorb_block([1e-3] * samples, rest, position, rest)
        for y in position:
            sent[1] += agents[1].absorb(1e-3, 0.1, y, 0.1)
        if offered:
            version = max(version, agents[0].parameters.version) + 1
            message = update(version, agents[0].parameters.version, agents[0].time - 0.01, 1.2e-4)
            for agent, out in zip(agents, sent, strict=True):
                out += agent.receive(message)
    assert sent[0] == sent[1]
    assert agents[0].parameters == agents[1].parameters


def test_a_fallback_with_gains_needs_a_controller() -> None:
    with pytest.raises(InvalidInput, match="needs a controller"):
        AgentSettings("axis-1", "b0", RATE, supervision=Supervision(FallbackSet(Setting(0.0, CALM))))


def test_the_period_is_whole_slots() -> None:
    assert Supervision(period_s=0.05).period_samples(5000.0) == 250
    assert Supervision(watch=WatchSettings(slot_s=0.03), period_s=0.05).period_samples(1000.0) == 60
    assert Supervision(watch=None, period_s=1e-9).period_samples(1000.0) == 1
    with pytest.raises(InvalidInput, match="period_s"):
        Supervision(period_s=0.0)


def test_a_prediction_does_not_excuse_an_error_outside_the_certified_band() -> None:
    agent = SendingAgent(agent_settings())
    generous = replace(update(1, 0, 0.0), setting=Setting(1e-4, CALM, Band(1.0, 1.0, 5.0, 1e6)))
    agent.receive(generous)
    (fallback,) = fallbacks(feed(agent, 10.0, amplitude=3.3e-4, frequency=0.9))
    assert fallback.cause is Cause.LIMIT_CYCLE
    assert fallback.allowed == pytest.approx(math.sqrt(2.0) * 2e-4)
