"""A search is remembered, and made again only where another answer is possible."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from servotwin.control.gains import gains_of
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.messages import Gains, Setting
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.servo import Servo
from servotwin.redesign.certified import policy as policies
from servotwin.redesign.certified.certificate import NotVerified
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.last_search import LastSearch, ranges_of
from servotwin.redesign.certified.policy import CertifiedPolicy, alike
from servotwin.redesign.certified.uncertainty import Region, Uncertainty
from servotwin.redesign.design import Design, decoded_part
from servotwin.redesign.policy import NOT_OBSERVED, Evidence, Redesign

DEG = math.pi / 180.0
SMALL = Demands(machines=16, conditions=4, screened=2, settled=0.8, integral=(0.0,), beyond=Beyond(machines=4))
OWN = Servo.preset("paper").controller
POLICY = CertifiedPolicy(Servo.preset("paper"), Uncertainty(input_bias=(-0.1, 0.1)), SMALL)


class Searches:
    """Search that finds nothing, and counts."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, *_question: object) -> NotVerified:
        self.count += 1
        return NotVerified(f"nothing found in search {self.count}")


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> Searches:
    made = Searches()
    monkeypatch.setattr(policies, "certify", made)
    return made


def seen(low: float, high: float, bias: float = 0.02, noise: float = 1e-5, **more: object) -> Evidence:
    """Evidence of a gap within these degrees, of a bias (V) at three rests, and of noise (m)."""
    estimate = GapEstimate(0.5 * (low + high) * DEG, 0.0, 0.0, (low * DEG, high * DEG), GapStatus.OK, 1.0)
    rest = Disturbance(bias, 1e-5, noise, 0.3, 0.0)
    return Evidence(estimate, rest, rests=(bias, bias), **more)  # type: ignore[arg-type]


def asked_twice(first: Evidence, then: Evidence, policy: CertifiedPolicy = POLICY) -> tuple[Redesign, Redesign]:
    made = policy.redesign(first)
    assert made.search is not None
    return made, policy.redesign(replace(then, search=made.search))


@pytest.mark.parametrize(
    "then",
    [seen(9.0, 11.0), seen(9.3, 10.8), seen(8.0, 12.0), seen(9.0, 11.0, noise=3e-5), seen(9.0, 11.0, 0.0201)],
)
def test_nearly_the_same_question_or_a_harder_one_is_not_asked_again(searches: Searches, then: Evidence) -> None:
    made, again = asked_twice(seen(9.0, 11.0), then)
    assert searches.count == 1
    assert made.certificate is not None
    assert alike(made.certificate.setting, again.setting)
    assert again.search is None
    assert made.reason == "nothing found in search 1; the fallback set is sent"
    assert again.reason.startswith("nothing found in search 1; the ranges have not become noticeably narrower since")


@pytest.mark.parametrize(
    ("first", "then"),
    [
        (seen(5.0, 11.0), seen(9.0, 11.0)),
        (seen(9.0, 11.0), seen(7.0, 9.0)),
        (seen(9.0, 11.0), seen(9.0, 11.0, steps=(1e-3,))),
        (seen(9.0, 11.0), seen(9.0, 11.0, noise=0.0)),
        (replace(seen(9.0, 11.0), rests=()), seen(9.0, 11.0)),
    ],
    ids=["narrower", "smaller", "steps seen", "no noise", "bias known"],
)
def test_a_question_that_may_have_another_answer_is_asked(searches: Searches, first: Evidence, then: Evidence) -> None:
    _, again = asked_twice(first, then)
    assert searches.count == 2
    assert again.search is not None
    assert again.search.reason == "nothing found in search 2"


def test_a_machine_that_was_learnt_anew_is_another_question(searches: Searches) -> None:
    def learnt(k: float, c: float) -> FactorPrior:
        return FactorPrior(np.log([k, c, 1.0, 1.0]), np.diag(np.square([5e-3, 2e-2, 1e-4, 1e-2])))

    plain, known = seen(9.0, 11.0), seen(9.0, 11.0, machine=learnt(1.0, 0.8))
    asked_twice(plain, known)
    assert searches.count == 2
    asked_twice(known, seen(9.0, 11.0, machine=learnt(1.01, 0.81)))
    assert searches.count == 3
    asked_twice(known, seen(9.0, 11.0, machine=learnt(1.0, 0.5)))
    assert searches.count == 5


def test_other_demands_or_stated_ranges_are_asked_again(searches: Searches) -> None:
    """The settings of a twin may change while its state stays."""
    search = POLICY.redesign(seen(9.0, 11.0)).search
    for policy in (
        replace(POLICY, demands=replace(SMALL, Ms=1.9)),
        replace(POLICY, uncertainty=replace(POLICY.uncertainty, k=0.1)),
    ):
        assert policy.redesign(replace(seen(9.0, 11.0), search=search)).search is not None
    assert searches.count == 3


def test_the_chosen_setting_is_verified_alone_while_the_question_is_nearly_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = POLICY.redesign(seen(9.9, 10.1))
    assert made.search is not None
    assert made.search.found is not None
    searches = Searches()
    monkeypatch.setattr(policies, "certify", searches)
    then = seen(9.8, 10.3, setting=made.setting, search=made.search)
    again = POLICY.redesign(then)
    assert (again.setting, again.reason) == (None, "the verified setting is in force already")
    assert again.search is None
    assert again.certificate is not None
    assert again.certificate.gap == pytest.approx((9.8 * DEG, 10.3 * DEG))
    assert searches.count == 0
    other = Setting(0.0, gains_of(POLICY.servo.controller))
    for asked in (seen(5.0, 10.1, setting=made.setting), seen(9.8, 10.3, setting=other)):
        assert POLICY.redesign(replace(asked, search=made.search)).search is not None
    assert searches.count == 2


@pytest.mark.slow
def test_the_chosen_setting_follows_the_friction_as_it_becomes_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def evidence(friction: float, **more: object) -> Evidence:
        std = 1.5e-3
        motor = LearntMotor((0.0, 0.0, friction, -0.02), (*[0.0] * 10, std**2, *[0.0] * 4, std**2), 0.0)
        return seen(9.9, 10.1, motor=motor, **more)

    def fed(made: Redesign) -> float:
        assert made.setting is not None
        assert isinstance(made.setting.gains, Gains)
        return made.setting.gains.friction_feedforward

    made = POLICY.redesign(evidence(0.06))
    assert fed(made) == pytest.approx(0.06 - NORMAL_95 * 1.5e-3)
    searches = Searches()
    monkeypatch.setattr(policies, "certify", searches)
    again = POLICY.redesign(evidence(0.062, setting=made.setting, search=made.search))
    assert fed(again) == pytest.approx(0.062 - NORMAL_95 * 1.5e-3)
    assert again.certificate is not None
    assert again.certificate.friction == pytest.approx(np.array(POLICY.ranges.friction(evidence(0.062))))
    assert searches.count == 0


def test_a_machine_whose_gap_no_window_shows_is_asked_about_again_once_more_is_known(searches: Searches) -> None:
    hidden = replace(seen(0.0, 60.0).estimate, status=GapStatus.LOWER_BOUND)
    made = POLICY.redesign(replace(seen(0.0, 60.0), estimate=hidden, setting=Setting(0.0, gains_of(OWN))))
    assert searches.count == 1
    calm = Setting(0.0, gains_of(OWN.replace(Ki=0.0, feedforward=-0.02)))
    then = replace(seen(0.0, 60.0), estimate=hidden, setting=calm, search=made.search)
    assert POLICY.redesign(then).reason == "the estimate is lower bound"
    assert POLICY.redesign(replace(then, steps=(1e-3,), disturbance=NOT_OBSERVED)).search is None
    assert searches.count == 1
    again = POLICY.redesign(replace(then, steps=(1e-3,)))
    assert again.search is not None
    assert searches.count == 2
    assert POLICY.redesign(replace(then, steps=(1.01e-3,), search=again.search)).search is None
    assert searches.count == 2


def test_a_chosen_setting_that_is_not_verified_any_more_is_searched_for_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    made = POLICY.redesign(seen(9.9, 10.1))
    searches = Searches()
    monkeypatch.setattr(policies, "certify", searches)
    monkeypatch.setattr(policies, "confirm", lambda *_question: NotVerified("it hunts"))
    again = POLICY.redesign(seen(9.8, 10.3, setting=made.setting, search=made.search))
    assert searches.count == 1
    assert again.reason == "nothing found in search 1; the fallback set is sent"


def test_a_fallback_set_in_force_is_not_sent_again(searches: Searches) -> None:
    made = POLICY.redesign(seen(9.0, 11.0))
    again = POLICY.redesign(seen(9.0, 11.0, setting=made.setting, search=made.search))
    assert (again.setting, again.reason.partition("; the ")[0]) == (None, "nothing found in search 1")
    assert again.reason.endswith("; the fallback set stays")
    anew = POLICY.redesign(seen(9.0, 11.0, setting=made.setting))
    assert (anew.setting, anew.reason) == (None, "nothing found in search 2; the fallback set stays")
    assert anew.search is not None
    other = POLICY.redesign(seen(9.0, 11.0, bias=0.06, setting=made.setting))
    assert other.reason == "nothing found in search 3; the fallback set is sent"
    assert other.setting is not None
    assert other.setting.gains is not None
    assert other.setting.gains.feedforward == pytest.approx(-0.06)


@pytest.mark.parametrize("preset", AXES)
def test_every_axis_has_a_question(preset: str) -> None:
    """A drive in velocity mode and a stepper hold no torque by their command."""
    axis = Axis.preset(preset)
    found = ranges_of(axis, POLICY.uncertainty, SMALL, Region((0.0, 0.1), 0.0, (-0.1, 0.1), (0.0, 1e-3), 0.0))
    assert ("friction" in found) == (axis.torque_of(1.0) != 0.0)
    assert all(math.isfinite(end) for ends in found.values() for end in ends)
    assert found["bias"][0] < 0.0 < found["bias"][1]


def test_the_memory_keeps_every_bit(searches: Searches) -> None:
    failed = POLICY.redesign(seen(9.0, 11.0, steps=(1e-3 / 3.0,))).search
    assert failed is not None
    found = replace(POLICY.servo.controller, Kp=1.0 / 3.0)
    for memory in (failed, LastSearch(failed.asked, Design(found, 1e-4 / 3.0))):
        data = msgspec.msgpack.encode(memory)
        assert msgspec.msgpack.decode(data, type=LastSearch, dec_hook=decoded_part) == memory
        assert len(data) < 1000
    assert searches.count == 1


def test_ranges_beyond_the_stated_ones_are_named_with_the_failure(searches: Searches) -> None:
    biased = POLICY.redesign(seen(9.0, 11.0, bias=0.3))
    assert "; the windows show an input bias of 0.3 to 0.3 V, and -0.1 to 0.1 are stated" in biased.reason
    setting = Setting(0.0, None)
    friction = POLICY.redesign(replace(seen(9.0, 11.0, bias=0.06), rests=(-0.06, 0.06), setting=setting))
    assert "; the windows show friction of 0 to 0.0" in friction.reason
    assert searches.count == 2
