"""Verified settings of cascades and linear laws: candidates, box of the edge, refusals."""

from dataclasses import replace

import numpy as np
import pytest

import servotwin as st
from servotwin.commissioning.edge_settings import Commissioning
from servotwin.control.gains import gains_of
from servotwin.control.laws import AnyController
from servotwin.control.retuning import integrates, scaled, static_gain
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.messages import Setting
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.attempt import _lag
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.fallback import CertificateFile, _decoder, _encoder
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.redesign.policy import Evidence
from servotwin.redesign.registry import policy_of
from servotwin.twin.settings import TwinSettings

SCREW = st.Axis.preset("ball-screw")
CASCADE = st.Cascade(
    100.0, SCREW.p, velocity_gain=0.012, integral_time=0.02, speed_filter=1e-3, voltage_limit=3.8, sample_rate=2000.0
)
LAWS: tuple[AnyController, ...] = (CASCADE, CASCADE.linear())
KNOWN = Uncertainty(gap=(0.0, 20e-6 / SCREW.p), step=(2e-4, 2e-3), input_bias=(-0.01, 0.01), k=0.05, c=0.2)
FEW = Demands(
    machines=12, screened=1, conditions=2, beyond=Beyond(machines=2), settled=0.7, scales=(0.5, 1.0), attempts=1
)


@pytest.fixture(scope="module", params=LAWS, ids=["cascade", "linear"])
def axis(request: pytest.FixtureRequest) -> st.Axis:
    return SCREW.replace(controller=request.param)


def test_candidates_come_with_and_without_integral_action_and_with_dead_zones(axis: st.Axis) -> None:
    designs = candidates_of(axis, KNOWN, FEW, True, False)
    assert {integrates(design.controller) for design in designs} == {True, False}
    zones = {(design.tolerance, design.controller.integral_only) for design in designs if design.tolerance}
    assert {False, True} == {only for _, only in zones}
    assert SCREW.tolerance_for(KNOWN.gap[1]) in {width for width, _ in zones}
    assert len(set(designs)) == len(designs)


@pytest.mark.slow
def test_a_setting_is_verified_and_its_certificate_is_stored(axis: st.Axis) -> None:
    """As it is read from a file: the controller is of the kind that it was."""
    found = certify(axis, KNOWN, FEW)
    assert isinstance(found, Certificate)
    assert type(found.setting.controller) is type(axis.controller)
    assert found.settled >= 0.7
    assert found.loop is not None
    assert found.loop.Ms_worst <= FEW.Ms_worst
    stored = CertificateFile({"of": "this"}, found)
    assert _decoder.decode(_encoder.encode(stored)) == stored


@pytest.mark.slow
def test_the_box_of_the_edge_admits_every_candidate_and_not_much_more(axis: st.Axis) -> None:
    twin = TwinSettings(policy="certified", uncertainty=KNOWN, demands=FEW)
    guarded = Commissioning(axis, axis.controller, twin).guarding
    assert guarded is not None
    for design in candidates_of(axis, KNOWN, FEW, True, False):
        assert guarded.limits.allows_gains(gains_of(design.controller), gains_of(axis.controller))
    hot = gains_of(scaled(axis.controller, 9.0, (1.0, 1.0), 0.0))
    assert not guarded.limits.allows_gains(hot, gains_of(axis.controller))


@pytest.mark.parametrize("integral_time", [None, 0.02])
def test_the_lag_behind_a_ramp_is_that_of_the_simulation(integral_time: float | None) -> None:
    """A quarter of the speed fed forward; the axis without Coulomb friction."""
    actuator, load = replace(SCREW.actuator, coulomb=0.0), replace(SCREW.load, friction=0.0)  # type: ignore[type-var]
    law = CASCADE.replace(integral_time=integral_time, velocity_feedforward=0.25)
    axis = SCREW.replace(actuator=actuator, load=load, controller=law)
    speed = 0.01
    ramp = st.PiecewiseCubic(np.array([0.0]), np.array([[0.0, speed, 0.0, 0.0]]))
    run = st.simulate(axis, 1.0, reference=ramp, sample_rate=100.0)
    assert (run.reference - run.position)[-2] / speed == pytest.approx(_lag(axis, law), rel=1e-3)
    assert _lag(axis, law.linear()) == pytest.approx(_lag(axis, law), rel=1e-9)


def test_a_machine_whose_drive_cuts_the_command_counts_as_saturated() -> None:
    axis = SCREW.replace(controller=CASCADE.replace(voltage_limit=None))
    for limit in (None, 0.1):
        limited = axis.replace(actuator=replace(SCREW.actuator, limit=limit))
        members = draw_independently(limited, KNOWN, 2, 1)
        (measures,) = assess([Design(axis.controller, 0.0)], members, Trial(0.5, 0.1, 1000.0))
        assert measures.saturated.all() == measures.saturated.any() == (limit is not None)


@pytest.mark.parametrize("integral_time", [None, 0.02])
def test_a_rest_without_friction_is_news_only_where_something_integrates(integral_time: float | None) -> None:
    """The share of the integral in a linear law's gains is one where nothing integrates too."""
    law = CASCADE.replace(integral_time=integral_time).linear()
    policy = CertifiedPolicy(SCREW.replace(controller=law), KNOWN)
    estimate = GapEstimate(0.0, 1.0, 1.0, (0.0, 1.0), GapStatus.UNIDENTIFIABLE, 1.0)
    rest = Disturbance(0.0, 1e-6, 0.0, 0.3, 0.0)
    seen = Evidence(estimate, rest, None, Setting.of(0.0, gains_of(law)), 0.01, rests=(0.0,))
    assert policy.ranges.shows_more(seen) == integrates(law)


@pytest.mark.parametrize(
    ("law", "changes", "words"),
    [
        (CASCADE.replace(sample_rate=None), {"policy": "certified"}, "sample_rate = None: settings of a Cascade"),
        (CASCADE, {"policy": "certified", "table": "x.table"}, "tables hold settings of a filtered PID"),
        (
            st.LinearLaw([[0.0]], [[1.0, 0.0, -1.0]], [1.0], [0.0, 0.0, 0.0], 1e3, names=("i",), holds=("i",)),
            {"policy": "certified"},
            "no proportional action",
        ),
    ],
)
def test_what_cannot_be_verified_is_refused_at_configuration(
    law: AnyController, changes: dict[str, str], words: str
) -> None:
    with pytest.raises(st.InvalidInput, match=words):
        policy_of(SCREW.replace(controller=law), TwinSettings(**changes))  # type: ignore[arg-type]
    assert static_gain(law) >= 0.0
