"""The calm loop that tells too little, closed: a longer window is asked for, then, where allowed, a probing move."""

import math
from pathlib import Path

import numpy as np
import pytest
from exploration import extent

from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Recording, Scenario
from servotwin.edge.probe import ProbeLimits
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.link.simulated import LinkSettings
from servotwin.messages import LongerWindow, Probe, Request, RequestOutcome
from servotwin.plant.noise import Noise
from servotwin.plant.signals import Samples, SignalLike, SquareWave
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.runtime.retry import Retry

DEG = math.pi / 180.0
CALM = Scenario.preset("calm").replace(gap=10.0 * DEG)
SHORT = Recording(window=1.0, pre_trigger=0.0, longest_window=2.0, longest_pre_trigger=0.3)
PROBED = Recording(probe=ProbeLimits(2e-4, 20.0))
MAY_PROBE = ExcitationSettings(probe=2e-4, interval=30.0)
SMALL = SquareWave(2e-5, 20.0)  # steps of 0.04 mm: 7.2 deg of the screw, within the gap
# Steps upwards only, of 2 and of 0.04 mm: two contacts on the same side show no gap.
UPWARDS, SMALL_UPWARDS = (
    Samples([0.0, 10.0, 20.0, 30.0, 40.0], [n * size for n in range(1, 6)]) for size in (2e-3, 4e-5)
)


def calm(excitation: ExcitationSettings | None, rate: float | None = None, **changes: object) -> Scenario:
    known = CALM.twin.uncertainty.replace(gap=(0.0, 25.0 * DEG))
    twin = CALM.twin.replace(excitation=excitation, uncertainty=known)
    return CALM.replace(**{"twin": twin, "controller": CALM.law.replace(sample_rate=rate), "duration": 30.0} | changes)


def kinds(loop: Loop) -> list[tuple[str, GapStatus]]:
    return [(window.reason, estimate.status) for window, estimate in zip(loop.windows, loop.estimates, strict=True)]


def error(loop: Loop, index: int) -> float:
    """Of an estimate, deg."""
    return abs(math.degrees(loop.estimates[index].gap) - 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [None, 1000.0])
def test_short_windows_without_pre_trigger_lead_to_longer_ones_and_to_the_gap(rate: float | None) -> None:
    loop = cosimulate(calm(ExcitationSettings(), rate, recording=SHORT, reference=SquareWave(1e-3, 20.0)))
    assert all(status in (GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND) for _, status in kinds(loop)[:2])
    (request,) = loop.requests
    assert request.ask == LongerWindow(2.0, 0.3)
    assert [answer.outcome for answer in loop.answers] == [RequestOutcome.ACCEPTED]
    (found,) = loop.estimates[2:]
    assert (found.status, loop.windows[2].samples) == (GapStatus.OK, 10_000)
    assert error(loop, 2) < 1e-3
    assert found.interval[0] < 10.0 * DEG < found.interval[1]


@pytest.mark.slow
def test_an_edge_that_refuses_longer_windows_gets_no_second_request() -> None:
    short = Recording(window=1.0, pre_trigger=0.0)
    loop = cosimulate(calm(ExcitationSettings(), recording=short, reference=UPWARDS, duration=50.0))
    assert [answer.outcome for answer in loop.answers] == [RequestOutcome.TOO_LARGE]
    assert not any(estimate.ok for estimate in loop.estimates)
    last = loop.excitations[-1].reason
    assert last.endswith("longer ones are refused, and a probing move is not allowed")


@pytest.mark.slow
@pytest.mark.parametrize("rate", [None, 1000.0])
def test_steps_within_the_gap_lead_to_a_probing_move_and_to_the_gap(rate: float | None) -> None:
    loop = cosimulate(calm(MAY_PROBE, rate, recording=PROBED, reference=SMALL_UPWARDS, duration=19.0))
    assert [kind for kind, _ in kinds(loop)] == ["reference", "reference", "probe"]
    assert [status is GapStatus.OK for _, status in kinds(loop)] == [False, False, True]
    (request,) = loop.requests
    assert isinstance(request.ask, Probe)
    pitch = loop.scenario.servo.p
    assert request.ask.size == pytest.approx(pitch * 30.0 * DEG)
    assert error(loop, 2) < 2e-3
    low, high = loop.estimates[2].interval
    assert low < 10.0 * DEG < high
    moved = loop.run.reference - loop.scenario.reference.pieces(19.0).on(loop.run.time)
    first, hold = loop.answers[0].sample, round(0.85 * 5000.0)
    assert np.array_equal(np.flatnonzero(np.abs(moved) > 1e-9), np.arange(first, first + hold))
    assert np.max(np.abs(loop.run.position)) < 8e-5 + 1.2 * request.ask.size


@pytest.mark.slow
def test_what_a_probing_move_showed_spares_the_next_one() -> None:
    """It tells the encoder's offset too, with which the small steps show the gap in one contact."""
    loop = cosimulate(calm(MAY_PROBE, recording=PROBED, reference=SMALL_UPWARDS, duration=50.0))
    assert len(loop.requests) == 1
    assert [status is GapStatus.OK for _, status in kinds(loop)] == [False, False, True, True, True, True]
    assert all(error(loop, index) < 5e-3 for index in range(2, 6))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "recording", "words", "requests"),
    [
        (ExcitationSettings(), PROBED, "a probing move is not allowed", 0),
        (MAY_PROBE, Recording(), "this edge refuses probing moves", 1),
        (ExcitationSettings(probe=1e-4), PROBED, "a probing move must be 0.167 mm, and at most 0.1 mm are allowed", 0),
        (MAY_PROBE, Recording(probe=ProbeLimits(1e-4)), "this edge refuses probing moves", 1),
    ],
)
def test_where_it_is_not_allowed_nothing_moves_and_the_reason_is_kept(
    settings: ExcitationSettings, recording: Recording, words: str, requests: int
) -> None:
    loop = cosimulate(calm(settings, recording=recording, reference=SMALL_UPWARDS, duration=36.0))
    assert {window.reason for window in loop.windows} == {"reference"}
    assert not any(estimate.ok for estimate in loop.estimates)
    assert len(loop.requests) == requests
    assert loop.excitations[-1].reason.endswith(words)
    assert np.array_equal(loop.run.reference, SMALL_UPWARDS.pieces(36.0).on(loop.run.time))


@pytest.mark.slow
def test_steps_to_and_fro_within_the_gap_show_it_without_a_probing_move() -> None:
    loop = cosimulate(calm(MAY_PROBE, recording=PROBED, reference=SMALL, duration=36.0))
    assert loop.requests == ()
    assert [estimate.ok for estimate in loop.estimates] == [False, False, True, True]
    assert max(error(loop, 2), error(loop, 3)) < 0.02
    reasons = [each.reason for each in loop.excitations]
    assert reasons[1].endswith("but two contacts show it: the next one may confirm it")
    assert reasons[2] == "the window shows the gap"


def test_nothing_is_requested_unless_configured() -> None:
    loop = cosimulate(calm(None, recording=PROBED, reference=SMALL))
    assert (loop.requests, loop.answers, loop.excitations) == ((), (), ())


WHILE_PROBING: list[tuple[float, SignalLike]] = [
    (14.0, Samples([0.0, 10.0, 14.0], [2e-5, 6e-5, 1e-4])),
    (14.0002, Samples([0.0, 10.0, 14.0002, 14.0004], [2e-5, 6e-5, 1e-4, 5e-5])),
]


@pytest.mark.slow
@pytest.mark.parametrize("rate", [None, 1000.0])
@pytest.mark.parametrize(("time", "signal"), WHILE_PROBING)
def test_a_move_of_the_reference_ends_the_probing_move_one_sample_later(
    time: float, signal: SignalLike, rate: float | None
) -> None:
    loop = cosimulate(calm(MAY_PROBE, rate, recording=PROBED, reference=signal, duration=19.0))
    first, size = loop.answers[0].sample, loop.requests[0].ask.size  # type: ignore[union-attr]
    assert loop.answers[0].accepted
    moved = loop.run.reference - signal.pieces(19.0).on(loop.run.time)  # type: ignore[union-attr]
    assert np.array_equal(np.flatnonzero(np.abs(moved) > 1e-9), np.arange(first, round(5000.0 * time) + 1))
    assert moved[first] == pytest.approx(size)
    assert [window.reason for window in loop.windows] == ["reference"] * 3
    assert loop.windows[2].reference_changes[-1][1] == pytest.approx(float(signal.pieces(19.0).value(19.0)))  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.random
def test_requests_and_answers_survive_a_bad_link_and_count_once() -> None:
    bad = LinkSettings(delay_s=0.5, loss=0.5, duplicate=0.3)
    for seed in range(extent(2, 8)):
        scenario = calm(ExcitationSettings(), recording=SHORT, reference=SquareWave(1e-3, 20.0), seed=seed, uplink=bad)
        recording = Recording(retry=Retry(2.0), window=1.0, longest_window=2.0, longest_pre_trigger=0.3)
        twin = scenario.twin.replace(retry=2.0, attempts=20)
        loop = cosimulate(scenario.replace(downlink=bad, recording=recording, twin=twin, duration=60.0))
        sent = [m.message for m in loop.messages if m.direction == "down" and isinstance(m.message, Request)]
        assert {request.serial for request in sent} == {request.serial for request in loop.requests}
        assert {answer.outcome for answer in loop.answers} == {RequestOutcome.ACCEPTED}
        assert len(set(loop.answers)) == len({answer.serial for answer in loop.answers})
        assert loop.windows[-1].samples == 10_000
    assert loop.digest() == cosimulate(loop.scenario).digest()


TOML = """
servo = "paper"
duration_s = 20.0
[reference]
kind = "constant"
value_mm = 0.1
[gap]
total_deg = 10.0
[controller]
ki_v_per_m_s = 0.0
[recording]
window_s = 1.0
longest_window_s = 2.5
longest_pre_trigger_s = 0.5
[edge.probe]
size_mm = 0.2
interval_s = 40.0
[twin]
policy = "paper"
[twin.excitation]
after = 3
window_s = 2.5
pre_trigger_s = 0.5
probe_mm = 0.15
interval_s = 45.0
hold_s = 1.0
strokes = 1
margin_deg = 8.0
"""


def load(folder: Path, text: str) -> Scenario:
    (folder / "s.toml").write_text(text)
    return Scenario.load(folder / "s.toml")


def test_it_is_configured_in_the_file(tmp_path: Path) -> None:
    scenario = load(tmp_path, TOML)
    assert scenario.twin.excitation == ExcitationSettings(3, 2.5, 0.5, 0.15e-3, 45.0, 1.0, 1, 8.0 * DEG)
    assert scenario.supervision is None
    agent = scenario.agent_settings()
    assert (agent.longest_window_s, agent.longest_pre_trigger_s) == (2.5, 0.5)
    assert agent.probe == ProbeLimits(0.2e-3, 40.0)
    with_period = load(tmp_path, TOML.replace("[edge.probe]", "[edge]\nperiod_s = 0.1\n[edge.probe]"))
    assert with_period.supervision is not None
    assert with_period.recording.probe == agent.probe


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("size_mm = 0.2", "size_mm = 0.0"), r"edge.probe.size_mm = 0.0 is not allowed"),
        (("size_mm = 0.2", ""), "size_mm"),
        (("probe_mm = 0.15", "probe_mm = -1.0"), "probe_mm"),
        (("after = 3", "after = 0"), r"twin.excitation.*after = 0"),
        (("hold_s = 1.0", "holds_s = 1.0"), "holds_s"),
        (("longest_window_s = 2.5", "longest_window_s = 0.5"), "longest_window_s = 0.5 s"),
    ],
)
def test_bad_configuration_is_named(change: tuple[str, str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=words):
        load(tmp_path, TOML.replace(*change))


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [3.0, 15.0, 25.0])
def test_noise_makes_estimates_of_a_probe_worse_or_none_but_not_wrong(degrees: float) -> None:
    scenario = calm(
        MAY_PROBE,
        1000.0,
        noise=Noise(1e-6, kind="white"),
        gap=degrees * DEG,
        theta_d0=0.3 * degrees * DEG,
        reference=SquareWave(0.35 * CALM.servo.p * degrees * DEG, 20.0),
        recording=PROBED,
        duration=50.0,
    )
    # A model that must be learnt first would widen the first answers beyond what is accepted.
    exact = scenario.twin.replace(learning=LearningSettings(learn=False))
    loop = cosimulate(scenario.replace(twin=exact))
    probed = [estimate for (kind, _), estimate in zip(kinds(loop), loop.estimates, strict=True) if kind == "probe"]
    assert any(estimate.ok for estimate in probed)
    assert all(estimate.interval[0] < degrees * DEG < estimate.interval[1] for estimate in probed)


@pytest.mark.slow
def test_the_page_shows_a_scenario_that_probes(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/excitation.md").read_text(encoding="utf-8")
    scenario = load(tmp_path, page.split("```toml\n")[1].split("```")[0])
    loop = cosimulate(scenario)
    assert ("probe", GapStatus.OK) in kinds(loop)
