"""The twin in the loop of a cascade: position on the load, velocity on the motor, a gap and friction between them."""

import numpy as np
import pytest

import servotwin as st
from servotwin.commissioning.edge_settings import Recording
from servotwin.control.gains import with_gains
from servotwin.control.running_law import RunningLaw, command_of
from servotwin.estimation.learning.trend_settings import TrendSettings
from servotwin.messages import CascadeGains, Update, decode
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.twin.settings import TwinSettings

SCREW = st.Axis.preset("ball-screw")
CASCADE = st.Cascade(
    100.0, SCREW.p, velocity_gain=0.012, integral_time=0.02, speed_filter=1e-3, voltage_limit=3.8, sample_rate=2000.0
)
AXIS = SCREW.replace(controller=CASCADE)
UM = 1e-6
FEW = Demands(machines=20, screened=2, conditions=2, beyond=Beyond(machines=4), settled=0.8)
"""A verification that takes a second and not a minute."""


def lost_motion(micrometres: float) -> float:
    """Total gap, rad."""
    return micrometres * UM / SCREW.p


@pytest.fixture(scope="module")
def certified() -> st.Loop:
    """A gap of 20 um, and windows of both directions."""
    stated = Uncertainty(gap=(0.0, lost_motion(60.0)), step=(2e-4, 2e-3), input_bias=(-0.01, 0.01), k=0.05, c=0.2)
    twin = TwinSettings(
        policy="certified", uncertainty=stated, demands=FEW, initial_gap=lost_motion(5.0),
        trend=TrendSettings.for_wear(lost_motion(1.0), 40.0),
    )  # fmt: skip
    scenario = st.Scenario(
        servo=AXIS, duration=1.2, reference=st.SquareWave(5e-4, 0.8), gap=lost_motion(20.0),
        recording=Recording(sample_rate=2000.0), twin=twin, seed=1,
    )  # fmt: skip
    return st.cosimulate(scenario)


@pytest.mark.slow
def test_verified_numbers_of_a_cascade_are_sent_and_applied(certified: st.Loop) -> None:
    assert certified.updates
    assert all(isinstance(update.setting.gains, CascadeGains) for update in certified.updates)
    assert all(receipt.applied for receipt in certified.receipts)
    assert not certified.fallbacks
    error = (certified.run.reference - certified.run.position)[-100:-1]
    assert np.abs(error).max() < 2e-2 * 1e-3 + 20 * UM


@pytest.mark.slow
def test_the_loop_begins_on_the_set_that_is_verified_for_every_gap(certified: st.Loop) -> None:
    start = certified.scenario.start
    assert start.fallback
    assert isinstance(start.setting.gains, CascadeGains)
    fallback = certified.scenario.agent_settings().supervision.fallback
    assert fallback is not None
    assert fallback.setting == start.setting


@pytest.mark.slow
def test_the_edge_runs_the_law_that_was_verified(certified: st.Loop) -> None:
    """What the update's bytes say, put into the configured cascade, is the certificate's controller."""
    sent = [decode(m.data) for m in certified.messages if m.direction == "down"]
    updates = [each for each in sent if isinstance(each, Update)]
    assert updates
    for update in updates:
        (certificate,) = [each.certificate for each in certified.redesigns if each.setting == update.setting]
        assert certificate is not None
        assert with_gains(AXIS.controller, update.setting.gains) == certificate.setting.controller


@pytest.mark.parametrize("law", [CASCADE, CASCADE.linear()], ids=["cascade", "linear"])
def test_the_edge_s_tick_gives_the_commands_of_the_verifying_simulation(law: st.Cascade | st.LinearLaw) -> None:
    """Bit for bit, over a change of gains and dead zone in the run."""
    axis, new = AXIS.replace(controller=law), law.replace(leave=2.0, feedforward=0.01)
    running, later = RunningLaw(law, 0.0), RunningLaw(new, 5e-6)
    simulation = st.Simulation(
        axis, 0.3, reference=st.SquareWave(5e-4, 0.2), gap=lost_motion(20.0), tolerance=0.0, sample_rate=2000.0
    )
    simulation.advance(300)
    simulation.set_controller(new, 5e-6)
    simulation.advance(600)
    state, commands = running.start(0.0, 0.0), []
    channels = [simulation.measured(name, 0, 600).tolist() for name in ("reference", "theta_m", "position", "voltage")]
    samples = list(zip(*channels[:3], strict=True))
    for k, sample in enumerate(samples):
        if k == 300:
            state, running = later.take_over(running, state, *sample), later
        state = running.tick(state, *sample)
        commands.append(command_of(state))
    assert commands == channels[3]


@pytest.mark.slow
def test_the_paper_s_dead_zone_follows_the_estimate_of_a_cascade_s_gap() -> None:
    """It stops the integral of the velocity loop; the gains stay."""
    scenario = st.Scenario(
        servo=AXIS,
        duration=1.2,
        reference=st.SquareWave(5e-4, 2.0),
        gap=lost_motion(20.0),
        recording=Recording(sample_rate=2000.0),
        twin=TwinSettings(policy="paper", initial_gap=lost_motion(5.0)),
        seed=1,
    )
    loop = st.cosimulate(scenario)
    assert [update.setting.gains for update in loop.updates] == [None] * len(loop.updates) != []
    usable = [estimate.gap for estimate in loop.estimates if estimate.ok]
    assert [update.setting.tolerance for update in loop.updates] == pytest.approx([SCREW.p * gap for gap in usable])
    assert all(receipt.applied for receipt in loop.receipts)
    assert set(loop.run.tolerance.tolist()) == {5.0 * UM, *(update.setting.tolerance for update in loop.updates)}
