"""Axes whose parts do not fit, and computations that an axis cannot have."""

import math

import numpy as np
import pytest
from scipy.signal import TransferFunction

import servotwin as st
from benchmarks.workloads import knocking_drive
from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import disturbance
from servotwin.plant.axis import Axis
from servotwin.plant.scales import scales
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.registry import policy_of
from servotwin.twin.settings import TwinSettings

TWO_MASS = Axis.preset("two-mass-drive")
BALL_SCREW = Axis.preset("ball-screw")
STEPPER = Axis.preset("stepper-stage")


def cascade(**changes: object) -> st.Cascade:
    values = {"position_gain": 0.5, "ratio": TWO_MASS.p, "velocity_gain": 20.0, "sample_rate": 2000.0}
    return st.Cascade(**{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TWO_MASS.replace(controller=cascade(velocity_gain=None)), "velocity_gain = None: is missing"),
        (lambda: TWO_MASS.replace(controller=cascade(ratio=5.0)), "ratio = 5.0: the transmission's travel"),
        (lambda: STEPPER.replace(controller=cascade(ratio=STEPPER.p)), "a stepper goes to its commanded angle"),
        (
            lambda: TWO_MASS.replace(
                controller=st.LinearLaw.from_system(TransferFunction([1.0], [1.0, 1.0])),
                sensors=st.Sensors(feedback="motor"),
            ),
            "the controller reads y_load, the load's encoder",
        ),
        (lambda: Axis.preset("telescope").replace(controller=cascade(ratio=5e-4)), "must be absent: the drive closes"),
        (
            lambda: TWO_MASS.replace(
                transmission=st.Transmission(1.0, 3e3, 0.0, "free"), load=st.Load((5.6,), motion="rotary")
            ),
            "a free load without damping and friction never rests",
        ),
        (lambda: st.Load(m=5.0), "load m = 5.0: must be a tuple"),  # type: ignore[arg-type]
        (lambda: st.Transmission("x"), "transmission p = 'x': must be a number"),  # type: ignore[arg-type]
        (lambda: TWO_MASS.tolerance_for(0.1, -1.0), "k_dz = -1.0"),
        (
            lambda: st.certify(st.Axis.preset("emps"), st.Uncertainty(), Demands()),
            "its loop does not depend on the gap and there is nothing to verify",
        ),
        (
            lambda: policy_of(BALL_SCREW.replace(voltage_limit=None), TwinSettings(policy="margin")),
            "limit of this axis do not scale",
        ),
        (
            lambda: TWO_MASS.replace(
                actuator=st.TorqueDrive(0.4, limit=1.0), load=st.Load((5.6,), (0.0,), (0.3,), "rotary", force=-2.0)
            ),
            "torque_limit_n_m = 1.0 N m: gives 1 N m, and the load's force takes 2 N m",
        ),
        (
            lambda: st.TorqueDrive(0.4, coulomb=0.2, static=0.1, stribeck=0.1),
            "static_friction_n_m = 0.1 N m: must be at least coulomb_friction_n_m = 0.2 N m",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_a_sentence(make: object, words: str) -> None:
    with pytest.raises(InvalidInput, match=words) as error:
        make()  # type: ignore[operator]
    assert "\n" not in str(error.value)


def test_a_version_does_not_depend_on_how_a_number_is_typed() -> None:
    versions = set()
    for inertia in (1, 1.0, np.float64(1.0)):
        axis = TWO_MASS.replace(actuator=st.TorqueDrive(J=inertia, friction=1))
        versions.add(axis.version)
        assert Axis.loads(axis.dumps(), "again.toml") == axis
    assert len(versions) == 1


def test_any_ratio_reads_back_as_it_was_written() -> None:
    rng = np.random.default_rng(3)
    for p in rng.uniform(0.8, 1.2, 40).tolist():
        axis = knocking_drive().replace(transmission=st.Transmission(p, 3300.0, 2.0, "free"))
        assert Axis.loads(axis.dumps(), "again.toml").version == axis.version


def test_the_position_of_a_stepper_is_no_bias() -> None:
    run = st.simulate(STEPPER, 6.0, reference=2e-4, gap=0.01, sample_rate=1000.0)
    found = disturbance(st.Window.from_run(run, start=4.0, duration=1.9), STEPPER)
    assert not found.known
    assert "a stepper holds its position" in found.reasons[0]


def test_a_log_of_a_cascade_on_the_motor_has_the_load_s_position() -> None:
    """With a gap the two differ."""
    axis = TWO_MASS.replace(controller=cascade(on="motor"))
    run = st.simulate(axis, 4.0, reference=0.2, gap=math.radians(5.0), sample_rate=1000.0)
    # Within a count.
    assert np.abs(run.measured_position - run.position).max() <= axis.position_resolution
    assert np.abs(run.position - run.theta_m * axis.p).max() > 0.01


@pytest.mark.parametrize("name", ["emps", "stepper-stage"])
def test_every_axis_has_its_own_second_metre_and_volt(name: str) -> None:
    axis = Axis.preset(name)
    assert all(unit > 0.0 for unit in scales(axis))
    if name == "stepper-stage":
        assert all(unit > 0.0 for unit in scales(axis.replace(Kp=100.0, Ki=0.0)))
