"""Steps between two places do not tell a gap from the lead of a screw: the twin asks for moves of different lengths."""

import math

import pytest
from exploration import explored
from stage_scenario import MAY_PROBE, PROBED, stage

from servotwin.cosim import Loop
from servotwin.edge.probe import ProbeLimits
from servotwin.estimation.estimate import GapStatus
from servotwin.messages import TEACHING, Probe, RequestOutcome
from servotwin.plant.signals import SquareWave
from servotwin.redesign.excitation import ExcitationSettings

TUNED_ON = [(20261126, 2), (20261126, 4)]
NOT_TUNED_ON = [(61126, 1), (61126, 2), (61126, 3)]


def kinds(loop: Loop) -> list[tuple[str, bool]]:
    return [(window.reason, estimate.ok) for window, estimate in zip(loop.windows, loop.estimates, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "number"), explored([*TUNED_ON, *NOT_TUNED_ON], 0, 2))
def test_moves_of_different_lengths_are_requested_once_and_every_later_window_tells_the_gap(
    seed: int, number: int
) -> None:
    machine = stage((seed, number))
    loop = machine.run()
    refused = ("reference", False)
    assert kinds(loop) == [refused, refused, (TEACHING, True), *[("reference", True)] * 4]
    for estimate in loop.estimates[:2]:
        assert estimate.status is GapStatus.UNIDENTIFIABLE
        assert estimate.ratio is not None
        assert estimate.ratio.needed < estimate.ratio.known
        assert estimate.ratio.widest > machine.gap
    for estimate in loop.estimates[2:]:
        assert estimate.interval[0] < machine.gap < estimate.interval[1]
        assert abs(estimate.gap / machine.gap - 1.0) < 0.02
    taught = loop.estimates[2].machine
    assert taught is not None
    std = math.sqrt(taught.covariance[10])
    assert abs(taught.factors[2] - math.log(machine.ratio)) < 3.0 * std
    assert std < loop.estimates[1].ratio.needed  # type: ignore[union-attr]


@pytest.mark.slow
def test_the_edge_makes_the_moves_that_were_requested_and_comes_back() -> None:
    machine = stage(TUNED_ON[0], duration=20.0)
    loop = machine.run()
    (request,), (answer,) = loop.requests, loop.answers
    assert isinstance(request.ask, Probe)
    assert answer.accepted
    assert "the ratio is known to 0.5 %" in request.reason
    shortest = request.ask.places[0] * request.ask.size
    assert shortest > machine.scenario.model.p * machine.gap
    assert request.ask.size <= MAY_PROBE.probe
    rate = machine.scenario.recording.sample_rate
    moved = loop.run.reference - machine.scenario.reference.pieces(20.0).on(loop.run.time)
    hold = round(request.ask.hold_s * rate)
    offsets = [moved[answer.sample + hold * place + hold // 2] for place in range(len(request.ask.places))]
    assert offsets == pytest.approx([share * request.ask.size for share in request.ask.places], abs=1e-12)
    assert moved[answer.sample + hold * len(offsets)] == 0.0


ADVICE = "move by different lengths once"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("excitation", "probe", "words", "outcomes"),
    [
        (None, PROBED, "[twin.excitation] is absent", []),
        (ExcitationSettings(), PROBED, "a probing move is not allowed", []),
        (MAY_PROBE, None, "this edge refuses probing moves", [RequestOutcome.NOT_ALLOWED]),
        (MAY_PROBE, ProbeLimits(1e-5), "this edge refuses probing moves", [RequestOutcome.TOO_LARGE]),
        (ExcitationSettings(probe=2e-5), PROBED, "and at most 0.02 mm are allowed", []),
    ],
)
def test_where_it_is_not_allowed_nothing_moves_and_one_alarm_says_what_to_do(
    excitation: ExcitationSettings | None, probe: ProbeLimits | None, words: str, outcomes: list[RequestOutcome]
) -> None:
    duration = 34.0 if outcomes else 22.0  # an edge's answer takes a window or two; one more comes after the alarm
    loop, alarms = stage(TUNED_ON[1], excitation, probe, duration=duration).run_with_alarms()
    assert kinds(loop) == [("reference", False)] * len(loop.windows)
    assert [answer.outcome for answer in loop.answers] == outcomes
    (alarm,) = [sentence for sentence in alarms if ADVICE in sentence]
    assert words in alarm
    needed = [f"state the ratio to {100.0 * each.ratio.needed:.2g} %" for each in loop.estimates if each.ratio]
    assert any(sentence in alarm for sentence in needed)


@pytest.mark.slow
def test_a_window_that_tells_too_little_for_another_reason_does_not_lack_the_ratio() -> None:
    """One step touches one flank: moves of different lengths are not what is missing."""
    once = stage(TUNED_ON[0], duration=10.0)
    loop = once._replace(scenario=once.scenario.replace(reference=SquareWave(1e-4, 60.0))).run()
    (estimate,) = loop.estimates
    assert (estimate.ok, estimate.ratio) == (False, None)
    assert "one flank" in estimate.reasons[0]
