"""The edge bounds the numbers of every kind of law, and carries them over a restart."""

from math import inf
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from sending_agent import SendingAgent

from servotwin.config.own_units import OwnUnits
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.control.retuning import scaled
from servotwin.edge.guard import Instant, Limits, judge
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import FileParameterStore
from servotwin.edge.supervisor import Rules, Switch, offer
from servotwin.edge_process.startup import permitted
from servotwin.errors import InvalidInput
from servotwin.messages import AnyGains, Gains, Reason, Receipt, Setting, Update

CASCADE = Cascade(
    20.0,
    0.1,
    velocity_gain=3.0,
    integral_time=0.1,
    velocity_feedforward=0.5,
    acceleration_feedforward=0.2,
    sample_rate=1e3,
)  # fmt: skip
LINEAR = LinearLaw([[0.0]], [[2.0, 0.0, -2.0]], [1.0], [3.0, 0.0, -3.0], 1e3, names=("integral",), holds=("integral",))
PID = Controller(4e3, 1e3, 90.0, 0.02, sample_rate=1e3)
OWN, LINEAR_OWN = gains_of(CASCADE), gains_of(LINEAR)


def updated(gains: AnyGains) -> Update:
    known = (None, None, (None, None))
    return Update("axis-1", 1, 0, ("b0", 0), 9.0, *known, "OK", Setting.of(1e-4, gains), 60.0)


def judged(gains: AnyGains, limits: Limits, own: AnyGains = OWN, seconds: float = 10.0) -> Reason:
    current = Parameters(setting=Setting.of(1e-4, own))
    return judge(updated(gains), current, limits, Instant("axis-1", "b0", round(seconds * 1000), 1000.0), own)


@pytest.mark.parametrize(
    ("changes", "inside"),
    [
        ({}, True),
        ({"position_gain": 80.0}, True),
        ({"position_gain": 80.1}, False),
        ({"position_gain": 4.9}, False),
        ({"velocity_gain": 12.1}, False),
        ({"velocity_gain": 0.0, "integral_time": 0.0}, False),
        ({"speed_filter": 4.1e-3}, False),
        ({"integral_time": 0.0}, True),
        ({"integral_time": 0.0999}, False),
        ({"velocity_gain": 6.0, "integral_time": 0.2}, True),
        ({"velocity_gain": 6.0, "integral_time": 0.199}, False),
        ({"velocity_feedforward": 1.0}, True),
        ({"velocity_feedforward": 1.01}, False),
        ({"acceleration_feedforward": 0.8}, True),
        ({"acceleration_feedforward": 0.81}, False),
        ({"leave": 4.1}, False),
        ({"feedforward": -0.26}, False),
        ({"notch_hz": 4.0}, False),
    ],
)
def test_the_numbers_of_a_cascade_stay_in_the_box(changes: dict[str, float], inside: bool) -> None:
    expected = Reason.APPLIED if inside else Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(OWN, **changes), Limits()) is expected


@pytest.mark.parametrize(
    ("changes", "inside"),
    [
        ({"gain": 4.0, "integral_share": 0.25}, True),
        ({"gain": 4.0, "integral_share": 0.26}, False),
        ({"gain": 4.1, "integral_share": 0.0}, False),
        ({"gain": 0.24}, False),
        ({"leave": 4.1}, False),
        ({"feedforward": 0.26}, False),
    ],
)
def test_the_numbers_of_a_linear_law_stay_in_the_box(changes: dict[str, float], inside: bool) -> None:
    expected = Reason.APPLIED if inside else Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(LINEAR_OWN, **changes), Limits(), LINEAR_OWN) is expected


@pytest.mark.parametrize("law", [CASCADE, LINEAR, PID], ids=["cascade", "linear", "pid"])
def test_the_own_integral_action_is_in_the_box_but_for_rounding(law: AnyController) -> None:
    """Scaled, an integral gain that stays may be the next number up."""
    for scale in np.linspace(0.3, 3.7, 50):
        kept = gains_of(scaled(law, float(scale), (1.0, 1.0), 1.0))
        assert judged(kept, Limits(), gains_of(law)) is Reason.APPLIED


@pytest.mark.parametrize("law", [CASCADE, PID], ids=["cascade", "pid"])
def test_a_law_keeps_a_notch_of_its_own(law: AnyController) -> None:
    own = gains_of(law.replace(notch_hz=80.0, notch_damping=0.7))
    assert judged(own, Limits(), own) is Reason.APPLIED
    assert judged(replace(own, notch_hz=0.0), Limits(), own) is Reason.APPLIED
    for other in ({"notch_hz": 81.0}, {"notch_damping": 0.71}, {"notch_depth": 0.2}):
        assert judged(replace(own, **other), Limits(), own) is Reason.GAINS_OUT_OF_BOUNDS


def test_an_update_of_which_the_law_cannot_be_made_is_refused() -> None:
    """A notch beyond the law's rate."""
    rules = Rules(Limits(notch_max_hz=inf), CASCADE)
    here, switch = Instant("axis-1", "b0", 10_000, 1000.0), Switch(Parameters(setting=Setting.of(1e-4, OWN)))
    gains = replace(OWN, notch_hz=500.0)
    assert rules.limits.allows_gains(gains, OWN)
    after = offer(switch, updated(gains), rules, here, None)
    (answer,) = after.messages
    assert isinstance(answer, Receipt)
    assert answer.reason is Reason.GAINS_OUT_OF_BOUNDS
    assert after.state.current is switch.current


@pytest.mark.parametrize("fallback", [False, True])
def test_stored_gains_of_another_law_do_not_end_the_edge(fallback: bool, tmp_path: Path) -> None:
    store = FileParameterStore(tmp_path / "kept.json")
    store.save(Parameters(version=7, setting=Setting.of(2e-4, Gains(1.0, 0.0, 0.0, 1.0)), fallback=fallback))
    agent = SendingAgent(AgentSettings("axis-1", "b1", 1e3, 1.0, controller=CASCADE), store=store)
    assert agent.controller == CASCADE
    assert agent.parameters.setting == Setting.of(2e-4, OWN)
    assert permitted(store.load(), AgentSettings("axis-1", "b1", 1e3, 1.0, controller=CASCADE)) is None


def test_each_gain_of_a_law_may_have_a_range() -> None:
    limits = Limits(gain_factor=1.0, position_gain=(10.0, 20.0), velocity_gain=(3.0, 5.0), gain=(0.5, 1.0))
    assert judged(replace(OWN, position_gain=10.0, velocity_gain=5.0, integral_time=0.2), limits) is Reason.APPLIED
    for beyond in ({"position_gain": 20.1}, {"velocity_gain": 2.9}, {"speed_filter": 1.1e-3}):
        assert judged(replace(OWN, **beyond), limits) is Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(LINEAR_OWN, gain=0.5), limits, LINEAR_OWN) is Reason.APPLIED
    assert judged(replace(LINEAR_OWN, gain=0.49), limits, LINEAR_OWN) is Reason.GAINS_OUT_OF_BOUNDS


@pytest.mark.parametrize(
    ("law", "limits", "words"),
    [
        (
            CASCADE,
            Limits(Kp=(1.0, 2.0)),
            r"limits Kp = \(1.0, 2.0\) V/m: the controller has no Kp; give ranges of position_gain, ",
        ),
        (PID, Limits(Kd=(-9.0, -1.0)), "limits Kd = .*: must reach to the side of zero of the servo's own 90.0"),
    ],
)
def test_a_range_that_allows_the_controller_nothing_is_refused(law: AnyController, limits: Limits, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        AgentSettings("axis-1", "b1", 1e3, controller=law, limits=limits)


@pytest.mark.parametrize(
    ("own", "limits", "changes", "detail"),
    [
        (PID, Limits(Kp=(3e3, 5e3)), {"Kp": 5001.0}, "kp_n_m_per_rad = 5001: must be within 3000 and 5000"),
        (PID, Limits(), {"Ki": -1.0}, "ki_n_m_per_rad_s = -1: must be within 0 and 1000"),
        (PID, Limits(), {"notch_hz": 4.0}, "notch_hz = 4: must be within 0 and 0"),
        (CASCADE, Limits(), {"integral_time": 0.05}, "integral_gain = 60: must be within 0 and 30"),
    ],
)
def test_a_receipt_says_which_gain_was_refused(
    own: AnyController, limits: Limits, changes: dict[str, float], detail: str
) -> None:
    rules, gains = Rules(limits, own, units=OwnUnits("N m", "rad")), gains_of(own)
    here, switch = Instant("axis-1", "b0", 10_000, 1000.0), Switch(Parameters(setting=Setting.of(1e-4, gains)))
    (answer,) = offer(switch, updated(replace(gains, **changes)), rules, here, None).messages
    assert isinstance(answer, Receipt)
    assert (answer.reason, answer.detail) == (Reason.GAINS_OUT_OF_BOUNDS, detail)


def test_gains_of_another_kind_of_law_are_refused() -> None:
    for gains in (Gains(1.0, 1.0, 1.0, 1.0), LINEAR_OWN):
        assert judged(gains, Limits(gain_factor=1e9)) is Reason.GAINS_OUT_OF_BOUNDS


def test_a_velocity_loop_changes_no_faster_than_allowed() -> None:
    limits = Limits(gain_step=1.5)
    assert judged(replace(OWN, velocity_gain=4.5, integral_time=0.15), limits) is Reason.APPLIED
    assert judged(replace(OWN, velocity_gain=4.6, integral_time=0.2), limits) is Reason.GAINS_STEP_TOO_LARGE
    assert judged(replace(OWN, velocity_gain=3.0, integral_time=0.0), limits) is Reason.APPLIED


@pytest.mark.parametrize("own", [OWN, LINEAR_OWN])
def test_the_numbers_of_a_law_outlive_a_restart(tmp_path: Path, own: AnyGains) -> None:
    store = FileParameterStore(tmp_path / "parameters.json")
    parameters = Parameters(version=7, setting=Setting.of(2e-4, own))
    store.save(parameters)
    assert store.load() == parameters


def test_stored_numbers_of_another_law_are_dropped_at_a_restart() -> None:
    """The file of an edge whose drive was tuned anew as a cascade."""
    agent = AgentSettings("axis-1", "b1", 1e3, controller=CASCADE)
    kept = Parameters(version=7, setting=Setting.of(2e-4, OWN))
    assert permitted(kept, agent) is kept
    assert permitted(Parameters(version=7, setting=Setting.of(2e-4, Gains(1.0, 0.0, 0.0, 1.0))), agent) is None


def test_limits_on_a_notch_fit_the_rate_of_a_cascade() -> None:
    with pytest.raises(
        InvalidInput, match=r"notch_max_hz = 500.0 Hz: must be below half of the controller's 1000.0 Hz"
    ):
        AgentSettings("axis-1", "b1", 1e3, controller=CASCADE, limits=Limits(notch_max_hz=500.0))


@pytest.mark.parametrize("own", [Cascade(10.0, 2.0, velocity_gain=0.1), Controller(1.0, 0.0, 0.0, 0.1)])
def test_an_infinite_factor_allows_a_law_its_own_numbers_and_keeps_zeros(own: AnyController) -> None:
    limits, gains = Limits(gain_factor=inf, integral_factor=inf), gains_of(own)
    assert judged(gains, limits, gains) is Reason.APPLIED
    zero = "acceleration_feedforward" if isinstance(own, Cascade) else "Kd"
    assert judged(replace(gains, **{zero: 1.0}), limits, gains) is Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(gains, **{gains.scaled[0]: 1e6}), limits, gains) is Reason.APPLIED
