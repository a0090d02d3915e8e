"""The edge tells what is worth sending, in the closed loop."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from exploration import explored
from sending_agent import SendingAgent

import servotwin as st
from benchmarks.novelty.command import QUICK, charted, saved
from benchmarks.novelty.loops import LoopCase, account, summary
from benchmarks.novelty.windows import CONDITIONS
from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.edge.agent import ScheduledMessage
from servotwin.edge.outlet import FILTERED
from servotwin.edge.settings import AgentSettings
from servotwin.errors import InvalidInput
from servotwin.messages import WindowMessage
from servotwin.novelty.detector import CUSUM, FIRST, LOST_MOTION, PERIODIC, SCORE
from servotwin.novelty.score import model_of
from servotwin.novelty.settings import NoveltyRules, NoveltySettings
from servotwin.plant.servo import Servo

GAP = math.radians(10.0)


@cache
def looped(name: str, growth_deg: float, duration: float, rules: NoveltyRules | None) -> Loop:
    packaged = Scenario.preset(name)
    gap = st.SCurve(GAP, GAP + math.radians(growth_deg), duration=duration) if growth_deg else GAP
    recording = replace(packaged.recording, novelty=rules)
    return cosimulate(packaged.replace(duration=duration, gap=gap, recording=recording))


@pytest.mark.slow
def test_without_wear_next_to_nothing_is_sent() -> None:
    loop = looped("fig15", 0.0, 200.0, NoveltyRules())
    assert Counter(window.reason for window in loop.windows) == {FIRST: 1}
    assert loop.accounts == {"delivered": 1, FILTERED: 9}
    every = looped("fig15", 0.0, 200.0, None)
    assert len(every.windows) == 10
    assert {window.reason for window in every.windows} == {"reference"}


def test_one_is_sent_every_period() -> None:
    loop = looped("fig15", 0.0, 200.0, NoveltyRules(period_s=60.0))
    assert [window.reason for window in loop.windows] == [FIRST, PERIODIC, PERIODIC, PERIODIC]


@pytest.mark.slow
def test_fast_wear_has_every_window_sent_and_the_same_estimates() -> None:
    every, news = (looped("fig15", 10.0, 200.0, rules) for rules in (None, NoveltyRules()))
    assert {window.reason for window in news.windows[1:]} <= {LOST_MOTION, SCORE, CUSUM}
    assert [e.gap for e in news.estimates] == [e.gap for e in every.estimates]
    assert len(news.applied) == len(every.applied) == 10


@pytest.mark.slow
@pytest.mark.parametrize("name", explored(["fig15", "fig16"], 0))
def test_what_is_sent_keeps_the_twin_right(name: str) -> None:
    rules = NoveltyRules(worth=math.radians(0.5))
    every, news = (looped(name, 2.5, 200.0, each) for each in (None, rules))
    assert len(news.windows) <= 7 < len(every.windows) == 10
    few, all_of_them = summary(news), summary(every)
    assert few.held < all_of_them.held + math.radians(0.4)
    assert few.error < 1.02 * all_of_them.error


@pytest.mark.slow
def test_the_trend_is_right_on_fewer_windows() -> None:
    loop = looped("calm", 2.5, 200.0, NoveltyRules(worth=math.radians(0.5)))
    assert len(loop.windows) <= 7
    assert all(estimate.ok for estimate in loop.estimates)
    for estimate, trend in zip(loop.estimates, loop.trends, strict=True):
        truth = float(np.interp(estimate.time, loop.run.time, loop.run.gap))
        assert trend is not None
        assert math.degrees(abs(trend.gap - truth)) < 0.05


def test_a_scenario_says_it_in_toml(tmp_path: Path) -> None:
    text = """
        servo = "paper"
        duration_s = 60.0
        [reference]
        kind = "square"
        amplitude_mm = 1.0
        period_s = 40.0
        [gap]
        total_deg = 10.0
        [twin]
        policy = "paper"
        k_dz = 1.0
        [novelty]
        worth_deg = 0.2
        period_s = 300.0
        look_s = inf
    """
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    scenario = Scenario.load(path)
    assert scenario.recording.novelty == NoveltyRules(worth=math.radians(0.2), period_s=300.0, look_s=math.inf)
    novelty = scenario.agent_settings().window_filter
    assert isinstance(novelty, NoveltySettings)
    assert novelty.model == model_of(scenario.servo, 5000.0)
    path.write_text(text.replace("worth_deg", "worthy_deg"))
    with pytest.raises(InvalidInput, match=r"novelty\.worthy_deg.*did you mean 'worth_deg'"):
        Scenario.load(path)


def agent(rules: NoveltyRules | None, rate: float = 500.0) -> SendingAgent:
    novelty = None if rules is None else NoveltySettings(model_of(Servo.preset("paper"), rate), rules)
    return SendingAgent(AgentSettings("axis", "b0", rate, window_filter=novelty))


@pytest.mark.parametrize("block", [1, 7, 1000, 5000])
def test_a_window_is_cut_and_judged_though_the_reference_never_changes(block: int) -> None:
    rules, count = NoveltyRules(look_s=2.0, period_s=5.0, patience=2), 5000
    edge, sent = agent(rules), list[ScheduledMessage]()
    for first in range(0, count, block):
        zeros = [0.0] * min(block, count - first)
        sent += edge.absorb_block(zeros, zeros, zeros, zeros)
    windows = [(each.sample, each.message.reason) for each in sent if isinstance(each.message, WindowMessage)]
    assert [w for w in windows if w[0] <= 2000] == [(1000, FIRST), (2000, FIRST)]
    assert [reason for _, reason in windows if reason == PERIODIC]
    assert edge.dropped[FILTERED] == edge.windows_cut - len({(w.sequence) for w in messages(sent)})


def messages(sent: list[ScheduledMessage]) -> list[WindowMessage]:
    return [each.message for each in sent if isinstance(each.message, WindowMessage)]


def test_without_novelty_time_cuts_nothing() -> None:
    zeros = [0.0] * 5000
    assert agent(None).absorb_block(zeros, zeros, zeros, zeros) == []
    assert agent(None).deadline is None


def test_a_model_for_another_rate_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"500\.0 Hz for samples at 1000\.0 Hz"):
        AgentSettings("axis", "b0", 1000.0, window_filter=NoveltySettings(model_of(Servo.preset("paper"), 500.0)))


@pytest.mark.slow
def test_the_bench_measures_and_writes_its_figures() -> None:
    tiny = replace(QUICK, quiet=40, changed=20, drawn=2000, trials=5)
    figures = {figure.name: figure.value for figure in charted(CONDITIONS[2], tiny)}
    assert figures["1 um: windows that say nothing, share"] == 0.0
    assert figures["1 um: scatter of the score, deg"] < 0.01
    assert figures["1 um: 0.5 deg: seen after, windows (median)"] == 1.0
    case = LoopCase("fig15", 60.0, False, NoveltyRules())
    found = account(case)
    assert (found.windows, found.sent, found.updates) == (3, 1, 1)
    assert saved([(case, "news", found)]).row_count == 1
