"""The twin sends the learnt structure to the edge, and the edge judges its windows on it from then on."""

from __future__ import annotations

import math
from array import array
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from edge_process_parts import CONFIG, LAW, LinkEnd, exchange_all
from twin_messages import message_of

import servotwin as st
from benchmarks.novelty.command import FALSE_ALARMS, QUICK, charted
from benchmarks.novelty.windows import NoveltyCondition
from servotwin.cosim.driver import Cosimulation
from servotwin.cosim.machine import SimulatedMachine, simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.agent import Agent
from servotwin.edge.outlet import FILTERED
from servotwin.edge.recorder import Cut
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process import frames
from servotwin.edge_process.frame_handler import FrameHandler
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.estimation.estimate import GapEstimate, GapStatus, MachineReading
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.estimation.window import Window
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.messages import LearntResponse, WindowMessage, decode
from servotwin.novelty.detector import FIRST, SCORE, NoveltyDetector, booted, dumps, judge, loads
from servotwin.novelty.score import model_of
from servotwin.novelty.settings import NoveltyRules, NoveltySettings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.twin.estimating import DecodedWindow
from servotwin.twin.evidence_rows import rows
from servotwin.twin.model import TwinModel
from servotwin.twin.responses import Responses, ResponseState
from servotwin.twin.twin import Twin

DEG, RATE = math.pi / 180.0, 5000.0
SERVO = Servo.preset("paper")
GAP = 10.0 * DEG
OFF_BY = ((1.05, 1.3, 1.01, 1.0), (0.95, 0.7, 0.99, 1.0))
"""Factors on stiffness, damping, pitch and mass ratio."""
SETTINGS = NoveltySettings(model_of(SERVO, RATE), NoveltyRules(), GAP)


# --- the closed loop


@cache
def looped(factors: tuple[float, ...], learn: bool, novelty: bool = True) -> tuple[Cosimulation, st.Loop]:
    """The calm loop of a machine that is off, whose gap grows by 0.3 deg at 160 s."""
    packaged = Scenario.preset("calm")
    gap = st.PiecewiseCubic.zero_order_hold([0.0, 160.0], [GAP, GAP + 0.3 * DEG])
    scenario = packaged.replace(
        duration=240.0,
        gap=gap,
        recording=replace(packaged.recording, novelty=NoveltyRules() if novelty else None),
        twin=packaged.twin.replace(learning=LearningSettings(learn=learn)),
    )
    plant = simulation_of(scenario, adapted(SERVO, np.log(factors)))
    loop = Cosimulation(scenario, SimulatedMachine(scenario, plant))
    while not loop.done:
        loop.advance()
    return loop, loop.loop(plant.run())


@pytest.mark.slow
@pytest.mark.parametrize("factors", OFF_BY)
def test_an_edge_whose_machine_is_off_sends_the_first_window_and_the_change(factors: tuple[float, ...]) -> None:
    loop, result = looped(factors, learn=True)
    assert [(round(one.start), one.reason) for one in result.windows] == [(0, FIRST), (160, SCORE)]
    assert [one.response_version for one in result.windows] == [0, 1]
    # The second window may have halved what is open of the machine.
    assert [one.version for one in loop.store.responses] in ([1], [1, 2])
    assert loop.store.responses[0].gap_std < 0.03 * DEG
    assert all(
        abs(e.gap - truth) < 0.05 * DEG for e, truth in zip(result.estimates, (GAP, GAP + 0.3 * DEG), strict=True)
    )


@pytest.mark.slow
def test_without_learning_no_response_is_sent() -> None:
    loop, result = looped(OFF_BY[0], learn=False)
    assert not loop.store.responses
    assert {one.response_version for one in result.windows} == {0}
    assert not any(estimate.ok for estimate in result.estimates)


@pytest.mark.slow
def test_an_edge_without_a_filter_is_sent_none() -> None:
    loop, result = looped(OFF_BY[0], learn=True, novelty=False)
    assert not loop.store.responses
    assert {one.response_version for one in result.windows} == {None}
    assert result.accounts[FILTERED] == 0


def test_the_twin_repeats_itself_bit_for_bit() -> None:
    loop, result = looped(OFF_BY[0], learn=True)
    scenario = loop.scenario
    model = TwinModel.of(scenario.model, scenario.twin, loop.twin.model.start)
    again, arrivals = Twin(scenario.name, model), [m for m in result.messages if m.direction == "up" and m.arrival]
    for message in arrivals:
        again.receive(decode(message.data), message.arrival)
        again.restore(again.state())
    assert again.state() == loop.twin.state()
    assert again.log.responses == loop.store.responses
    (row,) = rows(again.log.responses, 1, "c")
    assert (row.kind, row.context) == ("response", "c")
    assert decode(row.body) == loop.store.responses[0]


# --- the twin's part


def window_of(factors: tuple[float, ...] = OFF_BY[0]) -> Window:
    run = simulate(
        adapted(SERVO, np.log(factors)),
        7.0,
        controller=SERVO.controller,
        reference=SquareWave(1e-3, 10.0),
        gap=GAP,
        tolerance=SERVO.tolerance_for(GAP),
    )
    return Window.from_run(run, 5.0, 1.0)


def after(
    state: ResponseState, used: int | None, now: float, factors: tuple[float, ...] = OFF_BY[0], spread: float = 1.0,
    counts: bool = True,
) -> tuple[ResponseState, LearntResponse | None]:  # fmt: skip
    """After a window that names the response `used`; `spread` times usual standard deviations are open."""
    window = window_of()
    message = msgspec.structs.replace(message_of(window), response_version=used)
    machine = FactorPrior(np.log(factors), np.diag(np.square(spread * np.array([2e-4, 1e-3, 1e-4, 1e-4]))))
    reading = MachineReading(machine.reading.factors, machine.reading.covariance)
    estimate = GapEstimate(GAP, 1e-4, 1e-4, (GAP, GAP), GapStatus.OK, 5.5, machine=reading)
    part = Responses(SERVO, 5.0)
    return part.after(state, DecodedWindow(message, window), now, estimate if counts else None, machine)


def test_a_response_is_that_of_the_learnt_machine() -> None:
    state, sent = after(ResponseState(), 0, 100.0)
    assert sent is not None
    made = model_of(adapted(SERVO, np.log(OFF_BY[0])), RATE)
    assert [complex(*mode[:2]) for mode in sent.modes] == [mode.decay for mode in made.modes]
    assert [complex(*mode[2:]) for mode in sent.modes] == [mode.gain for mode in made.modes]
    assert (sent.direct, sent.static_gain, sent.unseen) == (made.direct, made.static_gain, made.unseen)
    assert (sent.version, sent.rate, sent.gap, sent.gap_std) == (1, RATE, GAP, state.gap_std)


def test_a_response_is_repeated_until_a_window_names_it() -> None:
    state, first = after(ResponseState(), 0, 100.0)
    waiting, none = after(state, 0, 104.0, counts=False)
    assert none is None
    again, second = after(waiting, 0, 106.0, counts=False)
    assert second == first
    assert after(again, 1, 200.0)[1] is None
    assert after(state, 0, 50.0, counts=False)[1] == first  # the clock was set back


def test_another_one_is_sent_where_the_machine_is_better_known_or_has_moved() -> None:
    state, _ = after(ResponseState(), 0, 100.0, spread=10.0)
    assert after(state, 1, 200.0, spread=6.0)[1] is None
    better = after(state, 1, 200.0, spread=4.0)[1]
    moved = after(state, 1, 200.0, (1.06, 1.3, 1.01, 1.0), spread=10.0)[1]
    assert better is not None
    assert moved is not None
    assert better.version == moved.version == 2


def test_a_twin_that_lost_its_state_counts_on_from_the_edge() -> None:
    sent = after(ResponseState(), 7, 100.0)[1]
    assert sent is not None
    assert sent.version == 8
    assert after(ResponseState(), None, 100.0) == (ResponseState(), None)
    assert after(ResponseState(), 0, 100.0, counts=False) == (ResponseState(), None)


# --- the edge's part


def cut_of(window: Window, sequence: int) -> Cut:
    assert window.theta_m is not None
    noise = 1e-6 * np.random.default_rng(sequence).standard_normal(window.position.size)
    still = np.zeros(window.position.size)
    channels = {"theta_m": window.theta_m, "position": window.position + noise, "reference": still, "voltage": still}
    signals = {name: array("d", values) for name, values in channels.items()}
    return Cut(round(sequence * 20.0 * RATE), sequence, "reference", 0, 0.0, signals)


def learnt(version: int = 1) -> LearntResponse:
    sent = after(ResponseState(version=version - 1), version - 1, 100.0, spread=1.0)[1]
    assert sent is not None
    return msgspec.structs.replace(sent, version=version)


def test_a_filter_judges_on_the_newest_response_for_its_rate() -> None:
    novelty = NoveltyDetector(SETTINGS)
    window = window_of()
    novelty(cut_of(window, 0))
    assert novelty.verdict is not None
    assert novelty.verdict.score is not None
    assert abs(novelty.verdict.score.gap - GAP) > 0.5 * DEG
    novelty.adopt(learnt(2))
    for ignored in (learnt(1), msgspec.structs.replace(learnt(3), rate=1000.0)):
        before = novelty.state
        novelty.adopt(ignored)
        assert novelty.state == before
    assert novelty.response_version == 2
    novelty(cut_of(window, 1))
    assert novelty.verdict.score is not None
    assert abs(novelty.verdict.score.gap - GAP) < 0.02 * DEG
    assert novelty.verdict.reason == FIRST
    variance = novelty.state.chart.last[-1].variance
    assert variance > learnt().gap_std ** 2 + SETTINGS.rules.resolution**2


def test_a_response_outlives_boots_and_judging_is_the_same_again() -> None:
    novelty = NoveltyDetector(SETTINGS)
    novelty.adopt(learnt(2))
    assert booted(loads(novelty.dumps()), SETTINGS.rules).response == learnt(2)
    window, state = window_of(), novelty.state
    for k in range(3):
        novelty(cut_of(window, k))
        state, _ = judge(loads(dumps(state)), cut_of(window, k), SETTINGS)
        assert dumps(state) == novelty.dumps()


def test_an_agent_without_a_filter_ignores_a_response() -> None:
    agent = Agent(AgentSettings("axis", "b0", 500.0))
    assert agent.receive(learnt()) == []
    filtered = AgentSettings("axis", "b0", RATE, window_filter=SETTINGS)
    other = Agent(filtered)
    assert other.receive(msgspec.structs.replace(learnt(), servo="another")) == []
    assert other.receive(learnt()) == []


def test_a_response_crosses_to_the_link_process_and_is_used_once(tmp_path: Path) -> None:
    far, box = LinkEnd(), PipeOutlet(True)
    box.boot = "b1"
    box.connect(far.near)
    box.adopt(learnt(2))
    exchange_all(box)
    (frame,) = far.received()
    assert isinstance(frame, frames.ResponseFrame)
    assert not box.idle
    agent = replace(CONFIG.agent, sample_rate=RATE, window_filter=SETTINGS)
    outbox = SqliteOutbox(tmp_path / "outbox.sqlite", "axis-1")
    law = LAW.replace(sample_rate=RATE)
    handler = FrameHandler(replace(CONFIG, agent=agent, controller=law, folder=tmp_path), outbox)
    for serial in (1, 2):
        assert handler.handle(msgspec.structs.replace(frame, serial=serial)) == [serial]
    handler.handle(frames.window_frame(cut_of(window_of(), 0), "b1", 3))
    message = outbox.get(("b1", 0))
    assert isinstance(message, WindowMessage)
    assert message.response_version == 2
    assert not handler.faults
    outbox.close()
    far.close()


# --- the error rates


@pytest.mark.slow
@pytest.mark.exploration
def test_a_machine_that_was_learnt_shows_a_tenth_of_a_degree_in_one_window() -> None:
    tiny = replace(QUICK, quiet=200, changed=60, drawn=20_000, trials=20)
    off = NoveltyCondition("off", None, 1.05, 1.3, 1.01)
    powers, lengths = list[float](), list[float]()
    for condition in (off, replace(off, name="learnt", learnt=3)):
        figures = {figure.name.split(": ", 1)[1]: figure.value for figure in charted(condition, tiny)}
        powers.append(figures["0.1 deg in one window, one false alarm in 120: power"])
        lengths.append(figures["windows per false alarm"])
    assert FALSE_ALARMS == 1.0 / 120.0
    assert powers[0] < 0.1
    assert powers[1] > 0.95
    assert lengths[1] >= 1000.0
