"""Which cut windows are sent, and why; what is kept; what TOML says of it."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
from array import array
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from scaling import Units, scaled

from benchmarks.estimator_windows import WindowCase, paper_loop_cases
from servotwin.config.table import parse_toml
from servotwin.config.toml import read, values_of
from servotwin.edge.recorder import Cut
from servotwin.errors import InvalidInput
from servotwin.novelty.detector import (
    CUSUM,
    FIRST,
    LOST_MOTION,
    PERIODIC,
    PROBE,
    SCORE,
    NoveltyDetector,
    NoveltyState,
    booted,
    dumps,
    judge,
    loads,
    start,
)
from servotwin.novelty.score import model_of
from servotwin.novelty.settings import NoveltyRules, NoveltySettings, model_table
from servotwin.plant.servo import Servo

RATE = 5000.0
MODEL = model_of(Servo.preset("paper"), RATE)
SETTINGS = NoveltySettings(MODEL, NoveltyRules(), math.radians(10.0))


@cache
def cases(gap_deg: float) -> tuple[WindowCase, ...]:
    return tuple(paper_loop_cases(np.radians([gap_deg]), 4, 1, None))


def cut(sequence: int, gap_deg: float = 10.0, reason: str = "reference", every_s: float = 20.0) -> Cut:
    """A window after a step, with 1 um of noise."""
    window = cases(gap_deg)[sequence % 4].window
    assert window.theta_m is not None
    noise = 1e-6 * np.random.default_rng(sequence).standard_normal(window.position.size)
    return made(window.theta_m, window.position + noise, sequence, reason, every_s)


def updated(each: Cut, version: int, gap_deg: float, basis: int) -> Cut:
    """Cut under an update."""
    return each._replace(parameter_version=version, gap=math.radians(gap_deg), basis=basis)


def told(each: Cut, basis: int) -> Cut:
    """Cut under an update to 10 deg that stands on a window."""
    return updated(each, 1 + basis, 10.0, basis)


def quiet(sequence: int) -> Cut:
    noise = 1e-6 * np.random.default_rng(sequence).standard_normal(5000)
    return made(np.zeros(5000), noise, sequence)


def made(
    theta_m: np.ndarray, position: np.ndarray, sequence: int, reason: str = "reference", every_s: float = 20.0
) -> Cut:
    channels = {"theta_m": theta_m, "position": position, "reference": 0.0 * position, "voltage": 0.0 * position}
    signals = {name: array("d", values) for name, values in channels.items()}
    return Cut(round(sequence * every_s * RATE), sequence, reason, 0, 0.0, signals)


def reasons(novelty: NoveltyDetector, cuts: list[Cut]) -> list[str]:
    sent = [novelty(each) for each in cuts]
    return ["" if each is None else each.reason for each in sent]


def test_the_first_are_sent_then_none_until_the_gap_changes() -> None:
    novelty = NoveltyDetector(SETTINGS)
    found = reasons(novelty, [cut(0), cut(1), *(told(cut(k), 1) for k in range(2, 8)), told(cut(8, 10.5), 1)])
    assert found == [FIRST, FIRST, *[""] * 6, SCORE]
    assert reasons(novelty, [told(cut(k, 10.5), 8) for k in range(9, 14)]) == [""] * 5


def test_what_no_update_answers_is_sent_again_ever_more_rarely() -> None:
    """The twin may have rejected the windows: without an update it does not know the gap."""
    novelty = NoveltyDetector(SETTINGS)
    found = reasons(novelty, [cut(k) for k in range(20)])
    assert [k for k, reason in enumerate(found) if reason] == [0, 1, 3, 4, 7, 8, 15, 16]
    assert set(found) == {FIRST, ""}


def test_news_that_no_update_answers_is_sent_again_ever_more_rarely() -> None:
    novelty = NoveltyDetector(SETTINGS)
    reasons(novelty, [cut(0), *(told(cut(k), 0) for k in range(1, 4))])
    found = reasons(novelty, [told(cut(k, 10.5), 0) for k in range(4, 16)])
    assert [k for k, reason in enumerate(found) if reason] == [0, 2, 3, 6, 7]
    assert found[0] == SCORE


def test_an_update_from_before_the_news_does_not_answer_it() -> None:
    novelty = NoveltyDetector(SETTINGS)
    reasons(novelty, [cut(0), *(told(cut(k), 0) for k in range(1, 4))])
    found = reasons(novelty, [told(cut(4, 10.5), 0), *(told(cut(k, 10.5), 3) for k in range(5, 8))])
    assert found == [SCORE, "", FIRST, FIRST]


def test_after_a_restart_only_unanswered_news_is_sent_again() -> None:
    answered = NoveltyDetector(SETTINGS)
    reasons(answered, [cut(0), *(told(cut(k), 0) for k in range(1, 4))])
    unanswered = NoveltyDetector(SETTINGS, answered.state)
    assert reasons(unanswered, [told(cut(k), 0) for k in range(12)]) == [FIRST, FIRST, *[""] * 10]
    reasons(answered, [told(cut(4, 10.5), 0)])
    again = NoveltyDetector(SETTINGS, answered.state)
    assert reasons(again, [told(cut(k, 10.5), 0) for k in range(6)]) == [FIRST, FIRST, "", FIRST, FIRST, ""]


@pytest.mark.parametrize("units", [Units(time=2.0**-10), Units(time=1e3, length=1e-6, voltage=1e2)])
def test_a_machine_in_other_units_sends_the_same_windows(units: Units) -> None:
    """The periods are in wall-clock time, which the settings state."""
    model = model_of(scaled(Servo.preset("paper"), *units), RATE / units.time)
    rules = replace(SETTINGS.rules, period_s=units.time * SETTINGS.rules.period_s)
    there = NoveltySettings(model, rules, SETTINGS.gap)
    cuts = [*(cut(k) for k in range(4)), *(cut(k, 10.5) for k in range(4, 6)), *(cut(k, 12.5) for k in range(6, 9))]
    scaled_cuts = []
    for each in cuts:
        position = array("d", [units.length * value for value in each.signals["position"]])
        scaled_cuts.append(each._replace(signals={**each.signals, "position": position}))
    found = reasons(NoveltyDetector(there), scaled_cuts)
    assert found == reasons(NoveltyDetector(SETTINGS), cuts)
    assert SCORE in found


def test_what_may_be_an_outlier_to_the_twin_is_sent_twice() -> None:
    cuts = [cut(0), *(told(cut(k), 0) for k in range(1, 4)), *(told(cut(k, 12.0), 0) for k in range(4, 7))]
    assert reasons(NoveltyDetector(SETTINGS), cuts) == [FIRST, "", "", "", SCORE, FIRST, ""]


def test_an_accepted_update_ends_the_unconditional_windows_and_keeps_the_news_out() -> None:
    novelty = NoveltyDetector(SETTINGS)
    assert reasons(novelty, [cut(0)]) == [FIRST]
    assert reasons(novelty, [updated(cut(k), 1, 10.0, 0) for k in range(1, 6)]) == [""] * 5
    assert reasons(novelty, [updated(cut(6, 12.0), 1, 10.0, 0)]) == [SCORE]
    assert reasons(novelty, [updated(cut(k, 12.0), 2, 12.0, 6) for k in range(7, 12)]) == [""] * 5
    assert novelty.state.update_gap == math.radians(12.0)


def test_an_update_from_a_window_without_a_score_moves_the_baseline() -> None:
    novelty = NoveltyDetector(SETTINGS)
    reasons(novelty, [updated(cut(k), 1, 10.0, 1) for k in range(5)])
    assert reasons(novelty, [updated(cut(k, 12.0), 2, 12.0, 99) for k in range(5, 9)]) == [""] * 4


def test_slow_wear_is_news_by_its_sum() -> None:
    novelty = NoveltyDetector(SETTINGS)
    gaps = [*[10.0] * 8, *(10.0 + 0.01 * k for k in range(1, 8))]
    found = reasons(novelty, [told(cut(k, gap), 0) for k, gap in enumerate(gaps)])
    assert found[:8] == [""] * 8
    assert CUSUM in found[8:]


def test_a_window_without_motion_moves_nothing() -> None:
    state = start(SETTINGS)
    for number in range(6):
        state, _ = judge(state, told(cut(number), 0), SETTINGS)
    after, verdict = judge(state, told(quiet(6), 0), SETTINGS)
    assert (verdict.reason, verdict.score, after.chart) == ("", None, state.chart)
    assert after.uninformative == 1


def test_windows_that_say_nothing_are_sent_a_few_times_at_first() -> None:
    found = reasons(NoveltyDetector(SETTINGS), [quiet(number) for number in range(8)])
    assert found == [FIRST] * 4 + [""] * 4


def test_one_is_sent_every_period_and_a_probe_always() -> None:
    rules = NoveltyRules(period_s=100.0)
    novelty = NoveltyDetector(replace(SETTINGS, rules=rules))
    cuts = [cut(k, reason=PROBE if k == 3 else "reference") for k in range(16)]
    found = reasons(novelty, [*cuts[:2], *(told(each, 1) for each in cuts[2:])])
    assert found == [FIRST, FIRST, "", PROBE, *[""] * 4, PERIODIC, *[""] * 4, PERIODIC, "", ""]


def test_lost_motion_beyond_the_gap_is_news() -> None:
    settings = replace(SETTINGS, gap=0.0)
    angle = np.concatenate([np.zeros(2500), np.full(2500, math.radians(3.0))])
    novelty = NoveltyDetector(settings)
    found = reasons(novelty, [made(angle, np.zeros(5000), number) for number in range(3)])
    assert found[0] == LOST_MOTION
    assert novelty.verdict is not None
    assert math.degrees(novelty.verdict.lost_motion) == pytest.approx(3.0)
    assert found[1:] == [FIRST, FIRST]


def test_the_state_travels_as_bytes_and_starts_again() -> None:
    novelty = NoveltyDetector(SETTINGS)
    reasons(novelty, [cut(number) for number in range(5)])
    known = loads(dumps(novelty.state))
    assert known == novelty.state
    again = booted(known, SETTINGS.rules)
    assert (again.chart, again.gap, again.unconditional) == (known.chart, known.gap, 2)
    assert (again.last_sent, again.offset, again.recent, again.low) == (None, None, (), math.inf)
    assert reasons(NoveltyDetector(SETTINGS, known), [cut(0, 10.5)]) == [SCORE]


@given(st.binary(max_size=64))
def test_bytes_that_are_no_state_are_refused(data: bytes) -> None:
    with contextlib.suppress(InvalidInput):
        assert isinstance(loads(data), NoveltyState)


_NUMBERS = st.floats(width=64) | st.sampled_from([0.0, 1e308, -1e308, 1e-320, math.inf, math.nan])


@pytest.mark.slow
@examples(60, deadline=None)
@given(st.lists(st.tuples(_NUMBERS, _NUMBERS), min_size=1, max_size=40), st.integers(1, 300), st.integers(0, 3))
def test_nothing_that_a_sensor_gives_stops_the_judge(steps: list[tuple[float, float]], hold: int, warm: int) -> None:
    theta_m, position = (np.repeat(np.array(values), hold) for values in zip(*steps, strict=True))
    novelty = NoveltyDetector(SETTINGS)
    reasons(novelty, [cut(number) for number in range(warm)])
    with np.errstate(all="ignore"):
        novelty(made(theta_m, position, 9))
    assert all(map(math.isfinite, (novelty.state.gap, novelty.state.chart.gap, novelty.state.chart.weight)))


def test_rules_and_model_are_read_back_bit_for_bit() -> None:
    rules = NoveltyRules(math.radians(0.02), 0.01, 4.0, 0.4, 6.0, look_s=math.inf, learn=3)
    described = NoveltySettings(MODEL, rules, 0.1)
    written = values_of(described)
    inner = written.pop("model")
    lines = [*(f"{key} = {value!r}" for key, value in written.items()), "[model]"]
    text = "\n".join([*lines, *(f"{key} = {value!r}" for key, value in inner.items())])
    table = parse_toml(text, "edge.toml")
    assert read(table, NoveltySettings) == described
    table.done()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("score_limit = -1", "score_limit = -1 is not allowed; give a positive number"),
        ("worth_deg = 'a'", "worth_deg"),
        ("learn = 1.5", "learn"),
    ],
)
def test_rules_in_toml_are_refused_by_name(text: str, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        read(parse_toml(text, "scenario.toml"), NoveltyRules)


def test_a_model_in_toml_has_as_many_numbers_everywhere() -> None:
    inner = values_of(SETTINGS)["model"]
    inner["gain_imag"] = inner["gain_imag"][:1]
    text = "\n".join(f"{key} = {value!r}" for key, value in inner.items())
    with pytest.raises(InvalidInput, match="gain_imag"):
        read(parse_toml(text, "edge.toml"), model_table)


def test_settings_need_no_numbers_library_and_the_check_names_what_is_missing() -> None:
    code = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(('numpy', 'scipy', 'numba')))\n"
        "from servotwin.errors import InvalidInput\n"
        "from servotwin.novelty import settings\n"
        "model = settings.NoveltyModel(500.0, (settings.ResponseMode(0.9 + 0j, 1j),), 0.0, 1e-3, 0.1)\n"
        "try:\n"
        "    settings.NoveltySettings(model).check(500.0)\n"
        "except InvalidInput as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "[novelty] needs numpy, scipy, numba" in done.stdout


def test_a_state_of_the_version_before_is_read() -> None:
    """The names under which it is stored are those of the first version."""
    chart = {"gap": 0.17, "weight": 4e6, "anchor": 0.17, "up": 1.0, "down": 0.0, "last": [[0.17, 1e-8]], "bends": [0.5]}
    stored = {"type": "novelty/1", "gap": 0.17, "owed": 2, "chart": chart, "version": 3, "told": 0.18, "sent": 41.0}
    stored |= {
        "silent": 1,
        "recent": [4, 5],
        "low": -0.1,
        "high": 0.1,
        "bound": 0.2,
        "offset": [0.01, 1e-4],
        "noise": 1e-6,
    }
    state = loads(msgspec.msgpack.encode(stored))
    assert (state.unconditional, state.update_gap, state.last_sent) == (2, 0.18, 41.0)
    assert (state.uninformative, state.reported_lost_motion, state.chart.weight) == (1, 0.2, 4e6)
    assert msgspec.msgpack.decode(dumps(state)) == stored
