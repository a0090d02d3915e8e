"""The alarm of a twin whose windows do not tell the ratio: once, and only where no moves that tell it will come."""

from dataclasses import replace

import msgspec
import pytest
from stage_scenario import stage

from servotwin.cosim import cosimulate
from servotwin.estimation.estimate import GapEstimate, GapStatus, MachineReading, UnknownRatio, interval_95, no_estimate
from servotwin.estimation.learning.wear import Expectation, Wear
from servotwin.messages import encode
from servotwin.redesign.excitation import ExcitationSettings
from servotwin.twin.context import context_of
from servotwin.twin.estimating import DecodedWindow, estimator_of
from servotwin.twin.evidence import GapEstimateRecord
from servotwin.twin.evidence_rows import rows
from servotwin.twin.replay import replay
from servotwin.twin.state import TwinState, Versions, decode_state, encode_state
from servotwin.twin.untold_ratio import UntoldRatio

RESTS = no_estimate(1.0, ("nothing moved",))
UNTOLD = replace(RESTS, ratio=UnknownRatio(5e-3, 1.25e-3, 0.1))
TOLD = GapEstimate(0.1, 1e-4, 1e-3, interval_95(0.1, 1e-3), GapStatus.OK, 1.0)
TAUGHT = replace(TOLD, machine=MachineReading((0.0,) * 4, (0.0,) * 16))


def alarms(*seen: tuple[GapEstimate, str], after: int = 2) -> list[bool]:
    state, found = UntoldRatio(), []
    for estimate, prevented in seen:
        state, sentence = state.after(estimate, prevented, ExcitationSettings(after=after))
        found.append(bool(sentence))
    return found


def test_the_alarm_says_what_to_do_and_why_the_twin_does_not() -> None:
    _, sentence = UntoldRatio(1).after(UNTOLD, "a probing move is not allowed", ExcitationSettings())
    assert sentence == (
        "the windows do not tell the gap from the transmission's ratio: move by different lengths once, or state the "
        "ratio to 0.12 % (pitch_percent of [twin.learning]); a probing move is not allowed"
    )


def test_it_comes_once_until_a_window_has_told_the_ratio() -> None:
    no = (UNTOLD, "not allowed")
    assert alarms(no, no, no, (TOLD, ""), no, (TAUGHT, ""), no, no) == [False, True, *[False] * 5, True]


def test_it_comes_after_as_many_windows_as_a_request_would() -> None:
    assert alarms(*[(UNTOLD, "not allowed")] * 6, after=5) == [False] * 4 + [True, False]


def test_it_does_not_come_for_other_windows_or_while_moves_may_be_requested() -> None:
    assert alarms(*[(RESTS, "not allowed")] * 4, *[(UNTOLD, "")] * 4, (UNTOLD, "refused")) == [False] * 8 + [True]


def test_the_state_of_an_earlier_version_has_none() -> None:
    state = TwinState("axis", Versions(), {}, Wear(0.0), ratio=UntoldRatio(3, advised=True))
    assert decode_state("axis", encode_state(state)) == state
    document = msgspec.msgpack.decode(encode_state(state))
    del document["ratio"]
    assert decode_state("axis", msgspec.msgpack.encode(document)).ratio == UntoldRatio()


@pytest.mark.slow
def test_an_estimate_that_does_not_tell_the_ratio_is_replayed_bit_for_bit() -> None:
    scenario = stage((20261126, 2), None, duration=10.0).scenario
    (message,) = cosimulate(scenario).windows
    settings = scenario.twin.on(scenario.model)
    expected = Expectation(0.0)
    estimate = DecodedWindow.of(message).estimate(estimator_of(scenario.model, settings), expected)
    assert estimate.ratio is not None
    (row,) = rows([GapEstimateRecord(message, estimate, expected, None)], 1, "context")
    found = replay(encode(message), row.body, context_of(scenario.model, settings)[1])
    assert (found.same, found.differs, found.estimate.ratio) == (True, (), estimate.ratio)
