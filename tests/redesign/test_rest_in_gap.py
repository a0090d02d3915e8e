"""Loads that float in their gap: what brings them to rest, how long their simulations last, what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.random_axes import random_axis
from benchmarks.workloads import knocking_drive
from servotwin.control.cascade import Cascade
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.redesign.certified.assess import assess
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.machines import draw_independently
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.rest_in_gap import coasting_time
from servotwin.redesign.certified.trial import trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.redesign.registry import policy_of
from servotwin.simulation.sampled_ensemble import SampledCases, simulate_sampled
from servotwin.twin.settings import TwinSettings

DRIVE = knocking_drive()
CASCADE = Cascade(2.0, 1.0, velocity_gain=30.0, voltage_limit=60.0, sample_rate=2e3, integral_only=False)
GAPS = np.array([4e-3, 1e-2, 2e-2])
RANGES = Uncertainty(gap=(0.0, 0.03), step=(0.06, 0.4))


def swings(axis: Axis, tolerance: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Half peak-to-peak of load and motor in the last part of a long run after a step, over the gap."""
    cases = SampledCases(reference=0.2, gap=GAPS, tolerance=tolerance, resolution=axis.position_resolution)
    found = simulate_sampled(axis, axis.controller, 90.0, cases, ("error", "theta_m"), 100.0, 1)
    load, motor = (0.5 * np.ptp(found[name][:, -1500:], axis=1) / GAPS for name in ("error", "theta_m"))
    return load, motor


def test_only_a_braked_motor_lets_a_floating_load_come_to_rest() -> None:
    """The filtered PID knocks from flank to flank; so does a cascade that pushes after every error."""
    pushing = DRIVE.replace(controller=CASCADE)
    load, motor = swings(DRIVE.replace(Ki=0.0), 0.0)
    assert (motor > 0.5).all()
    assert (load < 0.1).all()
    assert (swings(pushing, 0.0)[0] > 0.1).all()
    load, motor = swings(pushing, GAPS)
    assert (load < 0.01).all()
    assert (motor < 0.02).all()


def test_a_trial_lasts_until_a_floating_load_has_coasted() -> None:
    joint = Axis.preset("robot-joint")
    longest = 1.1 * 60.0 / (0.5 * 20.0)
    assert coasting_time(joint, Uncertainty()) == pytest.approx(longest)
    assert trial_for(joint, Uncertainty(gap=(0.0, 1.0)), Demands()).duration >= 8.0 * longest
    for name in ("ball-screw", "telescope", "gantry"):  # friction stops their loads
        assert coasting_time(Axis.preset(name), Uncertainty()) == 0.0


def test_a_law_that_reads_a_floating_load_alone_is_refused_at_once() -> None:
    with pytest.raises(InvalidInput, match=r'kind = "filtered_pid".*give kind = "cascade".*friction_n_m of the load'):
        policy_of(DRIVE, TwinSettings(uncertainty=RANGES))
    policy_of(DRIVE, TwinSettings(policy="paper"))
    policy_of(DRIVE.replace(controller=CASCADE), TwinSettings(uncertainty=RANGES))
    policy_of(DRIVE, TwinSettings(uncertainty=RANGES.replace(gap=(0.0, 0.0))))
    policy_of(DRIVE, TwinSettings(uncertainty=RANGES.replace(friction=(0.5, 1.0))))
    policy_of(DRIVE.with_position_resolution(0.03), TwinSettings(uncertainty=RANGES))
    policy_of(replace(DRIVE, load=replace(DRIVE.load, friction=1.5)), TwinSettings(uncertainty=RANGES))


def test_a_load_that_nothing_stops_is_refused_under_any_law() -> None:
    bare = replace(DRIVE, load=replace(DRIVE.load, c=(0.0,)), controller=CASCADE)
    assert math.isfinite(coasting_time(bare, RANGES))
    with pytest.raises(InvalidInput, match=r"load.damping_n_m_s_per_rad = 0.*give damping_n_m_s_per_rad or friction"):
        policy_of(bare, TwinSettings(uncertainty=RANGES))
    policy_of(replace(bare, load=replace(bare.load, friction=1.5)), TwinSettings(uncertainty=RANGES))


FEW = Demands(machines=30, conditions=4, screened=2, settled=0.9, beyond=Beyond(machines=10))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("block", "seed", "place"), [("velocity", 31, 0), ("dc motor", 31, 2), ("torque", 31, 3), ("velocity", 77, 0)]
)
def test_a_dead_zone_leaves_a_motor_alone_that_would_drive_to_and_fro(block: str, seed: int, place: int) -> None:
    """No other setting is verified on these machines: two of them have loads with hardly any friction, or none."""
    drawn = random_axis(block, seed, place)
    axis, steps = drawn.model, (drawn.amplitude, 3.0 * drawn.amplitude)
    known = Uncertainty(gap=(0.95 * drawn.gap, 1.05 * drawn.gap), step=steps)
    found = certify(axis, known, FEW)
    assert isinstance(found, Certificate)
    assert found.setting.tolerance == axis.tolerance_for(known.gap[1])
    assert not found.setting.controller.integral_only
    machines = draw_independently(axis, known, 60, 3)
    plain = Design(found.setting.controller.replace(enter=1.0, leave=1.0))
    opened, shut = assess([found.setting, plain], machines, trial_for(axis, known, FEW))
    assert opened.settled.mean() > 0.95
    assert shut.settled.mean() < 0.5


def test_a_motor_that_is_braked_is_no_reason_to_refuse_its_axis() -> None:
    braked = replace(DRIVE, actuator=replace(DRIVE.actuator, friction=2.0))
    for axis in (braked, random_axis("dc motor", 31, 1).model):
        assert isinstance(policy_of(axis, TwinSettings(uncertainty=RANGES)), CertifiedPolicy)
